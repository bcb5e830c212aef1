"""What the parts of a fit are, each against a formula of its own."""

from dataclasses import replace

import numpy as np
import pytest

from calib.estimation import robust, solver
from calib.estimation.identifiability import UNDETERMINED, identifiable_directions
from calib.estimation.robust import quadratic_model, robust_fit, sandwich
from calib.estimation.smoothing import reml_penalty
from calib.estimation.solver import PILOT, _first_ridge, _pilot, solve
from calib.estimator.losses import LOSSES
from calib.fitting.fitting import fit
from tests.calib.estimation.test_solver import problem_of
from tests.calib.synthetic import ranges


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def test_dispersion_is_the_variance_of_errors_under_least_squares_and_grows_as_their_square(rng):
    matrix, residual = rng.normal(size=(500, 3)), rng.normal(size=500) * 0.05
    near = quadratic_model(matrix, residual, "l2", 1.0)
    assert near.dispersion == pytest.approx(np.mean(residual**2))
    np.testing.assert_allclose(near.curvature, matrix.T @ matrix)
    np.testing.assert_allclose(near.pull, -(matrix.T @ residual))
    wider = quadratic_model(matrix, 10 * residual, "cauchy", 0.5)
    assert wider.dispersion == pytest.approx(100 * quadratic_model(matrix, residual, "cauchy", 0.05).dispersion)


def test_the_smoothness_does_not_depend_on_the_unit_of_the_errors(rng):
    # A line with a bend, seen through noise: in other units the curve is the same curve, and the penalty as it was.
    place = np.linspace(-1, 1, 400)
    matrix = np.asarray(np.polynomial.chebyshev.chebvander(place, 9), np.float64)
    error = -(0.3 * np.abs(place) + rng.normal(size=400) * 0.05)
    penalty = np.diag(np.arange(10.0) ** 4)
    found = {}
    for unit in (1.0, 100.0):
        near = quadratic_model(matrix, unit * error, "l2", unit)
        found[unit] = reml_penalty(near, np.zeros(10), [penalty])
    np.testing.assert_allclose(found[100.0][0], found[1.0][0], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found[100.0][1], 100 * found[1.0][1], rtol=1e-6)
    # Noisier errors are smoothed more: what is estimated bends less, and its penalty weighs more.
    noisier = quadratic_model(matrix, error + rng.normal(size=400) * 0.5, "l2", 1.0)
    assert np.trace(reml_penalty(noisier, np.zeros(10), [penalty])[0]) > 2 * np.trace(found[1.0][0])


def test_what_only_a_penalty_holds_is_as_unsure_as_the_penalty_says(rng):
    # The second column is in no row: its parameter is known beforehand with the variance dispersion/ridge.
    matrix = np.column_stack([np.ones(1000), np.zeros(1000)])
    residual = rng.normal(size=1000) * 0.2
    residual -= residual.mean()
    covariance = sandwich(matrix, residual, LOSSES["l2"], 1.0, np.diag([0.0, 4.0]))
    variance = np.mean(residual**2)
    np.testing.assert_allclose(np.diag(covariance), [variance / 1000, variance / 4], rtol=1e-9)
    assert covariance[0, 1] == 0


def test_a_fit_that_is_cut_short_says_so(monkeypatch, rng):
    problem = problem_of(ranges(3000))
    whole = solve(problem, "cauchy", None, sequential=False)
    assert whole.success
    assert solve(problem, "cauchy", None, sequential=True).success
    monkeypatch.setattr(robust, "MAX_STEPS", 1)
    for sequential in (False, True):
        assert not solve(problem, "cauchy", None, sequential=sequential).success
    cut = robust_fit(np.ones((50, 1)), rng.normal(size=50), "cauchy")
    assert (cut.success, cut.steps) == (False, 1)


@pytest.mark.parametrize("cut", [1, 3])
def test_either_step_of_a_fit_one_after_the_other_that_is_cut_short_makes_it_so(cut, monkeypatch):
    """Delays are the first search, a start of the curve the second, the curve the third."""
    calls, plain = [], robust_fit

    def search(*given, **settings):
        calls.append(1)
        found = plain(*given, **settings)
        return replace(found, success=found.success and len(calls) != cut)

    monkeypatch.setattr(solver, "robust_fit", search)
    assert not solve(problem_of(ranges(3000)), "cauchy", None, sequential=True).success
    assert len(calls) == 3


def test_the_first_penalty_is_a_share_of_what_ranges_say_and_holds_curves_alone():
    problem = problem_of(ranges(3000))
    (rough,), rank = problem.penalties(), problem.rank
    found = _first_ridge(problem, 500)
    assert not found[:rank].any()
    expected = 500 * (1e-6 * rough / np.trace(rough) + 1e-9 * np.diag(np.arange(len(rough)) >= rank))
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=0)


def test_without_a_curve_there_is_nothing_to_come_after_the_delays():
    r = ranges(3000)
    known = {sequential: fit(r, delays_only=True, sequential=sequential, loss="cauchy") for sequential in (False, True)}
    assert known[True].calibration.delays_ns == known[False].calibration.delays_ns
    assert known[True].calibration.delays_std_ns == known[False].calibration.delays_std_ns


def test_the_sample_sees_all_of_a_recording_whatever_its_order():
    # One pair after the other, 4000 ranges each: neither the first rows nor every so manyth are a sample of them.
    r = ranges(4 * PILOT, tail=0.0)
    order = np.argsort(r.initiator * 10 + r.target, kind="stable")
    r = replace(r[order], time_ns=np.sort(r.time_ns))
    problem = problem_of(r)
    start, steps = _pilot(problem, "cauchy", None)
    residual = problem.error + problem.design @ start
    medians = [np.median(residual[problem.pairs.number == k]) for k in range(len(problem.pairs.ends))]
    # Errors of 5 cm, of which a pair has 1000 in the sample.
    assert np.abs(medians).max() < 0.01
    assert steps > 0
    again, _ = _pilot(problem, "cauchy", None)
    np.testing.assert_array_equal(start, again)


def weights_of(spread, rng):
    """Ranges of one pair whose clock ratios vary by `spread`; a change by +a and -a shows in them by that alone."""
    k = 1 + spread * rng.normal(size=2000)
    return np.column_stack([np.full(2000, 0.5), 0.5 * k]) * 0.3


@pytest.mark.parametrize(("spread", "free"), [(2e-5, True), (2e-3, False)])
def test_clock_ratios_of_parts_per_million_determine_nothing(spread, free, rng):
    matrix = weights_of(spread, rng)
    values = np.linalg.eigvalsh(matrix.T @ matrix)
    assert (values[0] < UNDETERMINED * values[-1]) == free
    directions, groups = identifiable_directions(matrix.T @ matrix, [4, 9], np.array([[4, 9]]))
    assert groups == ([[4, 9]] if free else [])
    assert directions.shape == (2, 1 if free else 2)


def test_bands_of_a_curve_fitted_after_the_delays_are_those_of_one_fitted_with_them():
    r = ranges(6000, tail=0.0)
    bands = {}
    for sequential in (False, True):
        c = fit(r, sequential=sequential, loss="cauchy").calibration
        grid = np.linspace(*c.bias_curve.range, 40)[3:-3]
        band = c.band(grid, "bias")
        assert band is not None
        bands[sequential] = np.median(band)
    # 6000 ranges with 5 cm of noise, some eight independent values of the curve: 2 mm.
    assert 0.001 < bands[True] < 0.005
    assert bands[True] == pytest.approx(bands[False], rel=0.5)
