"""What a range tells a filter, against draws of noise, detours and outliers."""

from dataclasses import replace

import numpy as np
import pytest

from calib.evaluation.filters import RangeErrors, gated_update, mixture_update

STD = 0.1
ERRORS = RangeErrors(share=0.3, least_m=0.05, detour_m=0.3, outlier=0.02, outlier_m=2.0)
BOTH_SIDES = replace(ERRORS, share=np.array([0.3, 0.15]), detour_m=np.array([0.3, 0.2]))
COUNT = 2_000_000


@pytest.fixture(scope="module", params=[ERRORS, BOTH_SIDES])
def draws(request):
    errors, rng = request.param, np.random.default_rng(3)
    noise = rng.normal(0, STD, COUNT)
    kind = rng.random(COUNT)
    innovation = noise.copy()
    # Of a difference of arrival either reception is reflected; where both are, one of the two counts.
    shares = np.atleast_1d(errors.share)
    ends = 0.98 * np.append(0, np.cumsum(shares) / shares.sum() * (1 - np.prod(1 - shares)))
    for sign, begin, end, detour in zip((1, -1), ends, ends[1:], np.atleast_1d(errors.detour_m), strict=False):
        reflected = (kind >= begin) & (kind < end)
        innovation[reflected] += sign * (0.05 + rng.exponential(detour, np.count_nonzero(reflected)))
    wild = kind > 0.98
    # An outlier's innovation has the filter's own uncertainty in it, and says nothing of the noise.
    innovation[wild] = np.hypot(2.0, STD) * rng.normal(size=np.count_nonzero(wild))
    return errors, innovation, noise, wild


@pytest.mark.parametrize("value", [-0.3, -0.1, 0.0, 0.1, 0.2, 0.35, 0.7, 1.2, -1.0])
def test_mean_and_variance_of_the_noise_are_those_of_draws(draws, value):
    errors, innovation, noise, wild = draws
    near = np.abs(innovation - value) < 0.01
    update = mixture_update(np.array([value]), np.array([STD**2]), errors)
    count = np.count_nonzero(near)
    spread = noise[near].std()
    # Four standard errors, and what the width of the bin does.
    assert update.noise_m[0] == pytest.approx(noise[near].mean(), abs=4 * spread / np.sqrt(count) + 0.004)
    assert update.variance_m2[0] == pytest.approx(noise[near].var(), rel=6 / np.sqrt(count) + 0.05, abs=1e-4)
    assert update.believed[0] == (np.mean(wild[near]) < 0.5)
    assert np.exp(update.log_density[0]) == pytest.approx(count / COUNT / 0.02, rel=4 / np.sqrt(count) + 0.03)


def test_innovations_out_of_reach_are_finite_and_not_believed():
    update = mixture_update(np.array([-50.0, 1e3, 1e5]), np.full(3, STD**2), ERRORS)
    assert not update.believed.any()
    assert np.isfinite(update.noise_m).all()
    np.testing.assert_allclose(update.noise_m, 0, atol=1e-6)
    np.testing.assert_allclose(update.variance_m2, STD**2, rtol=1e-6)


def test_a_gate_takes_all_or_nothing():
    update = gated_update(np.array([0.2, 0.4]), np.full(2, 0.01), 9.0)
    assert update.believed.tolist() == [True, False]
    assert update.noise_m.tolist() == [0.2, 0.0]
    assert update.variance_m2.tolist() == [0.0, 0.01]
