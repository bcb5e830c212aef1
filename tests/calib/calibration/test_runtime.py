"""Correcting one range at a time equals correcting columns, and is fast enough for a robot's loop."""

import math
import time

import numpy as np
import pytest

from calib.calibration.error_model import ErrorModel, PairErrors
from calib.calibration.model import Calibration, TagGroup
from calib.calibration.power_curves import Curve
from calib.data.ranges import Ranges
from calib.errors import BadInputError

TAGS = [1, 2, 5, 40]


def curve(rng, low_m):
    degree = int(rng.integers(0, 6))
    inner = np.sort(rng.uniform(0.05, 3.0, int(rng.integers(0, 12))))
    ends = [0.02] * (degree + 1), [3.5] * (degree + 1)
    knots = (*ends[0], *inner.tolist(), *ends[1])
    count = len(knots) - degree - 1
    low, high = sorted(rng.uniform(0.02, 3.5, 2))
    return Curve(knots, tuple(rng.uniform(low_m, 0.3, count)), degree, (float(low), float(high)))


def random_errors(rng):
    """Return what errors are made of: some pairs have factors, others have what is common."""
    return ErrorModel(
        lifted=tuple(np.sort(rng.uniform(0.02, 3.5, 5)).tolist()),
        noise_m=tuple(rng.uniform(0.01, 0.1, 5).tolist()),
        tail_share=tuple(rng.uniform(0.01, 0.6, 5).tolist()),
        least_m=0.05,
        detour_m=0.3,
        outlier_share=0.001,
        outlier_m=1.0,
        location_m=0.01,
        scale=1.03,
        pairs={"1-2": PairErrors(1.2, 3.0, 0.5), "5-40": PairErrors(0.8, 0.2, 2.0)},
    )


def random_calibration(seed):
    rng = np.random.default_rng(seed)
    groups = {}
    if seed % 2:
        groups = {
            "a": TagGroup((1, 5), curve(rng, -0.2), curve(rng, 0.01)),
            "b": TagGroup((2, 40), curve(rng, -0.2), curve(rng, 0.01)),
        }
    return Calibration(
        delays_ns={tag: float(rng.normal() * 0.3) for tag in TAGS},
        delays_std_ns=dict.fromkeys(TAGS, 0.01),
        loss="cauchy",
        scale_ns=0.1,
        lift=["mean-of-lifted", "lift-of-mean"][seed // 2 % 2],
        alpha_dbm=float(rng.uniform(-85, -79)),
        speed_of_light=299_702_547.0,
        bias_curve=curve(rng, -0.2),
        sigma_curve=curve(rng, 0.01),
        groups=groups,
        errors=random_errors(rng) if seed % 3 else None,
    )


def columns(seed, n=200):
    rng = np.random.default_rng(1000 + seed)
    pair = np.array([rng.choice(TAGS, 2, replace=False) for _ in range(n)])
    power = rng.uniform(-105, -70, (2, n))
    # What boards print where they cannot tell, at either end and at both.
    power[0, ::7] = 0.0
    power[1, ::11] = 0.0
    power[1, 5::13] = np.nan
    return rng.uniform(-1, 20, n), power, pair


@pytest.mark.parametrize("seed", range(24))
def test_one_by_one_equals_apply(seed):
    known = random_calibration(seed)
    measured, power, pair = columns(seed)
    weights = 0.5, 0.5 * (1 + 2e-5)
    ranges = Ranges.from_arrays(
        measured, initiator=pair[:, 0], target=pair[:, 1], fpp1_dbm=power[0], fpp2_dbm=power[1], weights=weights
    )
    applied = known.apply(ranges)
    powered = np.isfinite(applied.lifted)
    assert 0 < np.count_nonzero(~powered) < 10
    assert np.count_nonzero(applied.clamped & powered) > 0
    expected = np.where(powered, applied.corrected_m, applied.delay_corrected_m)
    for k in range(len(measured)):
        one = known.correct(measured[k], power[0, k], power[1, k], int(pair[k, 0]), int(pair[k, 1]), weights=weights)
        assert one.range_m == pytest.approx(expected[k], abs=1e-9)
        assert one.clamped == applied.clamped[k]
        assert one.sigma_total_m == pytest.approx(applied.sigma_total_m[k], abs=1e-9, nan_ok=True)
        assert one.tail_share == pytest.approx(applied.tail_share[k], abs=1e-9, nan_ok=True)
        if powered[k]:
            assert math.isfinite(one.sigma_total_m) == (known.errors is not None)
            assert one.sigma_m == pytest.approx(applied.sigma_m[k], abs=1e-9)
        else:
            assert math.isnan(one.sigma_m)
    whole = known.correct(measured, power[0], power[1], pair[:, 0], pair[:, 1], weights=weights)
    np.testing.assert_array_equal(whole.range_m, expected)
    np.testing.assert_array_equal(whole.sigma_m, np.where(powered, applied.sigma_m, np.nan))


def test_numbers_of_any_kind_and_mixtures_with_arrays():
    known = random_calibration(0)
    plain = known.correct(3.0, -85.0, -86.0, 1, 2)
    assert type(plain.range_m) is float
    numpy = known.correct(np.float64(3.0), np.float64(-85.0), -86, np.int64(1), np.uint16(2))
    np.testing.assert_array_equal(numpy, plain)
    mixed = known.correct(np.array([3.0, 4.0]), -85.0, -86.0, 1, [2, 5])
    assert mixed.range_m.shape == (2,)
    assert mixed.range_m[0] == pytest.approx(plain.range_m, abs=1e-12)
    assert mixed.sigma_m[0] == pytest.approx(plain.sigma_m, abs=1e-12)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("target", [9, [9, 9]])
def test_a_tag_without_a_delay_is_named(seed, target):
    with pytest.raises(BadInputError, match=r"no delay for tag 9 .* knows 1, 2, 5, 40"):
        random_calibration(seed).correct(3.0, -85.0, -85.0, 1, target)


def test_a_tag_in_no_group_is_named():
    known = random_calibration(1)
    known.delays_ns[7] = 0.1
    for ranges in (3.0, np.array([3.0])):
        with pytest.raises(BadInputError, match="tag 7 is in none"):
            known.correct(ranges, -85.0, -85.0, 1, 7)


def best_s(work):
    """Return the least time of a call in seconds; the best of twenty leaves out what else the machine does."""
    times = []
    for _ in range(20):
        begin = time.perf_counter()
        for _ in range(100):
            work()
        times.append((time.perf_counter() - begin) / 100)
    return min(times)


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_it_is_fast_enough_for_a_loop(seed):
    """Side by side with columns of one range, which take ten times as long and more."""
    known, one = random_calibration(seed), np.array([3.0])
    known.correct(3.0, -85.0, -86.0, 1, 2)
    alone = best_s(lambda: known.correct(3.0, -85.0, -86.0, 1, 2))
    assert alone < 0.5 * best_s(lambda: known.correct(one, -85.0, -86.0, 1, 2))
