"""B-splines and the bounded fit against scipy's."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BSpline
from scipy.optimize import lsq_linear

from calib.calibration.bsplines import combination, derivative, matrix
from calib.estimation.sigma_curve import _above

KNOTS = np.concatenate([[0.0] * 4, [0.1, 0.11, 0.5, 0.9], [2.0] * 4])


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 5])
def test_every_spline_is_scipys(degree):
    knots = np.concatenate([[0.0] * (degree + 1), [0.3, 0.4, 1.1], [2.0] * (degree + 1)])
    x = np.concatenate([np.linspace(0, 2, 501), [0.3, 0.4, 1.1]])
    expected = np.asarray(BSpline(knots, np.eye(len(knots) - degree - 1), degree)(x))
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
    expected = BSpline(KNOTS, coefficients, 3).derivative()(x)
    np.testing.assert_allclose(combination(x, knots, turn @ coefficients, 2), expected, rtol=1e-11, atol=1e-9)


@pytest.mark.parametrize("seed", range(30))
def test_the_bounded_fit_is_scipys(seed):
    rng = np.random.default_rng(seed)
    design, aim = rng.normal(size=(30, 7)), rng.normal(size=30)
    expected = lsq_linear(design, aim, bounds=(0.1, np.inf), tol=1e-14).x
    np.testing.assert_allclose(_above(design.T @ design, design.T @ aim, 0.1), expected, atol=1e-6)
