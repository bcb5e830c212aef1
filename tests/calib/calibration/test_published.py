"""The published samples of ICRA 2023 lead to the published curve."""

import json

import numpy as np
from scipy.interpolate import BSpline

from calib.calibration.power_curves import basis
from tests.shared_data import shared


def test_a_cubic_through_the_samples_is_the_published_spline():
    samples = np.loadtxt(shared("icra2023_bias_fpp.csv"), delimiter=",", skiprows=1)
    published = json.loads(shared("icra2023_published_fits.json").read_text())["2022-08_paper"]["bias_spline_m"]
    lifted, bias = samples.T
    # Four coefficients between the ends of the data are one cubic.
    knots = np.repeat([lifted.min(), lifted.max()], 4)
    coefficients = np.linalg.lstsq(basis(lifted, knots), bias, rcond=None)[0]
    theirs = BSpline(np.array(published["knots"]), np.array(published["coeffs"]), published["degree"])
    grid = np.sort(lifted)
    grid = grid[(grid >= published["knots"][0]) & (grid <= published["knots"][-1])]
    difference = basis(grid, knots) @ coefficients - theirs(grid)
    assert np.sqrt(np.mean(difference**2)) < 0.005
