"""Motion as unknowns against what it is defined by: splines, distances and what is known, by finite differences."""

import numpy as np
import pytest

from calib.estimator.rows import NormalRows
from calib.estimator.unknowns import Layout
from calib.settings import FlightSettings
from calib.trajectories.motion import Distances, Grid, Motion, known_rows
from calib.trajectories.scene import scene_from
from calib.trajectories.search import Cauchy, Coarseness
from tests.calib.trajectories.sines import flight
from uwblink import KnownDistance

CEILING = [[3.5, 3.5, 2.6], [-3.5, 3.5, 2.6], [-3.5, -3.5, 2.6], [3.5, -3.5, 2.6]]


def test_splines_sum_to_one_and_reproduce_lines_and_a_parabola():
    grid, time = Grid(1.6, 0.4, 20), np.linspace(2.0, 8.8, 50)
    point, share = grid.cubic(time)
    assert np.allclose(share.sum(axis=1), 1)
    # A uniform cubic spline of control points c(t)^2 - h^2/3 is t^2 (Schoenberg).
    points = grid.times_s**2 - grid.step_s**2 / 3
    assert np.allclose((share * points[point]).sum(axis=1), time**2)
    point, share = grid.cubic(time, 1)
    assert np.allclose((share * points[point]).sum(axis=1), 2 * time)
    point, share = grid.straight(time)
    assert np.allclose((share * (3 * grid.times_s + 1)[point]).sum(axis=1), 3 * time + 1)


@pytest.fixture(scope="module")
def laid_out():
    flown = flight(seconds=3.0, anchors=CEILING, height_off_m=0.1)
    tapes = (
        KnownDistance(11, 12, 7.0, 0.01),
        KnownDistance(1, 12, 3.0, 0.01, "0..1"),
        KnownDistance(3, 6, 2.0, 0.01, "1..2"),
    )
    scene = scene_from(flown, FlightSettings(poses_until_s=1.0, anchors="sought", distances=tapes))
    motion = Motion.of(scene)
    layout = Layout(motion.unknowns({}, 8.0))
    rng = np.random.default_rng(2)
    x = 3 * rng.normal(size=layout.size)
    # Turns are linear to first order only: at 1e-4 rad to a ten-thousandth of a lever arm.
    x[layout.where["turn"]] *= 1e-4
    return scene, motion, layout, x


def test_twice_as_many_control_points_make_the_same_paths(laid_out):
    scene, motion, layout, x = laid_out
    state = motion.state(layout, x)
    finer, again = motion.refined(state)
    time = np.linspace(scene.time_s[0], scene.time_s[-1], 200)
    assert finer.places.step_s == motion.places.step_s / 2
    assert np.allclose(finer.positions(again["path"], time), motion.positions(state["path"], time))


def test_distances_and_rows_have_the_derivatives_of_finite_differences(laid_out):
    scene, motion, layout, x = laid_out
    geometry = Distances.of(motion, layout, (scene.ranges.initiator, scene.ranges.target), scene.time_s)
    rows = known_rows(motion, layout)
    step = np.random.default_rng(3).normal(size=layout.size)
    ahead, behind = x + 1e-6 * step, x - 1e-6 * step
    moved = np.sum(geometry.distances(x)[1] * step[geometry.columns], axis=1)
    numeric = (geometry.distances(ahead)[0] - geometry.distances(behind)[0]) / 2e-6
    assert np.allclose(moved, numeric, atol=1e-3)
    assert {"place", "height", "tape"} <= rows.keys()
    for kind in rows.values():
        value = [sum(terms.value for terms in kind.terms(at)) for at in (ahead, behind)]
        slope = sum(float(np.sum(terms.slopes * step[terms.columns].T)) for terms in kind.terms(x))
        assert slope == pytest.approx((value[0] - value[1]) / 2e-6, rel=1e-3)


def test_nothing_that_is_known_pulls_where_everything_is_as_known(laid_out):
    _, motion, layout, _ = laid_out
    still = Layout(motion.unknowns({}, 8.0)).start()
    for name, kind in known_rows(motion, layout).items():
        if isinstance(kind, NormalRows):
            # Places and heights pull away from zero; there are places of the first second.
            assert np.any(kind.left(still)) == (name in ("place", "height"))


def test_the_slope_of_a_loss_is_its_derivative():
    loss, residual = Cauchy(0.1), np.array([-0.3, -0.05, 0.0, 0.02, 0.4])
    value, by, tells = loss.slopes({"residual": residual})
    step = 1e-6
    numeric = (loss.slopes({"residual": residual + step})[0] - value) / step
    assert by["residual"] == pytest.approx(numeric, abs=1e-3)
    assert tells is not None
    assert (tells > 0).all()


def test_coarseness_matters_only_where_it_is_sure_and_large():
    assert Coarseness(5.0, 0.02).shows
    assert not Coarseness(5.0, 0.005).shows
    assert not Coarseness(3.0, 0.02).shows
