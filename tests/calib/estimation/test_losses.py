"""Robust losses: their weights and slopes, and losses of one's own."""

import numpy as np
import pytest

from calib.errors import BadInputError
from calib.estimator.losses import LOSSES, register_loss
from calib.fitting.fitting import fit
from tests.calib.synthetic import DELAYS_NS, design, ranges
from uwblink.ticks import SPEED_OF_LIGHT


@pytest.mark.parametrize("loss", ["cauchy", "huber", "soft_l1", "l2"])
def test_weight_and_slope_are_derivatives_of_one_score(loss):
    u = np.array([-4.0, -1.5, -0.5, 0.0, 0.3, 0.9, 2.5])
    weight, slope = LOSSES[loss].weights(u)
    step = 1e-6
    score = [(LOSSES[loss].weights(u + s)[0]) * (u + s) for s in (-step, step)]
    np.testing.assert_allclose((score[1] - score[0]) / (2 * step), slope, atol=1e-6)
    assert np.all(weight > 0)


def welsch(u):
    weight = np.exp(-(u**2) / 2)
    return weight, weight * (1 - u**2)


@pytest.fixture
def own_loss():
    register_loss("welsch", welsch)
    yield "welsch"
    LOSSES.remove("welsch")


def test_a_loss_of_ones_own_is_fitted_with(own_loss):
    r = ranges(3000)
    result = fit(r, loss=own_loss)
    assert result.calibration.loss == "welsch"
    matrix, alone = design(r, r.tags()), fit(r, loss=own_loss, scale_ns=0.1, delays_only=True)
    u = alone.residuals_m / (0.1 * SPEED_OF_LIGHT * 1e-9)
    # At the optimum of this loss, and of no other, its scores cancel.
    assert np.abs(matrix.T @ (u * np.exp(-(u**2) / 2))).max() < 0.1 * np.abs(matrix.T @ (u / (1 + u**2))).max()
    found = np.array([result.calibration.delays_ns[tag] for tag in DELAYS_NS])
    away = found - list(DELAYS_NS.values())
    # A shift common to all is the curve's constant; 50 ps are five standard errors.
    np.testing.assert_allclose(away - away.mean(), 0, atol=0.05)


@pytest.mark.parametrize(
    ("name", "loss", "fragment"),
    [
        ("cauchy", welsch, "project's own"),
        ("mixture", welsch, "project's own"),
        ("wrong-slope", lambda u: (1 / (1 + u**2), 1 / (1 + u**2)), "slope at u"),
        ("one-array", lambda u: 1 / (1 + u**2), "two arrays"),
        ("numbers", lambda u: (1.0, 1.0), "one for each"),
        ("half", lambda u: (0.5 + 0 * u, 0.5 + 0 * u), "u = 0"),
        ("nan", lambda u: (u / 0.0 * 0, u), "finite"),
    ],
)
def test_a_loss_that_cannot_be_one_is_refused(name, loss, fragment):
    with np.errstate(all="ignore"), pytest.raises(BadInputError, match=fragment):
        register_loss(name, loss)
    assert name not in set(LOSSES) - {"cauchy"}


def test_a_registered_loss_is_replaced_only_when_asked(own_loss):
    with pytest.raises(BadInputError, match="registered already"):
        register_loss(own_loss, welsch)
    register_loss(own_loss, LOSSES["cauchy"].weights, replace=True)
    np.testing.assert_array_equal(LOSSES[own_loss].weights(np.ones(1)), LOSSES["cauchy"].weights(np.ones(1)))
