"""Spreads of values, held against draws."""

import numpy as np
import pytest

from calib.spread import radius_95


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 0), (1, 0, 0), (4, 1, 0.1), (1, 0.5)], ids=str)
def test_the_radius_of_95_percent_contains_95_percent_of_draws(shape):
    rng = np.random.default_rng(1)
    turn = np.linalg.qr(rng.normal(size=(len(shape), len(shape))))[0]
    covariance = 0.03**2 * turn @ np.diag(shape) @ turn.T
    drawn = rng.normal(size=(200_000, len(shape))) * 0.03 * np.sqrt(shape) @ turn.T
    # The share of so many draws has a standard error of 0.05 %, and the approximation an error below 0.2 %.
    assert np.mean(np.linalg.norm(drawn, axis=1) < radius_95(covariance)) == pytest.approx(0.95, abs=0.004)


def test_without_variance_there_is_no_radius():
    assert radius_95(np.zeros((3, 3))) == 0.0
