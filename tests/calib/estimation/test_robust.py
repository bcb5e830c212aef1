"""The robust fit against an independent optimiser, and against what was planted."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from calib.estimation.robust import robust_fit, sandwich
from calib.estimator.losses import LOSSES
from tests.calib.synthetic import DELAYS_NS, design, ranges
from uwblink.ticks import SPEED_OF_LIGHT

METRES_A_NS = SPEED_OF_LIGHT * 1e-9


@pytest.mark.parametrize("loss", ["cauchy", "huber", "soft_l1"])
@pytest.mark.parametrize("scale_ns", [0.05, 0.1, 1.0])
def test_same_optimum_as_scipy(loss, scale_ns):
    r = ranges(1500)
    tags = r.tags()
    matrix = design(r, tags)
    error = r.raw_m - r.truth_m
    found = robust_fit(matrix, error, loss, scale_ns * METRES_A_NS)
    # Three restarts: the oracle stops at its own tolerance, and each start after that refines it.
    x = found.parameters + 0.02

    def residual(d):
        return error + matrix @ d

    def slope(_):
        return matrix.copy()  # some versions of SciPy weigh it in place

    for _ in range(3):
        x = least_squares(
            residual, x, jac=slope, loss=loss, f_scale=scale_ns * METRES_A_NS,
            xtol=1e-15, ftol=1e-15, gtol=1e-15,
        ).x  # fmt: skip
    assert found.success
    np.testing.assert_allclose(found.parameters, x, atol=1e-6)


def test_without_noise_the_delays_are_exact():
    r = ranges(600, noise_m=0.0, tail=0.1, bias=lambda lifted: 0 * lifted)
    found = robust_fit(design(r, r.tags()), r.raw_m - r.truth_m, "cauchy")
    np.testing.assert_allclose(found.parameters, list(DELAYS_NS.values()), atol=1e-4)


def test_standard_errors_hold_under_a_heavy_tail():
    errors = []
    for seed in range(60):
        r = ranges(1200, seed=seed, bias=lambda lifted: 0 * lifted)
        # A tail on one side moves the optimum; a symmetric one does not, and tests the spread alone.
        flip = np.where(np.random.default_rng(seed + 1000).random(len(r)) < 0.5, -1, 1)
        error = (r.raw_m - r.truth_m + design(r, r.tags()) @ list(DELAYS_NS.values())) * flip
        found = robust_fit(design(r, r.tags()), error, "cauchy")
        covariance = sandwich(design(r, r.tags()), found.residuals, LOSSES["cauchy"], found.scale)
        errors.append(found.parameters / np.sqrt(np.diag(covariance)))
    # 240 scores know their spread to 5 %; four sigma of that are 20 %.
    assert np.std(errors) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("scale_ns", [0.005, 0.02, 0.5, 20.0])
def test_any_scale_converges_to_something_sensible(scale_ns):
    r = ranges(3000)
    found = robust_fit(design(r, r.tags()), r.raw_m - r.truth_m, "cauchy", scale_ns * METRES_A_NS)
    assert np.all(np.abs(found.parameters - list(DELAYS_NS.values())) < 0.5)


def test_residuals_are_what_is_left_of_the_errors():
    r = ranges(600)
    matrix, error = design(r, r.tags()), r.raw_m - r.truth_m
    found = robust_fit(matrix, error, "cauchy")
    # Each step adds to them; what rounding leaves of that is far below anything measured.
    np.testing.assert_allclose(found.residuals, error + matrix @ found.parameters, rtol=0, atol=1e-13)
