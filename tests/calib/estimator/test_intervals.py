"""Parts of the intervals of a fit: persistence of errors, small samples, reflections."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.stats import t as student

import calib
from benchmarks.worlds import CLEAN, LIGHT_M_PER_NS, Recipe, make
from calib.estimator import known_distances
from calib.estimator.covariance import Kept, sandwich
from calib.estimator.known_distances import fit_known_distances, model_of, robust_fit
from calib.estimator.score_tests import Slopes
from calib.estimator.time_blocks import TimeBlocks, persistence, time_blocks
from calib.spread import students_factor
from tests.calib import synthetic


def fitted(recipe, seed=12_003, **settings):
    return fit_known_distances(make(recipe, seed).ranges, calib.FitSettings(**settings))


def test_least_squares_of_delays_alone_and_its_variances_agree_with_numpy():
    model = model_of(make(CLEAN["short, 30 s"], 12_004).ranges[:400], calib.FitSettings(delays_only=True))
    error = model.ranges.raw_m - model.ranges.truth_m
    found = robust_fit(model, error, "l2", None, ("delay",))
    delays = found.optimum.layout.indices(["delay"])
    cut = time_blocks(model.ranges.time_ns, model.ranges.session)
    kept = {"delay": Kept.delays(delays, 1e9, model.held)}
    whole, lasting = sandwich(Slopes(found.rows, found.optimum, cut), kept)["delay"]
    # With NumPy alone: scores summed by block, the residual's share of the degrees of freedom, and the persistence of
    # errors.
    tags, ranges = np.array(model.tags), model.ranges
    weights = ((ranges.initiator, ranges.weight_initiator), (ranges.target, ranges.weight_target))
    matrix = sum((ids[:, None] == tags) * weight[:, None] for ids, weight in weights) * 0.299702547
    np.testing.assert_allclose(found.optimum.of("delay"), -np.linalg.lstsq(matrix, error)[0], atol=2e-6)
    scores = matrix * found.residuals[:, None]
    sums = np.array([scores[cut.number == k].sum(axis=0) for k in range(cut.count)])
    inverse = np.linalg.inv(matrix.T @ matrix)
    plain = inverse @ sums.T @ sums @ inverse * len(ranges) / (len(ranges) - len(tags))
    np.testing.assert_allclose(
        whole, plain * lasting.factor * (student.ppf(0.975, lasting.freedom) / 1.959964) ** 2, rtol=2e-3
    )


@pytest.mark.slow
def test_reflections_covariance_of_other_detours_are_in_the_intervals(monkeypatch):
    shape = known_distances._covariance_of_other_detours
    traces = {}
    for added in (False, True):
        monkeypatch.setattr(known_distances, "_covariance_of_other_detours", shape if added else lambda *_: 0.0)
        for share in (0.001, 0.3):
            traces[share, added] = np.trace(fitted(Recipe(share=(share, share), seconds=60)).covariances["delay"])
    few, many = (traces[share, True] - traces[share, False] for share in (0.001, 0.3))
    assert few >= 0
    assert many > max(20 * few, 2e-8, 0.1 * traces[0.3, False])


def test_offsets_of_pairs_are_fitted_if_they_are_identifiable():
    assert "offset of pair" in fitted(CLEAN["short, 30 s"]).values
    assert "offset of pair" not in fitted(Recipe(tags=3, seconds=20)).values
    assert "offset of pair" not in fitted(CLEAN["short, 30 s"], constants="pair").values


def test_intervals_of_few_ranges_cover_the_truth():
    scores = []
    for seed in range(12):
        some = synthetic.ranges(n=100, noise_m=0.05, tail=0, seed=seed)
        flat = replace(
            some,
            raw_m=some.raw_m - synthetic.bias_m(synthetic.lifted(some.fpp1_dbm, some.fpp2_dbm)),
            time_ns=20 * some.time_ns,
        )
        known = calib.fit(flat, loss="l2").calibration
        scores.append(np.divide(*synthetic.about_their_mean(known, synthetic.DELAYS_NS)))
    # Twelve fits with three differences of delays each determine a standard deviation to 12 %. Testing for persistence
    # that does not exist widens intervals of so few ranges by a fifth; offsets of pairs, of which there are two more
    # than delays, by half.
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.25


def test_times_in_microseconds_for_nanoseconds_do_not_narrow_intervals():
    some = synthetic.ranges(n=600)
    sound, hasty = (calib.fit(replace(some, time_ns=some.time_ns // factor)) for factor in (1, 1000))
    # Thirty blocks determine a variance to a quarter; one block, as with three milliseconds, left a third of the width.
    widths = [np.mean(list(found.calibration.delays_std_ns.values())) for found in (sound, hasty)]
    assert widths[1] > 0.75 * widths[0]
    assert [said for said in hasty.warnings if "s of data" in said]


def blocks(count, seconds):
    return TimeBlocks(number=np.arange(count), bounds=np.array([0, count]), seconds=seconds)


def walk(keep, share, rng, blocks=800, columns=4):
    """Return noise of which a share is persistent, with the resulting factor on the variance of a mean."""
    memory = np.zeros((blocks, columns))
    memory[0] = rng.normal(size=columns)
    for k in range(1, blocks):
        memory[k] = keep * memory[k - 1] + np.sqrt(1 - keep**2) * rng.normal(size=columns)
    series = np.sqrt(share) * memory + np.sqrt(1 - share) * rng.normal(size=(blocks, columns))
    return series - series.mean(axis=0), 1 + 2 * share * keep / (1 - keep)


@pytest.mark.parametrize(("keep", "share"), [(0.0, 0.0), (0.5, 1.0), (0.9, 0.5), (0.95, 1.0)])
def test_the_factor_is_that_of_the_autocorrelation(keep, share):
    rng = np.random.default_rng(1)
    found, planted = [], 1.0
    for _ in range(20):
        series, planted = walk(keep, share, rng)
        found.append(persistence(series, blocks(800, 240.0), 4).factor)
    # Twenty draws determine a factor of 40 to a tenth; with only twenty stretches it is slightly too large.
    assert 0.85 * planted < np.exp(np.mean(np.log(found))) < 1.4 * planted


def test_a_short_recording_has_few_degrees_of_freedom():
    rng = np.random.default_rng(2)
    few = persistence(walk(0.95, 1.0, rng, blocks=120)[0], blocks(120, 12.0), 3)
    many = persistence(walk(0.6, 1.0, rng, blocks=1000)[0], blocks(1000, 100.0), 3)
    assert few.freedom < many.freedom
    assert students_factor(few.freedom) > students_factor(many.freedom) > 0.995
    assert few.stretches < 20 < many.stretches


def test_blocks_are_short_and_leave_gaps_out():
    time = np.concatenate([np.arange(0, 10, 0.01), np.arange(1000, 1010, 0.01)]) * 1e9
    found = time_blocks(time.astype(np.int64), np.zeros(len(time), dtype=np.int32))
    assert set(np.diff(found.number).tolist()) <= {0, 1}
    assert found.number[999] < found.number[1000]
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


@pytest.mark.parametrize("count", [3, 4, 6])
def test_offsets_of_few_pairs_widen_intervals_as_in_regression(count):
    rng, light = np.random.default_rng(count), LIGHT_M_PER_NS
    pairs = np.array(list(combinations(range(count), 2)))
    delays, offsets = rng.normal(0, 0.3, count), rng.normal(0, 0.03, len(pairs))
    pair = np.arange(300 * len(pairs)) % len(pairs)
    ends, true_m, noise_m = pairs[pair], rng.uniform(1, 6, len(pair)), 0.02 * rng.normal(size=len(pair))
    raw_m = true_m - 0.5 * light * delays[ends].sum(axis=1) + offsets[pair] + noise_m
    result = calib.fit(
        calib.Ranges.from_arrays(
            raw_m,
            initiator=ends[:, 0] + 1,
            target=ends[:, 1] + 1,
            fpp1_dbm=rng.uniform(-92, -80, len(pair)),
            truth_m=true_m,
            time_ns=np.arange(len(pair)) * 10_000_000,
        )
    )
    seen = [one for one in result.calibration.provenance["warnings"] if "which the intervals do not include" in one]
    freedom = len(pairs) - count
    if not freedom:
        # Of three tags, an offset of 3.5 cm per pair is one of 3.5 cm * sqrt(3) / c in a delay.
        assert "by up to 202 ps" in seen[0]
        return
    # Means of pairs are a regression with delays as coefficients; their common part is the constant of the curve.
    rows = -0.5 * light * (pairs[:, :, None] == np.arange(count)).any(axis=1)
    means = np.bincount(pair, raw_m - true_m) / 300
    apart = np.eye(count) - 1 / count
    residuals = means - rows @ np.linalg.lstsq(rows, means)[0]
    covariance = residuals @ residuals / freedom * np.linalg.inv(rows.T @ rows)
    half = student.ppf(0.975, freedom) * np.sqrt(np.diag(apart @ covariance @ apart))
    mine = apart @ result.calibration.covariance_ns2(range(1, count + 1)) @ apart
    # The noise of a mean, 1 mm, and the tolerance of the search.
    np.testing.assert_allclose(1.96 * np.sqrt(np.diag(mine)), half, rtol=0.03)
    assert not seen


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
