"""The one model of a range's error against SciPy, integrals and differences that share no code with it."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import expon, exponnorm, norm

from calib.range_errors.densities import LongDetours, densities, error_slopes

SIGMA, LEAST, DETOUR = 0.08, 0.1, 0.3


def test_densities_are_those_of_scipy():
    # From far before the least detour to where the noise is no longer of any account.
    e = np.linspace(-0.6, 12, 500)
    found = densities(e, np.full(500, SIGMA), LEAST, DETOUR)
    np.testing.assert_allclose(found.direct, norm.pdf(e, scale=SIGMA), rtol=1e-12, atol=1e-300)
    np.testing.assert_allclose(
        found.reflected, exponnorm.pdf(e, DETOUR / SIGMA, loc=LEAST, scale=SIGMA), rtol=1e-9, atol=1e-300
    )


def test_two_kinds_of_detour_are_two_exponentials():
    e, long = np.linspace(-0.6, 12, 500), LongDetours(share=0.3, factor=4.0)
    found = densities(e, np.full(500, SIGMA), LEAST, DETOUR, long)
    first = DETOUR / (0.7 + 0.3 * 4)
    parts = [(0.7, first), (0.3, 4 * first)]
    expected = sum(share * exponnorm.pdf(e, mean / SIGMA, loc=LEAST, scale=SIGMA) for share, mean in parts)
    np.testing.assert_allclose(found.reflected, expected, rtol=1e-9, atol=1e-300)
    assert sum(share * mean for share, mean in parts) == pytest.approx(DETOUR)
    assert long.square * DETOUR**2 == pytest.approx(sum(share * mean**2 for share, mean in parts))
    # Mean and variance of the noise: the density's slope and curvature say them (Tweedie's formula).
    step = 1e-4
    logs = [
        np.log(densities(e[:200] + k * step, np.full(200, SIGMA), LEAST, DETOUR, long).reflected) for k in (-1, 0, 1)
    ]
    np.testing.assert_allclose(
        found.noise_m()[:200], -(SIGMA**2) * (logs[2] - logs[0]) / (2 * step), rtol=1e-4, atol=1e-7
    )
    bend = (logs[2] - 2 * logs[1] + logs[0]) / step**2
    np.testing.assert_allclose(found.noise_var()[:200], 1 + SIGMA**2 * bend, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("error", [-0.3, -0.05, 0.1, 0.2, 0.6, 2.0, 6.0])
def test_the_noise_in_a_reflected_range_is_that_of_the_integral(error):
    def moment(k):
        def integrand(noise):
            return noise**k * norm.pdf(noise, scale=SIGMA) * expon.pdf(error - LEAST - noise, scale=DETOUR)

        high = min(error - LEAST, 9 * SIGMA)
        return quad(integrand, max(high - 6 * SIGMA, -9 * SIGMA) if high < 0 else -9 * SIGMA, high, epsabs=0)[0]

    found = densities(np.array([error]), np.array([SIGMA]), LEAST, DETOUR)
    mean = moment(1) / moment(0)
    assert found.noise_m()[0] == pytest.approx(mean, abs=1e-7)
    assert found.noise_var()[0] * SIGMA**2 == pytest.approx(moment(2) / moment(0) - mean**2, abs=1e-8)


def test_nothing_overflows_far_away():
    found = densities(np.array([-1e3, 1e3, 1e6]), np.full(3, SIGMA), LEAST, DETOUR)
    for part in (found.direct, found.reflected, found.noise_m(), found.noise_var()):
        assert np.isfinite(part).all()


SHAPE = {
    "noise": np.log(0.06),
    "odds": -1.5,
    "detour": np.log(0.2),
    "least": np.log(0.05),
    "outliers": -4.0,
    "long": -1.0,
}


def slopes(error, **changed):
    values = {name: np.full(1, value) for name, value in (SHAPE | changed).items()}
    return error_slopes(np.atleast_1d(np.asarray(error, dtype=float)), values)


def test_the_density_is_one():
    inside = 1 / (1 + np.exp(SHAPE["outliers"]))
    points = [0.0, 0.05, 0.2, 1.0]
    mass, _ = quad(lambda e: float(np.exp(slopes(e).log_density[0])), -1.0, 9.0, points=points, limit=400)
    # Outliers are spread over ten metres, from wherever they are counted.
    assert mass == pytest.approx(1.0, abs=2e-4)
    assert inside < 1


@pytest.mark.parametrize("error", [-0.15, 0.0, 0.1, 0.6, 3.0])
def test_slopes_are_derivatives(error):
    step, found = 1e-5, slopes(error).by
    by_residual = (slopes(error + step).log_density - slopes(error - step).log_density) / (2 * step)
    assert found["residual"][0] == pytest.approx(by_residual[0], rel=1e-4, abs=1e-5)
    for name, value in SHAPE.items():
        above, below = (slopes(error, **{name: value + sign * step}).log_density[0] for sign in (1, -1))
        assert found[name][0] == pytest.approx((above - below) / (2 * step), rel=1e-3, abs=1e-5), name


def test_a_long_error_was_reflected_and_an_early_one_is_an_outlier():
    assert slopes(0.5).reflected[0] > 0.95
    assert slopes(0.0).reflected[0] < 0.2
    assert slopes(-1.0).inlier[0] < 0.01
