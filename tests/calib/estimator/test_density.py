"""The one model of a range's error, against integrals and differences that share no code with it."""

import numpy as np
import pytest
from scipy.integrate import quad

from calib.range_errors.densities import error_slopes

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
    return error_slopes(np.atleast_1d(np.asarray(error, dtype=float)), values, span_m=10.0)


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
