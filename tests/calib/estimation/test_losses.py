"""Robust losses: their weights and slopes, and losses of one's own."""

import numpy as np
import pytest

import calib
from calib.errors import BadInputError
from calib.estimation.fitting import fit
from calib.estimation.losses import LOSSES, register_loss
from calib.estimation.robust import design, robust_fit
from tests.calib.synthetic import DELAYS_NS, ranges


@pytest.mark.parametrize("loss", sorted(LOSSES))
def test_weight_and_slope_are_derivatives_of_one_score(loss):
    u = np.array([-4.0, -1.5, -0.5, 0.0, 0.3, 0.9, 2.5])
    weight, slope = LOSSES[loss](u)
    step = 1e-6
    score = [(LOSSES[loss](u + s)[0]) * (u + s) for s in (-step, step)]
    np.testing.assert_allclose((score[1] - score[0]) / (2 * step), slope, atol=1e-6)
    assert np.all(weight > 0)


def welsch(u):
    weight = np.exp(-(u**2) / 2)
    return weight, weight * (1 - u**2)


@pytest.fixture
def own_loss():
    register_loss("welsch", welsch)
    yield "welsch"
    del LOSSES["welsch"]


def test_a_loss_of_ones_own_is_fitted_with(own_loss):
    r = ranges(3000)
    result = fit(r, loss=own_loss)
    assert result.calibration.loss == "welsch"
    error = r.raw_m - r.truth_m
    matrix = design(r, r.tags())
    x = robust_fit(matrix, error, own_loss, 0.03).parameters
    u = (error + matrix @ x) / 0.03
    # At the optimum of this loss, and of no other, its scores cancel.
    np.testing.assert_allclose(matrix.T @ (u * np.exp(-(u**2) / 2)), 0, atol=1e-6 * len(r))
    assert np.all(np.abs(matrix.T @ (u / (1 + u**2))) > 1e-3)
    found = np.array([result.calibration.delays_ns[tag] for tag in DELAYS_NS])
    away = found - list(DELAYS_NS.values())
    # A shift common to all is the curve's constant; 50 ps are five standard errors.
    np.testing.assert_allclose(away - away.mean(), 0, atol=0.05)


@pytest.mark.parametrize(
    ("name", "loss", "fragment"),
    [
        ("cauchy", welsch, "there already"),
        ("mixture", welsch, "there already"),
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


def test_the_front_door_has_the_same_function():
    assert calib.register_loss is register_loss
