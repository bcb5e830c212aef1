"""Splines, arrows and rows against what they are defined by: sums to one, dense algebra, finite differences."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from calib.trajectories.arrow import Factored, normal_of
from calib.trajectories.given import Usable, scene_from
from calib.trajectories.known_rows import known_rows
from calib.trajectories.range_losses import Cauchy
from calib.trajectories.range_rows import range_rows
from calib.trajectories.splines import cubic, cubic_speed, grid_over, halved, straight
from calib.trajectories.unknowns import State, columns_of, refined
from tests.calib.trajectories.sines import flight


def test_cubic_splines_sum_to_one_and_reproduce_a_parabola():
    grid, time = grid_over(2.0, 9.0, 0.4, 1), np.linspace(2.0, 9.0, 50)
    weights = cubic(grid, time)
    assert np.allclose(weights.share.sum(axis=1), 1)
    # A uniform cubic spline of control points c(t)^2 - h^2/3 is t^2 (Schoenberg).
    points = grid.times_s**2 - grid.step_s**2 / 3
    assert np.allclose((weights.share * points[weights.point]).sum(axis=1), time**2)
    speed = cubic_speed(grid, time)
    assert np.allclose((speed.share * points[speed.point]).sum(axis=1), 2 * time)


def test_twice_as_many_control_points_make_the_same_spline():
    for begin in (2.0, -1.0):
        grid, finer = grid_over(begin, 8.7, 0.4, 1), grid_over(begin, 8.7, 0.2, 1)
        points = np.random.default_rng(0).normal(size=(grid.count, 2, 3))
        time = np.linspace(begin, 8.7, 200)
        coarse, fine = cubic(grid, time), cubic(finer, time)
        again = halved(grid, finer, points)
        values = (np.einsum("np,npba->nba", w.share, p[w.point]) for w, p in ((coarse, points), (fine, again)))
        assert np.allclose(*values)


def test_straight_lines_are_reproduced():
    grid, time = grid_over(0.0, 5.0, 1.0, 0), np.linspace(0, 5, 23)
    weights = straight(grid, time)
    assert np.allclose((weights.share * (3 * grid.times_s + 1)[weights.point]).sum(axis=1), 3 * time + 1)


def test_an_arrow_is_solved_as_the_dense_matrix_is():
    rng = np.random.default_rng(0)
    local = np.zeros((80, 20))
    for k in range(80):
        local[k, k * 17 // 80 : k * 17 // 80 + 4] = rng.normal(size=4)
    border, weight = rng.normal(size=(80, 3)), rng.uniform(0.5, 2, 80)
    found = Factored(normal_of(csr_array(local), border, weight))
    whole = np.hstack([local, border])
    dense = (whole * weight[:, None]).T @ whole
    right = rng.normal(size=23)
    assert np.allclose(np.concatenate(found.solve(right[:20], right[20:])), np.linalg.solve(dense, right), atol=1e-6)
    assert np.allclose(np.linalg.inv(found.schur), np.linalg.inv(dense)[20:, 20:], rtol=1e-6)


@pytest.fixture(scope="module")
def rows():
    anchors = [[3, 3, 0.3], [-3, 3, 2.0], [-3, -3, 0.5], [3, -3, 2.5]]
    scene = scene_from(flight(seconds=3.0, anchors=anchors), Usable(poses_until_s=1.0, anchors="sought"))
    columns = columns_of(scene, 2)
    design = np.random.default_rng(1).normal(size=(len(scene.time_s), 2))
    return scene, columns, range_rows(scene, columns, scene.ranges.raw_m, design)


def test_refined_trajectories_are_the_same(rows):
    scene, columns, ranges = rows
    rng = np.random.default_rng(3)
    state = State(rng.normal(size=columns.size), rng.normal(size=columns.border))
    finer = columns_of(scene, 2, columns.places.step_s / 2)
    again = range_rows(scene, finer, ranges.error, ranges.design)
    assert np.allclose(again.residuals(refined(columns, finer, state)), ranges.residuals(state))


def test_derivatives_are_those_of_finite_differences(rows):
    _, columns, ranges = rows
    rng = np.random.default_rng(2)
    state = State(rng.normal(size=columns.size), 3 * rng.normal(size=columns.border))
    state.local[columns.turn[columns.turn >= 0]] *= 1e-4
    _, local, border = ranges.linear(state)
    for _ in range(5):
        step = rng.normal(size=columns.size), rng.normal(size=columns.border)
        ahead, behind = (state.moved(*(sign * 1e-6 * part for part in step)) for sign in (1, -1))
        numeric = (ranges.residuals(ahead) - ranges.residuals(behind)) / 2e-6
        # Turns are linear to first order only: at 1e-4 rad to a ten-thousandth of a lever arm.
        assert np.allclose(local @ step[0] + border @ step[1], numeric, atol=3e-4)


def test_known_rows_are_zero_where_everything_is_as_known(rows):
    scene, columns, _ = rows
    state = State(np.zeros(columns.size), np.zeros(columns.border))
    found = known_rows(scene, columns, state)
    still = np.abs(found.residuals(state))
    # Only places that are known pull away from zero; there are those of the first second.
    assert (still > 0).sum() <= 3 * len(scene.places.time_s)
    assert scene.places.time_s.max() < 1.0


def test_the_slope_of_a_loss_is_its_derivative():
    loss, residual = Cauchy(0.1), np.array([-0.3, -0.05, 0.0, 0.02, 0.4])
    for k in range(5):
        step = 1e-6 * (np.arange(5) == k)
        numeric = (loss.cost(residual + step) - loss.cost(residual - step)) / 2e-6
        assert loss.slopes(residual)[0][k] == pytest.approx(numeric, abs=1e-4)
    assert (loss.slopes(residual)[1] > 0).all()
