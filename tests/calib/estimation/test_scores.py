"""Slopes of the likelihood against differences of it, and sums of them against sums written out."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import exponnorm

from calib.estimation.design import Design
from calib.estimation.mixture_slopes import Errors, Layout, sums_at
from calib.estimation.pair_mixture import fit_pair_mixture
from calib.estimation.reflections import Shape, expected
from calib.estimation.scores import Scores, Sort, inverse_of


def errors(n=600, pairs=3, seed=4):
    rng = np.random.default_rng(seed)
    error = rng.normal(0, 0.08, n) + (rng.random(n) < 0.2) * rng.exponential(0.3, n)
    return Errors.of(error, rng.normal(size=(n, 2)), rng.integers(0, 8 * pairs, n), pairs)


def test_slopes_are_those_of_the_likelihood():
    some, layout = errors(), Layout(columns=2, pairs=3)
    rng = np.random.default_rng(1)
    theta = rng.normal(0, 0.1, layout.slices()["pair_mean"].stop)
    for name, start in (("mean", np.log(0.3)), ("least", np.log(0.05)), ("outliers", -4), ("cell_noise", -2.4)):
        theta[layout.slices()[name]] += start
    sums, _ = sums_at(some, layout, theta, squares=False)
    step, found = 1e-6, []
    for k in range(len(theta)):
        moved = np.eye(len(theta))[k] * step
        up, down = (sums_at(some, layout, at, squares=False)[1] for at in (theta + moved, theta - moved))
        found.append((up - down) / (2 * step))
    np.testing.assert_allclose(sums.gradient(), found, rtol=1e-5, atol=1e-4)


def test_the_density_is_that_of_scipy():
    e = np.linspace(-0.6, 6, 400)
    shape = Shape(
        sigma_m=np.full(400, 0.08),
        tail_share=np.full(400, 0.25),
        mean_m=np.full(400, 0.3),
        least_m=0.1,
        outlier_share=0.02,
        outlier_density=0.1,
    )
    core = np.exp(-0.5 * (e / 0.08) ** 2) / np.sqrt(2 * np.pi) / 0.08
    tail = exponnorm.pdf(e, 0.3 / 0.08, loc=0.1, scale=0.08)
    whole = 0.98 * (0.75 * core + 0.25 * tail) + 0.02 * 0.1
    np.testing.assert_allclose(np.exp(expected(e, shape).log_density), whole, rtol=1e-6)


@pytest.fixture
def scores():
    rng = np.random.default_rng(2)
    n = 500
    place = rng.integers(0, 8, n)
    design = Design.whole(rng.normal(size=(n, 3))).blocked(place)
    return Scores(
        design=design,
        score=rng.normal(size=n),
        slopes=tuple(rng.normal(size=(3, n))),
        place=design.first_of(design.kept(place)),
        places=8,
        sorts=(
            Sort(slope=0),
            Sort(slope=1, whose=np.arange(8) // 2, count=4),
            Sort(slope=2, whose=np.arange(8) // 2, count=4),
            Sort(slope=1, whose=np.arange(8) % 2, count=2),
        ),
    )


def rows_of(scores):
    """The design in the order of its kept rows."""
    return scores.design.written_out()[scores.design.order]


def written_out(scores):
    """The matrix that `Scores` never builds."""
    columns = [rows_of(scores) * scores.score[:, None]]
    place = np.repeat(scores.place, scores.design.counts)
    for sort in scores.sorts:
        whose = np.zeros(8, dtype=int) if sort.whose is None else sort.whose
        columns.append(np.eye(sort.count)[whose[place]] * scores.slopes[sort.slope][:, None])
    return np.hstack(columns)


def test_sums_are_those_of_the_matrix_written_out(scores):
    matrix = written_out(scores)
    np.testing.assert_allclose(scores.gradient(), matrix.sum(axis=0), atol=1e-9)
    blocks = np.random.default_rng(9).integers(0, 17, 500)
    expected_sums = np.array([matrix[blocks == b].sum(axis=0) for b in range(17)])
    np.testing.assert_allclose(scores.by_block(blocks, 17), expected_sums, atol=1e-9)
    np.testing.assert_allclose(scores.information(), matrix.T @ matrix, atol=1e-9)


def test_a_curvature_of_its_own_is_that_of_the_design(scores):
    curvature = np.random.default_rng(7).uniform(0.5, 1, 500)
    square = (rows_of(scores) * curvature[:, None]).T @ rows_of(scores)
    plain = replace(scores, curvature=curvature)
    np.testing.assert_allclose(plain.information()[:3, :3], square, atol=1e-9)
    np.testing.assert_allclose(replace(plain, sorts=(), slopes=()).information(), square, atol=1e-9)


def test_offsets_of_groups_are_linked_as_columns_would_be(scores):
    rng = np.random.default_rng(3)
    weight, stretch = rng.normal(size=500), np.arange(500) // 90
    runs = scores.design.runs(stretch)
    ends = [(rng.integers(0, 5, len(runs.block)), sign) for sign in (1.0, -1.0)]
    offsets = sum(sign * np.eye(5)[runs.rows(place)] for place, sign in ends) * weight[:, None]
    link = scores.linked(weight, runs, ends, 5)
    np.testing.assert_allclose(link[:, :3], (offsets * scores.score[:, None] ** 2).T @ rows_of(scores), atol=1e-9)
    rest = (offsets * scores.score[:, None]).T @ written_out(scores)[:, 3:]
    np.testing.assert_allclose(link[:, 3:], rest, atol=1e-9)


def test_the_inverse_of_metres_beside_logarithms():
    rng = np.random.default_rng(5)
    root = rng.normal(size=(30, 6)) * np.array([1e6, 1, 1e-4, 1, 1e3, 1])
    matrix = root.T @ root
    size = np.sqrt(np.diag(matrix))
    both = np.outer(size, size)
    np.testing.assert_allclose(inverse_of(matrix) * both, np.linalg.inv(matrix / both), rtol=1e-6)


def test_eliminating_places_first_gives_the_same_inverse():
    rng = np.random.default_rng(6)
    places, sorts, common = 7, 3, 5
    columns = [rng.normal(size=(400, common))]
    place = rng.integers(0, places, 400)
    columns += [np.eye(places)[place] * rng.normal(size=(400, 1)) for _ in range(sorts)]
    matrix = np.hstack(columns).T @ np.hstack(columns) + np.eye(common + places * sorts)
    np.testing.assert_allclose(inverse_of(matrix, places, sorts), np.linalg.inv(matrix), rtol=1e-6, atol=1e-9)


def test_where_reflections_last_pairs_are_drawn_together():
    rng = np.random.default_rng(8)
    some = errors(n=3000, pairs=6)
    pair = np.repeat(some.place // 8, some.design.counts)
    reflected = rng.random(3000) < np.linspace(0.05, 0.5, 6)[pair]
    some = replace(some, error=rng.normal(0, 0.05, 3000) + reflected * rng.exponential(0.4, 3000))
    nothing = np.zeros(2), np.eye(2)
    spread = [np.std(fit_pair_mixture(some, *nothing, lasting).of("pair_share")) for lasting in (1.0, 30.0)]
    # Were each range worth a thirtieth, a pair's share would be known to a fifth of its odds.
    assert spread[1] < 0.8 * spread[0]
