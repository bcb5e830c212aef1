"""The fit of coefficients that are held above a bound, against scipy's."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from calib.estimation.sigma_curve import _above


@pytest.mark.parametrize("seed", range(30))
def test_the_bounded_fit_is_scipys(seed):
    rng = np.random.default_rng(seed)
    design, aim = rng.normal(size=(30, 7)), rng.normal(size=30)
    expected = lsq_linear(design, aim, bounds=(0.1, np.inf), tol=1e-14).x
    np.testing.assert_allclose(_above(design.T @ design, design.T @ aim, 0.1), expected, atol=1e-6)
