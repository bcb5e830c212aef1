"""Designs kept as few entries in blocks, against the same matrices written out."""

import numpy as np
import pytest

from calib.calibration.power_curves import basis, lifted_power
from calib.estimation import design as designs
from calib.estimation.building import build_problem
from calib.estimation.design import Design
from calib.estimation.row_order import stable_order
from tests.calib.synthetic import design as written
from tests.calib.synthetic import ranges


def problem_of(some, fixed=None, groups=None):
    return build_problem(
        some, lift="mean-of-lifted", alpha_dbm=-82.0, fixed=fixed or {}, groups=groups or {}, minimum_norm=False
    )


@pytest.fixture(params=[64, 8192], ids=["short pieces", "long pieces"])
def kept(request, monkeypatch):
    """A design of 900 rows in another order, with the matrix written out by hand."""
    monkeypatch.setattr(designs, "ROWS_AT_ONCE", request.param)
    rng = np.random.default_rng(1)
    starts = np.array([0, 10, 11, 400, 900])
    columns = np.array([[0, 2, 3], [1, 3, 4], [0, 1, 4], [2, 0, 1]])
    values, order, turn = rng.normal(size=(3, 900)), rng.permutation(900), rng.normal(size=(5, 4))
    raw = np.zeros((900, 5))
    for block, own in enumerate(columns):
        for k in range(starts[block], starts[block + 1]):
            raw[order[k], own] = values[:, k]
    return Design(values, order, starts, columns, turn).in_short_blocks(), raw @ turn


def test_products_and_sums_are_those_of_the_matrix(kept):
    design, matrix = kept
    rng = np.random.default_rng(2)
    x, weight = rng.normal(size=4), rng.normal(size=900)
    np.testing.assert_allclose(design.written_out(), matrix, atol=1e-12)
    np.testing.assert_allclose(design @ x, matrix @ x, atol=1e-12)
    np.testing.assert_allclose(design.pull(design.kept(weight)), matrix.T @ weight, atol=1e-10)
    square = (matrix * weight[:, None]).T @ matrix
    np.testing.assert_allclose(design.normal(design.kept(weight)), square, atol=1e-10)
    group = rng.integers(0, 7, 900)
    sums = [(matrix * weight[:, None])[group == k].sum(axis=0) for k in range(7)]
    np.testing.assert_allclose(design.by_group(design.kept(weight), design.kept(group), 7), sums, atol=1e-10)


def test_parts_samples_and_finer_blocks_are_of_the_same_matrix(kept):
    design, matrix = kept
    rng = np.random.default_rng(3)
    np.testing.assert_allclose(design.part(slice(1, 3)).written_out(), matrix[:, 1:3], atol=1e-12)
    rows = np.sort(rng.choice(900, 200, replace=False))
    np.testing.assert_allclose(design.sample(rows).written_out(), matrix[rows], atol=1e-12)
    np.testing.assert_allclose(design.sample(matrix[:, 0] > 0).written_out(), matrix[matrix[:, 0] > 0], atol=1e-12)
    place = rng.integers(0, 6, 900)
    finer = design.blocked(place)
    np.testing.assert_allclose(finer.written_out(), matrix, atol=1e-12)
    assert all(len(np.unique(part)) == 1 for part in np.split(finer.kept(place), finer.starts[1:-1]))


def test_sorting_by_digits_is_stable():
    key = np.random.default_rng(4).integers(0, 3_000_000, 5000) // 1000 * 1000
    np.testing.assert_array_equal(stable_order(key), np.argsort(key, kind="stable"))


@pytest.mark.parametrize("groups", [{}, {"first": (1, 2), "second": (3, 7)}])
@pytest.mark.parametrize("fixed", [{}, {2: 0.1}])
def test_a_fit_is_linear_in_delays_and_splines(groups, fixed):
    problem = problem_of(ranges(2000), fixed, groups)
    some = problem.ranges
    lifted = lifted_power(some.fpp1_dbm, some.fpp2_dbm, "mean-of-lifted", -82.0)
    parts = [written(some, [tag for tag in some.tags() if tag not in fixed])]
    for k, tags in enumerate(groups.values() or [tuple(some.tags())]):
        share = 0.5 * np.isin(some.initiator, tags) + 0.5 * np.isin(some.target, tags)
        parts.append(share[:, None] * (problem.centres[k] - basis(lifted, problem.knots)))
    np.testing.assert_allclose(problem.design.written_out(), np.hstack(parts), atol=1e-12)
    known = written(some, list(fixed)) @ list(fixed.values()) if fixed else 0.0
    np.testing.assert_allclose(problem.error, some.raw_m - some.truth_m + known, atol=1e-12)


def test_blocks_hold_one_pair_and_one_step_of_power():
    problem = problem_of(ranges(3000))
    place = problem.pairs.number * 8 + problem.cell
    assert problem.design.blocked(place) is problem.design
