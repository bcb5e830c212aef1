"""Parts of the intervals of a fit: persistence of errors, small samples, reflections."""

import math
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from scipy import signal, stats

import calib
from benchmarks.worlds import CLEAN, LIGHT_M_PER_NS, Recipe, make
from calib.estimator import known_distances
from calib.estimator.covariance import Kept, sandwich
from calib.estimator.score_tests import Slopes
from calib.estimator.time_blocks import TimeBlocks, persistence, time_blocks
from calib.estimator.to_calibration import mean_variance
from calib.spread import students_factor
from tests import shared_data
from tests.calib import synthetic


def fitted(recipe, seed=12_003, **settings):
    return known_distances.fit_known_distances(make(recipe, seed).ranges, calib.FitSettings(**settings))


def test_least_squares_of_delays_alone_and_its_variances_agree_with_numpy():
    model = known_distances.model_of(
        make(CLEAN["short, 30 s"], 12_004).ranges[:400], calib.FitSettings(delays_only=True)
    )
    error = model.ranges.raw_m - model.ranges.truth_m
    found = known_distances.robust_fit(model, error, "l2", None, ("delay",))
    cut = time_blocks(model.ranges.time_ns, model.ranges.session)
    kept = {"delay": Kept.delays(found.optimum.layout.indices(["delay"]), 1e9, model.held)}
    whole, lasting = sandwich(Slopes(found.rows, found.optimum, cut), kept)["delay"]
    # With NumPy alone: scores summed by block, the residual's share of the degrees of freedom, and the persistence of
    # errors.
    matrix = synthetic.design(model.ranges, model.tags)
    np.testing.assert_allclose(found.optimum.of("delay"), -np.linalg.lstsq(matrix, error)[0], atol=2e-6)
    scores = matrix * found.residuals[:, None]
    sums = np.array([scores[cut.number == k].sum(axis=0) for k in range(cut.count)])
    inverse = np.linalg.inv(matrix.T @ matrix)
    plain = inverse @ sums.T @ sums @ inverse * 400 / (400 - len(model.tags))
    np.testing.assert_allclose(
        whole, plain * lasting.factor * (stats.t.ppf(0.975, lasting.freedom) / 1.959964) ** 2, rtol=2e-3
    )


@pytest.mark.slow
def test_reflections_covariance_of_other_detours_are_in_the_intervals(monkeypatch):
    def variances():
        recipes = (Recipe(share=(share, share), seconds=60) for share in (0.001, 0.3))
        return np.array([np.trace(fitted(recipe).covariances["delay"]) for recipe in recipes])

    whole = variances()
    monkeypatch.setattr(known_distances, "_covariance_of_other_detours", lambda *_: 0.0)
    without = variances()
    few, many = whole - without
    assert 0 <= few < many / 20
    assert many > max(2e-8, 0.1 * without[1])


def test_offsets_of_pairs_are_fitted_if_they_are_identifiable():
    assert "offset of pair" in fitted(CLEAN["short, 30 s"]).values
    assert "offset of pair" not in fitted(Recipe(tags=3, seconds=20)).values
    assert "offset of pair" not in fitted(CLEAN["short, 30 s"], constants="pair").values


def test_intervals_of_few_ranges_cover_the_truth():
    scores = []
    for seed in range(12):
        flat = synthetic.ranges(n=100, noise_m=0.05, tail=0, seed=seed, bias=lambda lifted: 0 * lifted)
        known = calib.fit(replace(flat, time_ns=20 * flat.time_ns), loss="l2").calibration
        scores.append(np.divide(*synthetic.about_their_mean(known, synthetic.DELAYS_NS)))
    # Twelve fits with three differences of delays each determine a standard deviation to 12 %. Testing for persistence
    # that does not exist widens intervals of so few ranges by a fifth; offsets of pairs, of which there are two more
    # than delays, by half.
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.25


def test_times_in_microseconds_for_nanoseconds_do_not_narrow_intervals():
    some = synthetic.ranges(n=600)
    sound, hasty = (calib.fit(replace(some, time_ns=some.time_ns // factor)) for factor in (1, 1000))
    # Thirty blocks determine a variance to a quarter; one block, as with three milliseconds, left a third of the width.
    wide, narrow = (np.mean(list(found.calibration.delays_std_ns.values())) for found in (sound, hasty))
    assert narrow > 0.75 * wide
    assert [said for said in hasty.warnings if "s of data" in said]


def blocks(count, seconds):
    return TimeBlocks(number=np.arange(count), bounds=np.array([0, count]), seconds=seconds)


def walk(keep, share, rng, blocks=800, columns=4):
    """Return noise of which a share is persistent, with the resulting factor on the variance of a mean."""
    steps = rng.normal(size=(blocks, columns))
    steps[1:] *= np.sqrt(1 - keep**2)
    memory = signal.lfilter([1.0], [1.0, -keep], steps, axis=0)
    series = np.sqrt(share) * memory + np.sqrt(1 - share) * rng.normal(size=(blocks, columns))
    return series - series.mean(axis=0), 1 + 2 * share * keep / (1 - keep)


@pytest.mark.parametrize(("keep", "share"), [(0.0, 0.0), (0.5, 1.0), (0.9, 0.5), (0.95, 1.0)])
def test_the_factor_is_that_of_the_autocorrelation(keep, share):
    rng = np.random.default_rng(1)
    drawn = [walk(keep, share, rng) for _ in range(20)]
    found = [persistence(series, blocks(800, 240.0), 4).factor / planted for series, planted in drawn]
    # Twenty draws determine a factor of 40 to a tenth; with only twenty stretches it is slightly too large.
    assert 0.85 < np.exp(np.mean(np.log(found))) < 1.4


def test_a_short_recording_has_few_degrees_of_freedom():
    rng = np.random.default_rng(2)
    few = persistence(walk(0.95, 1.0, rng, blocks=120)[0], blocks(120, 12.0), 3)
    many = persistence(walk(0.6, 1.0, rng, blocks=1000)[0], blocks(1000, 100.0), 3)
    # Fewer degrees of freedom have a larger factor.
    assert students_factor(few.freedom) > students_factor(many.freedom) > 0.995
    assert few.stretches < 20 < many.stretches


def test_blocks_are_short_and_leave_gaps_out():
    time = np.concatenate([np.arange(0, 10, 0.01), np.arange(1000, 1010, 0.01)]) * 1e9
    found = time_blocks(time.astype(np.int64), np.zeros(len(time), dtype=np.int32))
    steps = np.diff(found.number).tolist()
    assert (set(steps), steps[999]) == ({0, 1}, 1)
    assert found.seconds == pytest.approx(19.98)
    # Blocks have a tenth of a second, however long the gap is.
    assert 199 <= found.count <= 202


def test_the_delays_of_one_pair_are_known_as_well_as_its_constant():
    # Of two tags, only the sum of the delays is determined; their difference has no effect on the persistence of
    # errors.
    ranges = make(Recipe(tags=2, seconds=120, per_second=20, lasts_s=3.0, share=(0.3, 0.3)), 20_004).ranges
    ranges = replace(ranges, weight_target=np.full(len(ranges), 0.5))
    tags, pair = (calib.fit(ranges, constants=kind).calibration for kind in ("tag", "pair"))
    constant_ns = 2 * pair.pair_offsets[1, 2].std_m / LIGHT_M_PER_NS
    assert tags.std_of_sum_ns([1, 2]) == pytest.approx(constant_ns, rel=0.02)


def ranges_with_offsets(rng, pairs, delays_ns, offsets_m, noise_m, each=300):
    """Return ranges of pairs of tags (pairs, 2) with constant errors and normal noise, and the mean error of a pair."""
    pair = np.arange(each * len(pairs)) % len(pairs)
    ends, true_m = pairs[pair], rng.uniform(1, 6, len(pair))
    constant_m = offsets_m - 0.5 * LIGHT_M_PER_NS * delays_ns[pairs].sum(axis=1)
    error_m = constant_m[pair] + noise_m[pair] * rng.normal(size=len(pair))
    ranges = calib.Ranges.from_arrays(
        true_m + error_m, initiator=ends[:, 0] + 1, target=ends[:, 1] + 1, truth_m=true_m,
        fpp1_dbm=rng.uniform(-92, -80, len(pair)), time_ns=np.arange(len(pair)) * 10_000_000,
    )  # fmt: skip
    return ranges, np.bincount(pair, error_m) / each


@pytest.mark.parametrize("count", [3, 4, 6])
def test_offsets_of_few_pairs_widen_intervals_as_in_regression(count):
    rng = np.random.default_rng(count)
    pairs = np.array(list(combinations(range(count), 2)))
    delays, offsets = rng.normal(0, 0.3, count), rng.normal(0, 0.03, len(pairs))
    ranges, mean_m = ranges_with_offsets(rng, pairs, delays, offsets, np.full(len(pairs), 0.02))
    result = calib.fit(ranges)
    seen = [one for one in result.calibration.provenance["warnings"] if "which the intervals do not include" in one]
    freedom = len(pairs) - count
    if not freedom:
        # Of three tags, an offset of 3.5 cm per pair is one of 3.5 cm * sqrt(3) / c in a delay.
        assert "by up to 202 ps" in seen[0]
        return
    # Means of pairs are a regression with delays as coefficients; their common part is the constant of the curve.
    rows = -0.5 * LIGHT_M_PER_NS * (pairs[:, :, None] == np.arange(count)).any(axis=1)
    (_, (squares,), *_), apart = np.linalg.lstsq(rows, mean_m), np.eye(count) - 1 / count
    covariance = apart @ np.linalg.inv(rows.T @ rows) @ apart * squares / freedom
    mine = apart @ result.calibration.covariance_ns2(range(1, count + 1)) @ apart
    # The noise of a mean, 1 mm, and the tolerance of the search.
    half = stats.t.ppf(0.975, freedom) * np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(1.96 * np.sqrt(np.diag(mine)), half, rtol=0.03)
    assert not seen


def test_offsets_of_pairs_are_proportional_to_their_noise():
    """Three of fifteen pairs have five times the noise and the offsets of the others, as behind an obstacle."""
    pairs, apart = np.array(list(combinations(range(6), 2))), np.eye(6) - 1 / 6
    rows = -0.5 * LIGHT_M_PER_NS * (pairs[:, :, None] == np.arange(6)).any(axis=1)
    errors: dict[str, Any] = {"fit": [], "known": [], "equal": []}
    scores = []
    for seed in range(20):
        rng = np.random.default_rng(20_000 + seed)
        size = np.where(np.arange(15) < 3, 5.0, 1.0)[rng.permutation(15)]
        delays = rng.normal(0, 0.3, 6)
        ranges, mean_m = ranges_with_offsets(rng, pairs, delays, rng.normal(0, 0.03 * size), 0.03 * size)
        found = calib.fit(ranges).calibration
        errors["fit"].append(apart @ (np.array(list(found.delays_ns.values())) - delays))
        scores.append(errors["fit"][-1] / np.sqrt(np.diag(apart @ found.covariance_ns2(range(1, 7)) @ apart)))
        # Regressions of the means with known, and with equal, variances.
        for name, one in (("known", size), ("equal", np.ones(15))):
            errors[name].append(apart @ (np.linalg.lstsq(rows / one[:, None], mean_m / one)[0] - delays))
    rms = {name: np.sqrt(np.mean(np.square(some))) for name, some in errors.items()}
    assert rms["equal"] > 1.4 * rms["known"]
    # The variances are estimated by the noise of 300 ranges, to 4 %, which costs little.
    assert rms["fit"] < 1.1 * rms["known"]
    # 100 independent contrasts: 95 % to 2.2 %.
    assert np.mean(np.abs(scores) < 1.96) == pytest.approx(0.95, abs=0.044)


def test_where_delays_are_stated_offsets_move_the_others():
    rng, target = np.random.default_rng(1), 2 + np.arange(600) % 3
    true_m = rng.uniform(1, 6, 600)
    ranges = calib.Ranges.from_arrays(
        true_m + 0.03 * rng.normal(size=600),
        initiator=1,
        target=target,
        fpp1_dbm=rng.uniform(-92, -80, 600),
        truth_m=true_m,
        time_ns=np.arange(600) * 50_000_000,
    )
    # Tag 1 is known, so an offset of 3.5 cm is one of twice 3.5 cm / c in the delay of the other tag.
    (said,) = [one for one in calib.fit(ranges, fixed_ns={1: 0.0}).warnings if "the intervals do not include" in one]
    assert "by up to 234 ps" in said


# The variance of offsets from few, uncertain values, and its effect on predicted errors of other recordings.


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
    slope = information * rng.normal(0, np.hypot(planted_m, information**-0.5))
    # Sampling has an error of 1 % of the mean, the grid of 200 deviations less.
    expected = pytest.approx(sampled(information, slope, 0.035, rng), rel=0.03)
    assert mean_variance(information, slope, 0.035, BOUNDS) == expected
    # Without information it is the typical variance.
    assert mean_variance(np.zeros(4), np.zeros(4), 0.035, BOUNDS) == pytest.approx(0.035**2, rel=0.01)


@pytest.mark.slow
def test_recordings_of_a_sound_world_do_not_differ():
    first, second = (make(CLEAN["iid"], 31, flight).ranges[::2] for flight in (0, 1))
    assert calib.fit(first).calibration.errors.between_m == 0.05
    later = replace(second, time_ns=second.time_ns + 86_400 * 10**9, source="later")
    assert calib.fit([first, later]).calibration.errors.between_m < 0.01


def test_between_m_is_in_the_total_sigma_and_equal_for_pairs_with_little_and_much_noise():
    ranges = make(CLEAN["unequal noise"], 33).ranges[::3]
    plain, stated = (calib.fit(ranges, between_m=value).calibration for value in (0.0, 0.05))
    # Squares add up, except for the factor on the noise of each pair and for reflections, which widen both.
    totals = [each.apply(ranges).sigma_total_m for each in (plain, stated)]
    assert np.median(totals[1] ** 2 - totals[0] ** 2) == pytest.approx(0.05**2, rel=0.15)
    lifted = np.full(len(ranges), np.median(plain.errors.lifted))
    noise = [one.errors.shapes(lifted, ranges.initiator, ranges.target).noise_m for one in (plain, stated)]
    assert noise[0].max() > 1.5 * noise[0].min()
    # The factors of pairs use the median over the powers, which causes a few per cent.
    assert noise[1] ** 2 - noise[0] ** 2 == pytest.approx(np.full(len(ranges), 0.05**2), rel=0.1)
    assert stated.errors.within_m(noise[1]) == pytest.approx(noise[0], rel=0.1)


def test_what_differs_between_recordings_has_its_size_if_nothing_is_reflected():
    rng, pairs = np.random.default_rng(5), np.array(list(combinations(range(6), 2)))
    nothing, noise_m = np.zeros(len(pairs)), np.full(len(pairs), 0.03)
    ranges, _ = ranges_with_offsets(rng, pairs, rng.normal(0, 0.3, 6), nothing, noise_m)
    total = calib.fit(ranges, between_m=0.05).calibration.apply(ranges).sigma_total_m
    # 300 ranges of a pair determine its noise to 4 %.
    assert np.median(total) == pytest.approx(math.hypot(0.03, 0.05), rel=0.05)


@pytest.fixture(scope="module")
def starloc():
    """Ranges of two flights of STAR-loc: two tags on a rig, eight anchors."""
    flights = []
    for name in ("loop-2d-fast_s1", "loop-2d-fast_s2"):
        every = shared_data.rows_of("starloc_loop-2d-fast.tar.xz", f"{name}/uwb.csv")
        rows = [row for row in every if row["range"] and row["gt_range"]]
        names = ("range", "from_id", "to_id", "fpp1", "fpp2", "gt_range", "time_s")
        range_m, initiator, target, fpp1, fpp2, truth_m, time_s = (
            np.array([float(row[key]) for row in rows]) for key in names
        )
        flights.append(
            calib.Ranges.from_arrays(
                range_m, initiator=initiator.astype(int), target=target.astype(int), fpp1_dbm=fpp1, fpp2_dbm=fpp2,
                truth_m=truth_m, time_ns=(1e9 * time_s).astype(np.int64),
            )
        )  # fmt: skip
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
