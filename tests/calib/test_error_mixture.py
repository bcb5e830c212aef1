"""Errors taken apart into core, tail and stray: what was mixed comes out."""

import numpy as np
import pytest
from scipy.stats import exponnorm

from calib.range_errors.error_mixture import ErrorMixture, e_step, fit_error_mixture, fit_error_mixtures


def mixed(n=40_000, share=0.12, mean_m=0.35, outlier=0.0, seed=3):
    rng = np.random.default_rng(seed)
    bins = np.arange(n) % 2
    sigma = np.array([0.06, 0.12])[bins]
    error = 0.03 + rng.normal(size=n) * sigma
    error += np.where(rng.random(n) < share, rng.exponential(mean_m, n), 0)
    return np.where(rng.random(n) < outlier, rng.uniform(-40, 40, n), error), bins


def test_the_parts_come_out():
    error, bins = mixed()
    m = fit_error_mixture(error, bins, 2)
    # 40 000 errors know the centre to 0.5 mm and a sigma to 0.5 %; four times that are allowed.
    assert m.location_m == pytest.approx(0.03, abs=0.002)
    np.testing.assert_allclose(m.sigma_m, [0.06, 0.12], rtol=0.02)
    assert m.tail_share == pytest.approx(0.12, abs=0.01)
    assert m.tail_mean_m == pytest.approx(0.35, rel=0.05)


def test_stray_values_are_told_from_the_tail():
    error, bins = mixed(outlier=0.03)
    m = fit_error_mixture(error, bins, 2)
    assert m.location_m == pytest.approx(0.03, abs=0.002)
    assert m.outlier_share == pytest.approx(0.03, abs=0.006)
    np.testing.assert_allclose(m.sigma_m, [0.06, 0.12], rtol=0.03)


def test_clean_errors_are_all_core():
    error, bins = mixed(share=0.0)
    m = fit_error_mixture(error, bins, 2)
    assert m.location_m == pytest.approx(0.03, abs=0.003)
    assert m.tail_share * m.tail_mean_m < 0.003
    np.testing.assert_allclose(m.sigma_m, [0.06, 0.12], rtol=0.02)


def test_noise_much_smaller_than_that_of_other_bins_is_found():
    # The grid's cells are as wide as the smallest noise, which they widen by 4 % if that is not taken off.
    bins = np.arange(60_000) % 3
    sigma = np.array([0.02, 0.2, 0.2])
    found = fit_error_mixture(sigma[bins] * np.random.default_rng(7).normal(size=len(bins)), bins, 3)
    np.testing.assert_allclose(found.sigma_m, sigma, rtol=0.02)


def test_no_mean_detour_is_shorter_than_two_sigmas():
    rng = np.random.default_rng(5)
    error = 0.1 * rng.normal(size=20_000) + np.where(rng.random(20_000) < 0.5, rng.exponential(0.06, 20_000), 0)
    found = fit_error_mixture(error, np.zeros(20_000, dtype=np.int64), 1)
    assert found.tail_mean_m >= 1.99 * found.sigma_m[0]


def test_density_is_that_of_scipy_and_integrates_to_one():
    mixture = ErrorMixture(0.0, np.array([0.08]), 0.25, 0.3, 0.0)
    e = np.linspace(-1, 6, 7001)
    found = e_step(e, mixture.sigma_m, mixture, 0.0)
    normal = np.exp(-0.5 * (e / 0.08) ** 2) / np.sqrt(2 * np.pi) / 0.08
    tail = exponnorm.pdf(e, 0.3 / 0.08, scale=0.08)
    np.testing.assert_allclose(found.density, 0.75 * normal + 0.25 * tail, atol=1e-9)
    assert np.trapezoid(found.density, e) == pytest.approx(1, abs=1e-6)
    # The noise's posterior mean, against quadrature at one error.
    t = np.linspace(0, 5, 200_001)
    weight = np.exp(-t / 0.3 - 0.5 * ((0.2 - t) / 0.08) ** 2)
    at = int(np.argmin(np.abs(e - 0.2)))
    assert found.noise[at] == pytest.approx(np.sum(weight * (0.2 - t)) / weight.sum(), abs=1e-5)
    assert found.noise_square[at] == pytest.approx(np.sum(weight * (0.2 - t) ** 2) / weight.sum(), abs=1e-5)


def test_mixtures_found_together_are_those_found_alone():
    # Of unlike sizes, shares and places, so that each settles after another number of steps.
    groups = [mixed(n, share, seed=n)[0] + n for n, share in ((70, 0.3), (300, 0.0), (5000, 0.1), (900, 0.45))]
    alone = [fit_error_mixture(error, np.zeros(len(error), dtype=np.int64), 1) for error in groups]
    for one, other in zip(fit_error_mixtures(groups), alone, strict=True):
        assert (one.location_m, *one.sigma_m) == (other.location_m, *other.sigma_m)
        assert (one.tail_share, one.tail_mean_m, one.outlier_share) == (
            other.tail_share,
            other.tail_mean_m,
            other.outlier_share,
        )
    assert fit_error_mixtures([]) == []
