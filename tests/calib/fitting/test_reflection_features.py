"""Features that indicate reflections: slopes of their odds are found, stated and used, in ranges of NumPy alone."""

import json
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import calib
import uwblink
from benchmarks.nlos import room
from calib.data.features import response_features
from calib.online import range_errors
from tests.processes import refuse, succeed
from uwblink.recording.schema import CirRow
from uwbsim import simulate

RISE, EXCESS = 1.2, 0.15
"""Planted slopes of the log odds per tap and per decibel."""


@cache
def world(seed, count=8000, rise=RISE, excess=EXCESS):
    """Return ranges among four tags, the true probability of a reflection of each, and which were reflected."""
    rng = np.random.default_rng(seed)
    pairs = np.array([(1, 2), (1, 3), (1, 4), (2, 3), (2, 4), (3, 4)])[rng.integers(6, size=count)]
    taps, decibels = 1.0 + rng.poisson(1.5, count), rng.normal(6.0, 3.0, count)
    share = 1 / (1 + np.exp(-(-2.5 + rise * (taps - 2.5) + excess * (decibels - 6.0))))
    reflected = rng.uniform(size=count) < share
    truth = rng.uniform(2.0, 8.0, count)
    delays = np.array([0.0, 0.3, -0.2, 0.1, 0.4])
    error = rng.normal(0, 0.05, count) + reflected * (0.05 + rng.exponential(0.5, count))
    ranges = calib.Ranges.from_arrays(
        truth + error - 0.299702547 * delays[pairs].sum(axis=1) / 2,
        initiator=pairs[:, 0],
        target=pairs[:, 1],
        truth_m=truth,
        fpp1_dbm=rng.uniform(-92, -80, count),
        time_ns=np.arange(count) * 10_000_000,
        features={"rise_taps": taps, "response_db": decibels},
    )
    return ranges, share, reflected


@cache
def fitted(seed, **planted):
    return calib.fit(world(seed, **planted)[0], between_m=0.0).calibration


def without_features(ranges):
    return replace(ranges, features=np.full_like(ranges.features, np.nan))


@pytest.mark.parametrize(("seed", "planted"), [(71, {}), (72, {}), (73, {"rise": 0.0, "excess": 0.0})])
def test_planted_slopes_are_found(seed, planted):
    found = fitted(seed, **planted).errors.features
    assert found.keys() == {"rise_taps", "response_db"}
    # 1500 reflections determine a slope to 6 % of one over the feature's deviation: 0.05 per tap, 0.02 per decibel.
    assert found["rise_taps"].log_odds == pytest.approx(planted.get("rise", RISE), abs=0.15 if planted else 0.2)
    assert found["response_db"].log_odds == pytest.approx(planted.get("excess", EXCESS), abs=0.06)


def test_probabilities_hold_in_ranges_that_were_not_fitted():
    ranges, share, reflected = world(74)
    told = fitted(71).apply(ranges).tail_share
    edges = np.quantile(told, np.linspace(0, 1, 11)[1:-1])
    for k in range(10):
        some = np.digitize(told, edges) == k
        # 800 ranges determine a share to 0.018; slopes and level add as much.
        assert told[some].mean() == pytest.approx(reflected[some].mean(), abs=0.055)
    # Power alone predicts nearly the same for all.
    alone = fitted(71).apply(without_features(ranges)).tail_share
    assert np.mean((told - share) ** 2) < 0.1 * np.mean((alone - share) ** 2)
    assert alone.mean() == pytest.approx(reflected.mean(), abs=0.03)


def test_odds_are_constant_beyond_the_fitted_values():
    known = fitted(71)
    top = known.errors.features["rise_taps"].bounds[1]
    shares = [
        known.apply(
            calib.Ranges.from_arrays([3.0], initiator=1, target=2, fpp1_dbm=-85.0, features={"rise_taps": taps})
        ).tail_share[0]
        for taps in (top - 2, top, top + 500)
    ]
    assert shares[0] < shares[1] == shares[2]


def test_filters_are_given_the_probability_of_each_range():
    ranges, share, _ = world(74)
    assert np.corrcoef(range_errors(fitted(71), ranges)[1].share, share)[0, 1] > 0.98


def test_files_keep_the_slopes_and_refuse_others(tmp_path):
    known = fitted(71)
    assert calib.Calibration.from_json(known.to_json()).errors == known.errors
    good = {"log_odds": 1.0, "centre": 2.0, "bounds": [1.0, 9.0]}
    for name, change in (
        ("colour", {}),
        ("rise_taps", {"bounds": [9.0, 1.0]}),
        ("rise_taps", {"log_odds": 1e9}),
        ("rise_taps", {"bounds": 3.0}),
    ):
        table = json.loads(known.to_json())
        table["errors"]["features"] = {name: good | change}
        (tmp_path / "c.json").write_text(json.dumps(table))
        refuse("calib", "show", tmp_path / "c.json", naming=["features", "rise_taps", *change])
    with pytest.raises(calib.BadInputError, match="colour"):
        calib.Ranges.from_arrays([3.0], initiator=1, target=2, features={"colour": 1.0})


def response(rise, first=740.3, noise=10, late=0, length=1016):
    """Return the taps of a response: noise, a path that rises within some taps from before the first path, and a later
    one.
    """
    rng = np.random.default_rng(5)
    taps = np.abs(rng.normal(0, noise, length)) + np.abs(rng.normal(0, noise, length))
    at = int(first) + 2
    for k in range(rise + 1):
        taps[at - k] += 2000 * (1 - k / (rise + 1))
    taps[at + 1 : at + 4] += (1400, 600, 100)
    taps[int(first) + 40] += late
    return [int(tap) for tap in taps]


def test_slow_rise_of_the_first_path_and_late_energy_are_features():
    steep, slow, echo = (response_features(one, 740.3) for one in (response(1), response(6), response(1, late=6000)))
    assert slow[1] - steep[1] == 5
    assert echo[0] > steep[0] + 5
    assert echo[1] == steep[1]


@pytest.mark.parametrize(
    ("taps", "first"),
    [(None, 740.0), ([], 740.0), ([5] * 1016, 950.0), ([5] * 1016, 40.0), ([0] * 1016, 740.0), ([5] * 9, np.nan)],
)
def test_short_responses_have_no_features(taps, first):
    assert np.isnan(response_features(taps, first)).all()


def contents(rows):
    """Return two exchanges of a pair, a second apart, with impulse responses at some times by some boards."""
    exchanges = uwblink.Exchanges.from_arrays(
        [1, 1], 2, tx1=[0, 0], rx1=5, tx2=1005, rx2=3000, time_ns=[0, 10**9], fpp1_dbm=-85.0, truth_m=3.0
    )
    cirs = [CirRow(time_ns, board, 1, 2, 740.3, tuple(response(rise))) for time_ns, board, rise in rows]
    return uwblink.Contents(exchanges=exchanges, cirs=cirs)


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ([(0, 1, 1), (10**9 + 130_000_000, 2, 4)], [2, 5]),
        ([(130_000_000, 1, 1), (140_000_000, 2, 5)], [4, np.nan]),
        ([(130_000_000, 7, 1)], None),  # of a listener, whose path is another one
        ([(700_000_000, 1, 1)], None),  # too late for the first exchange, and before the second
    ],
)
def test_responses_belong_to_the_exchange_before_them(tmp_path, rows, expected):
    held = contents(rows)
    held.save(tmp_path / "f.uwb")
    base = response_features(response(1), 740.3)[1] - 2
    for source in (held, tmp_path / "f.uwb"):
        found = calib.load_ranges(source).features[:, 1]
        np.testing.assert_allclose(found - base, [np.nan] * 2 if expected is None else expected)


@pytest.mark.slow
def test_fits_without_true_distances_use_features():
    flight, rng = calib.sample_flight(600), np.random.default_rng(75)
    e, late = flight.exchanges, rng.uniform(size=600) < 0.2
    longer = (e.rx2 + np.rint(late * rng.exponential(1.0, 600) / (0.299702547 * 15.65e-3 / 2))).astype(np.int64)
    taps = {slow: tuple(response(5 if slow else 1)) for slow in (False, True)}
    rows = zip(e.time_ns.tolist(), e.initiator.tolist(), e.target.tolist(), late.tolist(), strict=True)
    cirs = [CirRow(time_ns, i, i, j, 740.3, taps[slow]) for time_ns, i, j, slow in rows]
    heard = replace(flight, exchanges=replace(e, rx2=longer), cirs=cirs)
    slope = calib.fit_from_ranges(heard, poses_until_s=3.0).calibration.errors.features["rise_taps"].log_odds
    # Of ranges that rise in 6 instead of 2 taps all are long, of the others none: the prior limits the slope.
    assert slope > 0.5


@pytest.mark.slow
def test_from_a_recording_to_corrected_ranges(tmp_path):
    flight, known = tmp_path / "f.uwb", tmp_path / "c.json"
    simulate(room(305, 20.0), contention=False).save(flight)
    succeed("calib", "fit", flight, "-o", known)
    assert re.search(r"rise_taps +\d\.\d+ .* taps", succeed("calib", "show", known).stdout)
    succeed("calib", "apply", flight, "-c", known, "-o", tmp_path / "a.uwb")
    with uwblink.Recording.open(tmp_path / "a.uwb") as written:
        table = written.columns("corrected")
    ranges = calib.load_ranges(flight)
    # Before the first pose there are no true distances, and ranges are left out.
    shares = table["tail_share"][np.isin(table["time_ns"], ranges.time_ns)]
    np.testing.assert_allclose(shares, calib.load_calibration(known).apply(ranges).tail_share, atol=1e-9)
    rise = ranges.features[:, 1]
    assert np.mean(shares[rise >= np.quantile(rise, 0.95)]) > 3 * np.mean(shares[rise <= np.median(rise)])
