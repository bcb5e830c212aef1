"""Overheard frames fitted together with ranges, or alone: worlds of NumPy alone, and the simulator without noise."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import calib
from calib.fitting.passive_listeners import heard_delays
from tests.calib.overhearing import bound_ns2, flight, least_squares_ns
from tests.calib.synthetic import calibration
from tests.shared_data import ROOT, miluv
from uwblink import Tag
from uwblink.importers import read_source
from uwbsim import load, simulate

SCENARIOS = ROOT / "scenarios"
PASSIVE = [f"tags.{k}.passive=true" for k in range(6)]
NOTHING = calibration(dict.fromkeys(range(1, 7), 0.0), 0.1)
METRES_A_NS = 0.299702547
ROBOTS_AND_ANCHORS = [(0, 1), (0, 2), (0, 3), (4, 1), (4, 2), (4, 3)]


def fitted(data, use, **settings):
    """Return delays and their standard deviations (2, tags)."""
    found = calib.fit(data, use=use, between_m=0.0, **settings).calibration
    return np.array([[column[tag] for tag in sorted(column)] for column in (found.delays_ns, found.delays_std_ns)])


@pytest.mark.parametrize(
    ("protocol", "within_ns"),
    [
        # At least 800 differences of five rounded stamps, 8 ps each: 0.3 ps.
        ("ds", 1.2e-3),
        # Carriers are read in steps of 0.0038 ppm at best; over a reply of 1.5 ms, a thousandth of a ppm is 1.5 ps.
        ("ss", 0.05),
    ],
)
def test_each_listener_determines_each_delay_of_a_target(protocol, within_ns):
    settings = ["run.duration_s=60", f"ranging.protocol={protocol}", *PASSIVE]
    found = simulate(load(SCENARIOS / "noiseless.toml", settings))
    planted = {int(tag): delay for tag, delay in found.planted["delays_ns"].items()}
    ranges = calib.load_ranges(found, need_power=False)
    heard, target = ranges.arrivals, ranges.target[ranges.arrivals.exchange]
    # With the true distance instead of the range, whose errors contain both delays.
    error_m = heard.error_m + (ranges.raw_m - ranges.truth_m)[heard.exchange]
    ends = np.array([target, heard.listener])
    both, row, count = np.unique(ends, axis=1, return_inverse=True, return_counts=True)
    assert len(count) == 20
    own_ns = -np.bincount(row.ravel(), error_m) / count / METRES_A_NS
    assert own_ns == pytest.approx(np.array([planted[tag] for tag in both[0].tolist()]), abs=within_ns)
    if protocol == "ds":
        # The drift of clocks over a third interval five times as long adds some picoseconds.
        by_tag = {tag: one.delay_ns for tag, one in heard_delays(ranges, NOTHING).items()}
        assert by_tag == pytest.approx({tag: planted[tag] for tag in by_tag}, abs=0.005)
        assert len(by_tag) >= 3
        assert heard_delays(replace(ranges, arrivals=None), NOTHING) == {}


@pytest.mark.slow
def test_delays_that_listeners_give_agree_with_the_fit_of_a_noisy_flight(tmp_path):
    flown = simulate(load(SCENARIOS / "icra2023/train.toml", ["run.duration_s=60", *PASSIVE]))
    flown.save(tmp_path / "f.uwb")
    known = calib.fit(flown).calibration
    from_file, heard = (heard_delays(calib.load_ranges(data), known) for data in (tmp_path / "f.uwb", flown))
    assert (from_file, len(heard)) == (heard, 4)
    # Both have the constant of the curve in the same gauge. A fit of 60 s determines a delay to 17 ps, listeners to 8
    # ps.
    expected = pytest.approx({tag: known.delays_ns[tag] for tag in heard}, abs=0.06)
    assert {tag: one.delay_ns for tag, one in heard.items()} == expected


@pytest.mark.slow
def test_the_gain_by_listeners_agrees_with_theory():
    pairs = [(i, j) for i in range(6) for j in range(6) if i != j]
    alone, bound = (np.sqrt(np.diag(bound_ns2(pairs, 6, listening=on)).mean()) for on in (False, True))
    assert bound / alone == pytest.approx(0.764, abs=0.01)
    flights = [flight(7000 + seed) for seed in range(20)]
    fits = [fitted(data, "receptions", delays_only=True, loss="l2") for data, _ in flights]
    delays, std = np.array(fits).swapaxes(0, 1)
    beyond, errors = delays - [least_squares_ns(data) for data, _ in flights], delays - [one for _, one in flights]
    # Least squares reaches the bound, and the additional error of another estimator is independent. So the standard
    # deviation of the fit is within 10 % of the bound; errors alone would show this to a tenth only with 100 flights.
    assert np.sqrt(1 + np.mean(beyond**2) / bound**2) < 1.1
    # 120 errors, of which 20 are independent if all delays of a flight have common errors: rms to 16 %.
    assert np.sqrt(np.mean(errors**2)) < 1.16 * 1.1 * bound
    assert np.mean(np.abs(errors) < 1.96 * std) > 0.9


@pytest.mark.slow
def test_intervals_hold_among_reflections_with_a_curve():
    """Contrasts of delays are compared, because a constant of the curve shifts all delays."""
    flights = [flight(7100 + seed, reflected=0.15, bias_m=0.1) for seed in range(10)]
    delays, std = np.array([fitted(data, "receptions") for data, _ in flights]).swapaxes(0, 1)
    off = delays - [planted for _, planted in flights]
    contrasts = off - off.mean(axis=1, keepdims=True)
    # An interval of a delay includes the constant, so contrasts are within it more often.
    assert np.mean(np.abs(contrasts) < 1.96 * std) > 0.9
    assert np.sqrt(np.mean(contrasts**2)) < 0.02


@pytest.mark.parametrize("listener", [1, 4])
def test_one_listener_determines_the_split_of_anchors_and_robots(listener):
    data, planted = flight(7200, tags=5, pairs=ROBOTS_AND_ANCHORS, listeners=[listener])
    without = calib.fit(data, delays_only=True)
    assert without.calibration.undetermined_splits == (((0, 4), (1, 2, 3)),)
    assert [w for w in without.warnings if "fit with `use` receptions" in w]
    found = calib.fit(data, use="receptions", delays_only=True).calibration
    assert (found.undetermined_splits, found.provenance["arrivals"]) == ((), len(data.overheard["time_ns"]))
    delays, std = fitted(data, "receptions", delays_only=True)
    assert (np.abs(delays - planted) < 3.5 * std).all()
    assert std.max() < 0.04


def test_recordings_are_fitted_together_with_what_each_overheard():
    (one, _), (other, _) = flight(7300, count=800), flight(7301, count=800)
    found = calib.fit([one, other], use="receptions", delays_only=True)
    assert found.calibration.provenance["arrivals"] == 2 * 800 * 4
    both, alone = calib.load_ranges([one, other]), calib.load_ranges(other)
    kept: Any = both[both.session == 1]
    assert kept.arrivals.error_m == pytest.approx(alone.arrivals.error_m)
    assert kept.raw_m[kept.arrivals.exchange] == pytest.approx(alone.raw_m[alone.arrivals.exchange])


@pytest.mark.parametrize(("beside_m", "named"), [(0.0, False), (0.1, True)])
def test_a_listener_at_a_wrong_place_is_named(beside_m, named):
    data, _ = flight(7400)
    # Tag 9 only listens, at the place of tag 2; its stated position is that, or 10 cm beside it.
    only = {name: column[data.overheard["listener"] == 2] for name, column in data.overheard.items()}
    only["listener"][:] = 9
    joined = {name: np.concatenate([column, only[name]]) for name, column in data.overheard.items()}
    told = replace(data, tags=[*data.tags, Tag(9, "mast 2", (0.0, beside_m, 0.0))], overheard=joined)
    said = [w for w in calib.fit(told, use="receptions").warnings if "overheard" in w]
    assert any("-9" in warning for warning in said) == named, said
    assert all("-9" in warning for warning in said), said


def test_a_target_whose_ranges_contradict_what_is_overheard_is_named():
    data, _ = flight(7401)
    # Ten ticks are 4.7 cm.
    late = np.where(data.overheard["target"] == 3, 10, 0)
    heard = {name: column + late * (name in ("rx2", "rx3")) for name, column in data.overheard.items()}
    said = [w for w in calib.fit(replace(data, overheard=heard), use="receptions").warnings if "overheard" in w]
    assert [w for w in said if w.startswith("tag 3: overheard frames contradict its ranges")], said


@pytest.mark.parametrize(
    ("change", "settings", "error", "said"),
    [
        ({"overheard": {}}, {}, calib.UnanswerableError, "no listener overheard"),
        ({}, {"sequential": True}, calib.BadInputError, "sequential"),
        ({}, {"constants": "pair"}, calib.BadInputError, "constants"),
        ({}, {"use": "everything"}, calib.BadInputError, "allowed: exchanges, receptions"),
    ],
)
def test_receptions_that_cannot_be_fitted_are_refused(change, settings, error, said):
    with pytest.raises(error, match=said):
        calib.fit(replace(flight(7500, count=300)[0], **change), **{"use": "receptions"} | settings)


@pytest.mark.slow
def test_a_real_flight_has_narrower_intervals_and_the_same_delays(tmp_path):
    flown = read_source(miluv(tmp_path), importer="miluv")
    (delays, std), (heard, narrow) = (fitted(flown, use) for use in ("exchanges", "receptions"))
    # A check widens the interval of a tag that it names.
    found = calib.fit(flown, use="receptions")
    named = [tag for tag in found.calibration.delays_ns if any(w.startswith(f"tag {tag}:") for w in found.warnings)]
    assert len(named) < 2
    others = ~np.isin(sorted(found.calibration.delays_ns), named)
    delays, std, heard, narrow = (one[others] for one in (delays, std, heard, narrow))
    # 317 ranges, and about 700 differences of arrival at the five other tags; by theory the mean ratio is 0.76.
    assert (narrow < std).all()
    assert narrow.mean() < 0.8 * std.mean()
    # The information of the receptions is independent, so the change has the difference of both variances (Hausman
    # 1978).
    assert np.abs((heard - delays) / np.sqrt(std**2 - narrow**2)).max() < 3
    # The doctor names the contradiction: two tags of one robot, a lever arm apart, receive each other's frames too
    # early.
    said = [w for w in found.warnings if "overheard" in w]
    assert all(w.startswith(("path 10-11", "path 20-21", "path 30-31")) for w in said), said


@pytest.mark.slow
def test_a_report_fits_receptions_as_well():
    data, _ = flight(7700, count=600)
    assert calib.run_campaign(data, use="receptions").calibration.provenance["arrivals"] > 1900
