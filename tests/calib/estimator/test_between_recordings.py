"""The variance of offsets from few, uncertain values, and its effect on predicted errors of other recordings."""

from dataclasses import replace

import numpy as np
import pytest

import calib
from benchmarks.worlds import CLEAN, make
from calib.estimator.to_calibration import mean_variance
from tests.shared_data import rows_of

BOUNDS = (1e-4, 1.0)


def sampled(information, slope, typical, rng):
    """Return the mean of s^2 by weighting draws of s from its half-normal prior with the likelihood of z."""
    deviation = np.abs(rng.normal(0, typical, 400_000))[:, None]
    spread = np.hypot(deviation, information**-0.5)
    # A value is normal about zero with the variance of its draw plus that of its uncertainty.
    weight = np.exp(-np.sum(np.log(spread) + 0.5 * (slope / information / spread) ** 2, axis=1))
    return float(np.sum(weight * deviation[:, 0] ** 2) / np.sum(weight))


@pytest.mark.parametrize("planted_m", [0.0, 0.02, 0.1])
def test_variances_are_means_of_their_posterior(planted_m):
    rng = np.random.default_rng(5)
    information = rng.uniform(300, 3000, 8)
    values = rng.normal(0, np.hypot(planted_m, information**-0.5))
    found = mean_variance(information, values * information, 0.035, BOUNDS)
    # Sampling has an error of 1 % of the mean, the grid of 200 deviations less.
    assert found == pytest.approx(sampled(information, values * information, 0.035, rng), rel=0.03)


def test_draws_without_information_have_the_typical_variance():
    assert mean_variance(np.zeros(4), np.zeros(4), 0.035, BOUNDS) == pytest.approx(0.035**2, rel=0.01)


@pytest.mark.slow
def test_recordings_of_a_sound_world_do_not_differ():
    first, second = (make(CLEAN["iid"], 31, flight).ranges[::2] for flight in (0, 1))
    assert calib.fit(first).calibration.errors.between_m == 0.05
    later = replace(second, time_ns=second.time_ns + 86_400 * 10**9, source="later")
    assert calib.fit([first, later]).calibration.errors.between_m < 0.01


def test_between_m_is_in_the_total_sigma():
    ranges = make(CLEAN["three tags"], 32).ranges[::3]
    plain, stated = (calib.fit(ranges, between_m=value).calibration for value in (0.0, 0.05))
    totals = [each.apply(ranges).sigma_total_m for each in (plain, stated)]
    # Without reflections and outliers, squares add up, except for the factor on the noise of each pair.
    assert np.median(totals[1] ** 2 - totals[0] ** 2) == pytest.approx(0.05**2, rel=0.15)


def test_between_m_is_equal_for_pairs_with_little_and_much_noise():
    ranges = make(CLEAN["unequal noise"], 33).ranges[::3]
    plain, stated = (calib.fit(ranges, between_m=value).calibration for value in (0.0, 0.05))
    lifted = np.full(len(ranges), np.median(plain.errors.lifted))
    noise = [one.errors.shapes(lifted, ranges.initiator, ranges.target).noise_m for one in (plain, stated)]
    assert noise[0].max() > 1.5 * noise[0].min()
    # The factors of pairs use the median over the powers, which causes a few per cent.
    assert noise[1] ** 2 - noise[0] ** 2 == pytest.approx(np.full(len(ranges), 0.05**2), rel=0.1)
    assert stated.errors.within_m(noise[1]) == pytest.approx(noise[0], rel=0.1)


@pytest.fixture(scope="module")
def starloc():
    """Ranges of two flights of STAR-loc: two tags on a rig, eight anchors."""
    flights = []
    for name in ("loop-2d-fast_s1", "loop-2d-fast_s2"):
        every = rows_of("starloc_loop-2d-fast.tar.xz", f"{name}/uwb.csv")
        rows = [row for row in every if row["range"] and row["gt_range"]]
        column = {key: np.array([float(row[key]) for row in rows]) for key in ("range", "gt_range", "fpp1", "fpp2")}
        flights.append(
            calib.Ranges.from_arrays(
                column["range"],
                initiator=[int(row["from_id"]) for row in rows],
                target=[int(row["to_id"]) for row in rows],
                fpp1_dbm=column["fpp1"],
                fpp2_dbm=column["fpp2"],
                truth_m=column["gt_range"],
                time_ns=[int(1e9 * float(row["time_s"])) for row in rows],
            )
        )
    return flights


@pytest.mark.parametrize(("one", "other"), [(0, 1), pytest.param(1, 0, marks=pytest.mark.slow)])
def test_a_flight_predicts_the_errors_of_another_day(starloc, one, other):
    found = calib.fit(starloc[one]).calibration
    # No constant of the model was chosen with STAR-loc.
    assert 0.92 < calib.evaluate(starloc[other], found).overall.inside_95 < 0.97
    # The minimum-norm delays: a shift of both tags of the rig against all anchors is not determined.
    of_tags = sum(found.delays_ns[tag] for tag in (1, 2))
    assert of_tags == pytest.approx(sum(found.delays_ns.values()) - of_tags, abs=0.01)


@pytest.mark.slow
def test_delays_of_150_ranges_of_a_real_flight_agree_with_those_of_all(starloc):
    whole = calib.fit(starloc[0]).calibration
    tags, scores = list(whole.delays_ns), []
    # A shift of both tags of the rig against all anchors, and a common shift of all, are not determined.
    free = np.array([np.ones(len(tags)), [1.0 if tag in (1, 2) else -1.0 for tag in tags]])
    known = np.linalg.svd(free)[2][2:]
    for seed in range(48):
        rows = np.sort(np.random.default_rng(seed).choice(len(starloc[0]), 150, replace=False))
        part = calib.fit(starloc[0][rows]).calibration
        away = known @ [part.delays_ns[tag] - whole.delays_ns[tag] for tag in tags]
        scores.append(away @ np.linalg.solve(known @ np.array(part.uncertainty.delays_ns2) @ known.T, away))
    # 384 squares of normal values: 95 % of such means are below 1.12; a third more for the uncertainty from 150 ranges.
    assert np.mean(scores) / len(known) < 1.5
