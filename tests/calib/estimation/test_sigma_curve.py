"""The curve of standard deviation: least squares above a floor against scipy's, and the smoothness against its rule."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from calib.errors import UnanswerableError
from calib.estimation.sigma_curve import FEWEST, _above, _penalised
from calib.fitting.fitting import fit
from tests.calib.synthetic import ranges

FLOOR = 0.1
TRIED = 10.0 ** np.arange(-6.0, 2.5, 0.5)


@pytest.mark.parametrize("seed", range(8))
def test_least_squares_above_a_floor_is_scipys(seed):
    rng = np.random.default_rng(seed)
    # Columns that share much, so that coefficients are held and let go again.
    matrix = rng.normal(size=(40, 9)) + 2 * rng.normal(size=(40, 1))
    aim = matrix @ (FLOOR + rng.normal(size=9)) + rng.normal(size=40)
    expected = lsq_linear(matrix, aim, bounds=(FLOOR, np.inf), tol=1e-14, method="bvls").x
    assert np.count_nonzero(expected < FLOOR + 1e-9) > 1
    found = _above(matrix.T @ matrix, matrix.T @ aim, FLOOR)
    np.testing.assert_allclose(found, expected, atol=1e-8)
    assert found.min() >= FLOOR


def test_what_was_held_too_early_is_let_go():
    # Without bounds the first two are below; with the second held, the first is not.
    matrix = np.array([[1.0, 1.5, 0.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    released = 0
    for seed in range(200):
        aim = np.random.default_rng(seed).normal(size=3)
        expected = lsq_linear(matrix, aim, bounds=(0.0, np.inf), tol=1e-14, method="bvls").x
        below = np.linalg.solve(matrix, aim) < 0
        released += int((below & (expected > 1e-6)).any())
        np.testing.assert_allclose(_above(matrix.T @ matrix, matrix.T @ aim, 0.0), expected, atol=1e-9)
    assert released > 10


def bumps(rng, count=60):
    """A curve with a bend seen through noise of unequal size, in ten shapes of rising roughness."""
    place = np.linspace(-1, 1, count)
    weight = rng.uniform(0.3, 3.0, count)
    design = np.polynomial.chebyshev.chebvander(place, 9)
    aim = 2.0 + 0.5 * np.abs(place) + 0.05 * rng.normal(size=count) / np.sqrt(weight)
    return design, aim, weight, np.diag(np.arange(10.0) ** 4 / 2e4)


def by_rule(design, aim, weight, penalty):
    """Generalised cross-validation, written out with hat matrices: coefficients, covariance, chosen smoothness."""
    root, tries = np.sqrt(weight)[:, None] * design, []
    for smoothness in TRIED * len(aim):
        whole = root.T @ root + smoothness * penalty
        hat = root @ np.linalg.solve(whole, root.T)
        left = np.sum((np.sqrt(weight) * aim - hat @ (np.sqrt(weight) * aim)) ** 2)
        free = len(aim) - np.trace(hat)
        tries.append((left / (free / len(aim)) ** 2, smoothness, left / free * np.linalg.inv(whole), whole))
    _, smoothness, covariance, whole = min(tries, key=lambda one: one[0])
    return np.linalg.solve(whole, root.T @ (np.sqrt(weight) * aim)), covariance, smoothness / len(aim)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_smoothness_is_that_of_generalised_cross_validation(seed):
    case = bumps(np.random.default_rng(seed))
    # Far above the floor: an even curve of 2 with other shapes around zero would be held there.
    shifted = (case[0] + 0.0, case[1], case[2], case[3])
    expected, covariance, chosen = by_rule(*shifted)
    assert TRIED[0] < chosen < TRIED[-1]
    found, found_covariance = _penalised(*shifted)
    np.testing.assert_allclose(found_covariance, covariance, rtol=1e-5, atol=1e-12)
    free = expected > found.min() + 1e-6
    assert free[0]
    # With what is held below its best, the others settle where least squares above the floor has them.
    square = shifted[0].T @ (shifted[2][:, None] * shifted[0]) + chosen * len(shifted[1]) * shifted[3]
    root = np.linalg.cholesky(square).T
    bounded = lsq_linear(
        root, np.linalg.solve(root.T, shifted[0].T @ (shifted[2] * shifted[1])), (found.min(), np.inf), tol=1e-14
    ).x
    np.testing.assert_allclose(found, bounded, atol=1e-5)


def test_what_no_bin_and_no_penalty_holds_is_held_by_a_billionth_of_what_bins_hold():
    design, aim, weight, penalty = bumps(np.random.default_rng(4))
    apart = np.zeros((11, 11))
    apart[:10, :10] = penalty
    _, covariance = _penalised(np.column_stack([design, np.zeros(len(aim))]), aim, weight, apart)
    _, known, chosen = by_rule(design, aim, weight, penalty)
    square = design.T @ (weight[:, None] * design)
    dispersion = known[0, 0] / np.linalg.inv(square + chosen * len(aim) * penalty)[0, 0]
    assert covariance[10, 10] == pytest.approx(dispersion / (1e-9 * np.trace(square) / 11), rel=1e-3)


@pytest.mark.parametrize("count", [FEWEST - 1, FEWEST])
def test_a_group_has_a_curve_from_the_fewest_ranges_on(count):
    r = ranges(3000)
    rare = (r.initiator != 7) & (r.target != 7)
    rare[np.flatnonzero(~rare)[:count]] = True
    groups = {"a": (1, 2, 3), "b": (7,)}
    if count < FEWEST:
        with pytest.raises(UnanswerableError, match="group 'b' has too few ranges"):
            fit(r[rare], groups=groups, loss="cauchy")
    else:
        assert set(fit(r[rare], groups=groups, loss="cauchy").calibration.groups) == {"a", "b"}
