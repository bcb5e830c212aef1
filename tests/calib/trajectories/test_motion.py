"""Motion as unknowns: derivatives of distances and known facts, compared with finite differences."""

import numpy as np
import pytest

from calib.estimator.unknowns import Layout
from calib.settings import FlightSettings
from calib.trajectories.motion import Distances, Motion, known_rows
from calib.trajectories.scene import scene_from
from tests.calib.trajectories.sines import flight
from uwblink import KnownDistance

CEILING = [[3.5, 3.5, 2.6], [-3.5, 3.5, 2.6], [-3.5, -3.5, 2.6], [3.5, -3.5, 2.6]]


def readings(flown):
    """Return inertial readings of robot0, which is at rest except for a sine."""
    time_s = np.arange(0.0, 4.0, 0.01)
    wave = np.sin(5 * time_s)
    columns = {f"w{axis}": 0.1 * wave for axis in "xyz"} | {"ax": wave, "ay": 0.5 * wave, "az": 9.81 + 0 * wave}
    return {"time_ns": np.rint(time_s * 1e9).astype(np.int64), "body": np.full(len(time_s), "robot0"), **columns}


@pytest.fixture(scope="module")
def laid_out():
    flown = flight(seconds=3.0, anchors=CEILING, height_off_m=0.1)
    flown.imu = readings(flown)
    tapes = (
        KnownDistance(11, 12, 7.0, 0.01),
        KnownDistance(1, 12, 3.0, 0.01, "0..1"),
        KnownDistance(3, 6, 2.0, 0.01, "1..2"),
    )
    scene = scene_from(flown, FlightSettings(poses_until_s=1.0, anchors="sought", distances=tapes))
    motion = Motion.of(scene)
    layout = Layout(motion.unknowns({}, 8.0))
    x = 3 * np.random.default_rng(2).normal(size=layout.size)
    # Rotations are linear to first order only: at 1e-4 rad to a ten-thousandth of a lever arm.
    x[layout.where["turn"]] *= 1e-4
    return scene, motion, layout, x


def test_doubled_control_points_give_the_same_paths(laid_out):
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
    moved = geometry.derivatives(x, np.arange(len(scene.time_s))) @ step
    assert np.allclose(moved, (geometry.distances(ahead)[0] - geometry.distances(behind)[0]) / 2e-6, atol=1e-3)
    assert rows.keys() == {"place", "force robot0", "height", "tape"}
    for kind in rows.values():
        value = [sum(terms.value for terms in kind.terms(at)) for at in (ahead, behind)]
        slope = sum(float(np.sum(terms.slopes * step[terms.columns].T)) for terms in kind.terms(x))
        assert slope == pytest.approx((value[0] - value[1]) / 2e-6, rel=1e-3)
