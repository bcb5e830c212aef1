"""B-splines against scipy's, and where fits and flights need it, bit for bit."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BSpline as Expected

from uwblink.bsplines import ROWS_AT_ONCE, BSpline, combination, derivative, matrix

KNOTS = np.concatenate([[0.0] * 4, [0.1, 0.11, 0.5, 0.9], [2.0] * 4])


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 5])
def test_every_spline_is_scipys(degree):
    knots = np.concatenate([[0.0] * (degree + 1), [0.3, 0.4, 1.1], [2.0] * (degree + 1)])
    x = np.concatenate([np.linspace(0, 2, 501), [0.3, 0.4, 1.1]])
    expected = np.asarray(Expected(knots, np.eye(len(knots) - degree - 1), degree)(x))
    np.testing.assert_allclose(matrix(x, knots, degree), expected, atol=1e-14)
    coefficients = np.asarray(np.random.default_rng(1).normal(size=expected.shape[1]))
    np.testing.assert_allclose(combination(x, knots, coefficients, degree), expected @ coefficients, atol=1e-13)


@given(st.lists(st.floats(0.0, 2.0), min_size=1, max_size=20))
def test_splines_sum_to_one(points):
    np.testing.assert_allclose(matrix(np.array(points), KNOTS, 3).sum(axis=1), 1, atol=1e-12)


def test_the_derivative_is_scipys():
    coefficients = np.random.default_rng(2).normal(size=len(KNOTS) - 4)
    x = np.linspace(0, 2, 101)
    turn, knots = derivative(KNOTS, 3)
    expected = Expected(KNOTS, coefficients, 3).derivative()(x)
    np.testing.assert_allclose(combination(x, knots, turn @ coefficients, 2), expected, rtol=1e-11, atol=1e-9)


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
