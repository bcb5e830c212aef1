"""Knots of curves, and what is not known of their smoothness."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.worlds import CLEAN, PLANTED, Recipe, make
from calib import fit
from calib.estimation.smoothing import unsure


def test_not_knowing_the_smoothness_adds_what_another_would_change():
    rng = np.random.default_rng(1)
    root, aim = rng.normal(size=(40, 6)), rng.normal(size=6)
    square, rough = root.T @ root, np.diag([0.0, 0.0, 1.0, 2.0, 3.0, 4.0])

    def optimum(log_weight):
        return np.linalg.solve(square + np.exp(log_weight) * rough, aim)

    step, covariance = 1e-5, np.linalg.inv(square + 9 * rough)
    slope = (optimum(np.log(9) + step) - optimum(np.log(9) - step)) / (2 * step)
    free = 4 - np.trace(covariance @ (9 * rough))
    found = unsure(covariance, optimum(np.log(9)), [9 * rough])
    np.testing.assert_allclose(found, np.outer(slope, slope) * 2 / max(free, 1), rtol=1e-6, atol=1e-12)


@pytest.fixture(scope="module")
def decades():
    world = make(replace(CLEAN["twenty tags"], seconds=120), 203)
    return world, fit(world.ranges).calibration


def test_powers_over_more_decades_have_more_knots_and_dense_ones_where_weak(decades):
    narrow = np.unique(fit(make(CLEAN["narrow power"], 1).ranges).calibration.bias_curve.knots)
    wide = np.unique(decades[1].bias_curve.knots)
    assert len(narrow) < 15 < 24 < len(wide)
    gaps = np.diff(wide)
    assert gaps[0] < 0.1 * gaps[-1]


def test_bands_hold_where_powers_spread_over_decades(decades):
    world, known = decades
    grid = np.quantile(world.lifted, np.linspace(0.01, 0.99, 60))
    wrong, band = known.bias_curve(grid) - world.bias_m(grid), known.band(grid, "bias")
    # With fourteen pieces between equal lengths it was a fifth.
    assert np.mean(np.abs(wrong - wrong.mean()) < 1.96 * band) > 0.7


@pytest.mark.parametrize("seed", [403])
def test_decibels_that_show_faintly_are_named(seed):
    world = PLANTED["a tag 3 dB high"](make(Recipe(), seed))
    assert any("tag 2" in text and "decibels" in text for text in fit(world.ranges).warnings)
