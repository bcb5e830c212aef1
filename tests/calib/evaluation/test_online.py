"""Delays as states: drifts are followed, and cost little where there are none; factors have the filter's optimum."""

import json
import re
import runpy
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from calib import BadInputError, Ranges, fit, load_ranges, sample_flight
from calib.evaluation.filters import GaussianFilters
from calib.evaluation.localization import consistency, localize
from calib.evaluation.tracking import Settings
from calib.factors import Antenna, range_factor
from calib.online import DelayStates, RangeUpdate, delay_slopes, ends_of, gated_update
from tests.calib import overhearing
from tests.calib.evaluation.drifting_flight import DELAYS_NS, LIGHT, PLACES, flight
from tests.processes import refuse, run, succeed
from tests.shared_data import ROOT

DRIFT_M = {1: 0.2, 2: -0.2}  # 2 cm/K over 10 K


@pytest.fixture(scope="module")
def known():
    return fit(flight(100, 60.0)).calibration


def test_the_command_compares_states_with_fixed_delays_and_prints_their_end(known, tmp_path):
    known.save(tmp_path / "known.json")
    flight(7, 40.0, rate_hz=50, drift_m={1: 0.12, 2: 0.12}).save(tmp_path / "test.uwb")
    options = ("calib", "localize", tmp_path / "test.uwb", "-c", tmp_path / "known.json", "--online", "--seeds", 1)
    table = json.loads(succeed(*options, "--json").stdout)
    rmse, (row,) = table["summary"]["rmse_m"], table["scenarios"]
    assert rmse["online"] < 0.8 * rmse["robust"]
    assert set(row["delays"]) == {str(tag) for tag in DELAYS_NS}
    for tag, drift_m in {1: 0.12, 2: 0.12, 11: 0.0}.items():
        found = row["delays"][str(tag)]
        assert abs(found["delay_ns"] - DELAYS_NS[tag] + 2 * drift_m / LIGHT) < 4 * found["std_ns"] < 0.6
    text = succeed(*options).stdout
    assert re.search(r"raw +calibrated +variance +robust +online", text)
    assert re.search(r"delays at the end of test.uwb robot \(ns\): 1: -0\.\d+ ± 0\.\d+ \(95 %\), 2: ", text)
    for model in ("constant-velocity", "team"):
        refused = model == "team"  # it needs IMUs, with or without states
        done = run(*options[:-2], "--model", model, "--json")
        assert done.returncode == refused
    fixed, online = json.loads(run(*options[:-2], "--model", "constant-velocity", "--json").stdout)
    assert online["rmse_m"] < 0.8 * fixed["rmse_m"]
    assert "delays" not in fixed
    assert online["delays"]["1"]["delay_ns"] == pytest.approx(DELAYS_NS[1] - 0.24 / LIGHT, abs=0.15)


def test_constants_of_pairs_have_no_delays_to_follow(tmp_path):
    made = flight(9, 10.0)
    made.save(tmp_path / "test.uwb")
    fit(made, constants="pair").save(tmp_path / "pairs.json")
    words = ("calib", "localize", tmp_path / "test.uwb", "-c", tmp_path / "pairs.json", "--online")
    refuse(*words, "--tum", tmp_path / "out", naming=["constants of pairs"])
    assert not (tmp_path / "out").exists()


def test_derivatives_by_delays_are_those_of_corrected_ranges_and_differences():
    ranges = load_ranges(overhearing.flight(3, count=60, tags=4)[0], use="receptions")
    known = fit(overhearing.flight(4, count=600, tags=4)[0], use="receptions").calibration
    change_m = np.array([0.3, -0.2, 0.5, 0.1])
    moved = {tag: known.delays_ns[tag] + change_m[tag] / LIGHT for tag in range(4)}
    before, after = (
        np.append(one.apply(ranges).corrected_m, one.correct_arrivals(ranges).corrected_m)
        for one in (known, replace(known, delays_ns=moved))
    )
    slopes = DelayStates.of(known, range(4)).slopes(ends_of(ranges), delay_slopes(ranges))
    # A delay that grew is corrected too little: what is measured lacks its part.
    np.testing.assert_allclose(before - after, slopes @ change_m, atol=1e-9)
    assert np.ptp(slopes) > 0.9


def test_undetermined_delays_stay_so_and_covariances_are_metres(known):
    states = DelayStates.of(known, (11, 1))
    stds_m = np.sqrt(np.diag(states.covariance_m2))
    np.testing.assert_allclose(stds_m, [LIGHT * known.delays_std_ns[tag] for tag in (11, 1)], rtol=1e-6)
    split = DelayStates.of(replace(known, delays_std_ns=known.delays_std_ns | {1: np.inf}), (11, 1))
    found = split.estimates(np.array([LIGHT, 0.0]), split.covariance_m2)
    assert found[11] == pytest.approx((known.delays_ns[11] + 1, known.delays_std_ns[11]))
    assert found[1] == (known.delays_ns[1], np.inf)


def test_residuals_are_those_of_the_likelihood(known):
    one = RangeUpdate.of(known, Ranges.from_arrays(3.0, initiator=1, target=12, fpp1_dbm=-85.0))
    many, around = one.at(np.zeros(400, dtype=int)), np.linspace(-0.4, 2.0, 400)
    residual, slope = many.whiten(around)
    best = one.weigh(np.linspace(-0.05, 0.05, 2001)).log_density.max()
    np.testing.assert_allclose(residual**2 / 2, best - many.weigh(around).log_density, atol=1e-6)
    assert np.all(np.diff(residual) > 0)
    further = (many.whiten(around + 1e-6)[0] - many.whiten(around - 1e-6)[0]) / 2e-6
    # Outliers count as telling nothing: their slope is left out, where they are likely.
    inside = many.weigh(around).believed
    assert np.mean(inside) > 0.6
    np.testing.assert_allclose(slope[inside], further[inside], rtol=0.02, atol=1e-3)
    with pytest.raises(BadInputError, match="range 1 has no power"):
        dbm = [-85.0, np.nan]
        RangeUpdate.of(fit(sample_flight()).calibration, Ranges.from_arrays(3.0, initiator=1, target=2, fpp1_dbm=dbm))


@pytest.mark.slow
def test_a_drift_of_2_cm_a_kelvin_over_10_kelvin_is_followed(known):
    found = [localize(flight(seed, drift_m=DRIFT_M), known, Settings(seeds=1, online=True))[0] for seed in (1, 2, 3)]
    for one in found:
        assert one.tracks["online"].rmse_m < 0.8 * one.tracks["robust"].rmse_m
        # Each tag's change at the end, in ns: within four of its standard deviations, and these small.
        for tag, (delay_ns, std_ns) in one.delays.items():
            planted = DELAYS_NS[tag] - 2 * DRIFT_M.get(tag, 0.0) / LIGHT
            assert abs(delay_ns - planted) < 4 * std_ns < 0.8
    nees, (low, high), _ = consistency([one.tracks["online"] for one in found])
    assert low < nees < high
    assert high - low < 0.5
    assert consistency([one.tracks["robust"] for one in found])[0] > 10


@pytest.mark.slow
def test_where_nothing_drifts_the_filter_is_as_good_as_with_fixed_delays(known):
    found = [localize(flight(seed), known, Settings(seeds=1, online=True))[0] for seed in (4, 5, 6)]
    online, fixed = (np.mean([one.tracks[name].rmse_m for one in found]) for name in ("online", "robust"))
    # The walk that is assumed costs 1 %; means of three flights vary by another.
    assert online < 1.03 * fixed


def rms(errors_m):
    return np.sqrt(np.mean(np.sum(errors_m**2, axis=1)))


def smoothed(ranges, known, anchors_m, moves_m, std_m):
    """Positions (n, 3) and changes of delays (n, tags): the filter forward and back until it settles."""
    states, updates = DelayStates.of(known, ranges.tags()), RangeUpdate.of(known, ranges)
    slopes, size = states.slopes(updates.ends, updates.delay_slopes), 3 + len(states.tags)
    walk_m2 = states.walk_m**2 * np.diff(ranges.time_ns, prepend=ranges.time_ns[0]) * 1e-9
    prior = np.zeros((size, size))
    prior[:3, :3], prior[3:, 3:] = std_m**2 * np.eye(3), states.covariance_m2
    other = np.array([anchors_m[tag] for tag in ranges.target])
    found = np.concatenate([np.cumsum(moves_m, axis=0), np.zeros((len(ranges), size - 3))], axis=1)
    for _ in range(100):
        innovation, along = updates.innovation(found[:, :3], other)
        # Expectation maximisation: what weighing takes for noise is what is left to explain.
        noise_m = updates.weigh(innovation - np.sum(slopes * found[:, 3:], axis=1)).noise_m
        rows = np.concatenate([along, slopes], axis=1)
        running = GaussianFilters(np.zeros((1, size)), prior[None].copy(), size)
        running.state[0, :3] = moves_m[0]
        before, after = [], []
        for k, row in enumerate(rows):
            if k:
                running.state[0, :3] += moves_m[k]
                running.add_variance(slice(0, 3), std_m**2)
                running.add_variance(slice(3, None), walk_m2[k])
            before.append((running.state[0].copy(), running.covariance[0].copy()))
            left = row @ (found[k] - running.state[0]) + noise_m[k : k + 1]
            running.update(row[None], left, updates.noise_m[k] ** 2, partial(gated_update, gate=np.inf))
            after.append((running.state[0].copy(), running.covariance[0].copy()))
        latest = found
        found = np.array([state for state, _ in after])
        for k in range(len(rows) - 2, -1, -1):
            gain = np.linalg.solve(before[k + 1][1], after[k][1]).T
            found[k] = after[k][0] + gain @ (found[k + 1] - before[k + 1][0])
        if np.abs(found - latest).max() < 1e-6:
            return found[:, :3], found[:, 3:], np.sqrt(np.diag(running.covariance[0]))
    raise AssertionError("the smoother did not settle")


def test_gtsam_finds_the_optimum_of_the_filter_run_forward_and_back(known):
    pytest.importorskip("gtsam", reason="GTSAM is not installed here: pip install 'uwbcal[gtsam]'")
    smooth = runpy.run_path(str(ROOT / "docs" / "examples" / "smooth_with_gtsam.py"))["smooth"]

    made = flight(8, 8.0, rate_hz=25, drift_m={1: 0.1}, only=(1,))
    ranges = load_ranges(made)
    anchors_m = dict(zip(range(11, 17), PLACES, strict=True))
    moves_m = np.diff(made.antenna_m, axis=0, prepend=0.0)
    moves_m = moves_m + np.random.default_rng(5).normal(0, 0.03, moves_m.shape)
    places_m, changes_m, _ = smooth(ranges, known, anchors_m, moves_m, 0.03)
    own_m, own_changes_m, std_m = smoothed(ranges, known, anchors_m, moves_m, 0.03)
    assert rms(places_m - own_m) < 0.01 * rms(own_m - made.antenna_m)
    assert np.abs(changes_m - own_changes_m).max() < 0.01 * std_m[3:].min()
    assert rms(own_m - made.antenna_m) < 0.5 * rms(np.cumsum(moves_m, axis=0) - made.antenna_m)


def test_a_factor_has_the_derivatives_of_finite_differences(known):
    gtsam = pytest.importorskip("gtsam", reason="GTSAM is not installed here: pip install 'uwbcal[gtsam]'")
    ranges = Ranges.from_arrays([4.0, 4.0], initiator=1, target=12, fpp1_dbm=-85.0)
    both, states = RangeUpdate.of(known, ranges), DelayStates.of(known, (12, 1))
    ends = Antenna(np.array([0.2, -0.1, 0.05]), 1), Antenna(np.array([0.0, 0.3, 0.1]), 2)
    factor, values = range_factor(both.at([0]), states, 3, *ends), gtsam.Values()
    poses = {
        1: gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.4, 1.2), (1.0, 2.0, 0.5)),
        2: gtsam.Pose3(gtsam.Rot3(), (4.0, 1.0, 2.0)),
    }
    for key, pose in poses.items():
        values.insert(key, pose)
    values.insert(3, np.array([0.03, -0.02]))

    def moved(key, by):
        other = gtsam.Values(values)
        other.update(key, values.atVector(3) + by if key == 3 else poses[key].retract(by))
        return factor.unwhitenedError(other)[0]

    slopes, _ = factor.linearize(values).jacobian()
    numeric = [(moved(key, h) - moved(key, -h)) / 2e-6 for key, n in ((1, 6), (2, 6), (3, 2)) for h in 1e-6 * np.eye(n)]
    np.testing.assert_allclose(slopes[0], numeric, rtol=0.02, atol=1e-3)
    with pytest.raises(BadInputError, match="one"):
        range_factor(both, states, 3, *ends)
