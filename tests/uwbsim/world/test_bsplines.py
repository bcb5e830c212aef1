"""Splines of scenarios, bit for bit those of scipy."""

import numpy as np
import pytest
from scipy.interpolate import BSpline as Expected

from uwbsim.world.bsplines import ROWS_AT_ONCE, BSpline


@pytest.mark.parametrize("degree", [1, 2, 3, 5])
@pytest.mark.parametrize("columns", [(), (3,)], ids=["one", "three"])
def test_values_are_scipys(degree, columns):
    random = np.random.default_rng(degree)
    knots = np.cumsum(random.uniform(0.1, 1.0, 16))
    coefficients = random.normal(size=(15 - degree, *columns))
    x = random.uniform(knots[degree], knots[-1 - degree], ROWS_AT_ONCE + 5)
    x[:3] = knots[degree], knots[-1 - degree], knots[7]
    expected = Expected(knots, coefficients, degree)(x)
    np.testing.assert_array_equal(BSpline(knots, coefficients, degree)(x), expected)


def test_clamped_ends_and_what_lies_beyond_them_are_scipys():
    knots = np.array([0, 0, 0, 0, 1, 2.5, 4, 4, 4, 4.0])
    coefficients = np.array([0.3, -1, 2, 0.5, 1, -0.7])
    x = np.array([-0.5, 0.0, 1.0, 2.5, 4.0, 4.5])
    np.testing.assert_array_equal(BSpline(knots, coefficients, 3)(x), Expected(knots, coefficients, 3)(x))
