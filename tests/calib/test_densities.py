"""Densities of direct and reflected errors against SciPy's, and the noise in them against integrals."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import expon, exponnorm, norm

from calib.densities import densities

SIGMA, LEAST, DETOUR = 0.08, 0.1, 0.3


def test_densities_are_those_of_scipy():
    # From far before the least detour to where the noise is no longer of any account.
    e = np.linspace(-0.6, 12, 500)
    found = densities(e, np.full(500, SIGMA), LEAST, DETOUR)
    np.testing.assert_allclose(found.direct, norm.pdf(e, scale=SIGMA), rtol=1e-12, atol=1e-300)
    np.testing.assert_allclose(
        found.reflected, exponnorm.pdf(e, DETOUR / SIGMA, loc=LEAST, scale=SIGMA), rtol=1e-9, atol=1e-300
    )


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
