"""Attitudes out of gyroscopes, and a fit that has nothing else: flights of the simulator, which shares none of it."""

from dataclasses import replace

import numpy as np
import pytest

import calib
import uwbsim
from calib.settings import FlightSettings
from calib.trajectories.samples import Attitude
from calib.trajectories.scene import scene_from
from calib.trajectories.start import interpolated, resolve_headings
from tests.calib.trajectories.sines import flight

pytestmark = pytest.mark.slow

BOXES = {"a": ([-2.6, -2.6, 0.4], [-0.4, -0.2, 2.6]), "b": ([0.4, -2.6, 0.4], [2.6, -0.2, 2.6])}
TWO_S = np.array([2.0])
IMU = {"grade": "consumer", "vibration_mps2": 1.0}


@pytest.fixture(scope="module")
def flown():
    bodies = [
        {"name": name, "motion": {"model": "random-flight", "box_min_m": low, "box_max_m": high}, "imu": IMU}
        for name, (low, high) in BOXES.items()
    ]
    corners = [(3.5, 3.5, 0.3), (-3.5, 3.5, 2.6), (-3.5, -3.5, 0.5), (3.5, -3.5, 2.5)]
    bodies += [
        {"name": f"anchor{k}", "motion": {"model": "static", "position_m": place}} for k, place in enumerate(corners)
    ]
    arms = {1: ("a", 0.17), 2: ("a", -0.17), 3: ("b", 0.17), 4: ("b", -0.17)}
    tags = [{"id": t, "body": b, "lever_arm_m": [x, -x, -0.05], "delay_ns": 0.1 * t} for t, (b, x) in arms.items()]
    tags += [{"id": 11 + k, "body": f"anchor{k}", "delay_ns": -0.1 * k} for k in range(4)]
    return uwbsim.simulate(
        {
            "run": {"duration_s": 16.0, "seed": 5},
            "ranging": {"rate_hz": 160.0, "pairs": "between-bodies"},
            "bodies": bodies,
            "tags": tags,
        }
    )


def test_attitudes_by_gyroscope_stay_near_those_of_motion_capture(flown):
    began = flown.exchanges.time_ns[0] * 1e-9
    scene = scene_from(flown, FlightSettings(poses_until_s=4.0, attitudes="imu"))
    time = np.arange(0.5, 15.0, 0.5)
    for body in BOXES:
        poses = flown.poses[flown.poses.body == body]
        true = Attitude(
            time_s=poses.time_ns * 1e-9 - began,
            quaternion=poses.quaternion,
            std_rad=np.zeros(3),
            wander_rad=np.zeros(3),
        )
        off = (scene.attitudes[body].at(time) * true.at(time).inv()).as_rotvec()
        # A bias of half a degree a second would be 5 degrees off after ten; it is told from the first four seconds.
        assert np.degrees(np.abs(off)).max() < 3.5
    felt = scene.inertial["a"]
    assert np.mean(felt.force_m_s2, axis=0) == pytest.approx([0, 0, 9.81], abs=0.5)


def test_a_heading_that_is_wrong_by_a_right_angle_is_found_over_the_flight(flown):
    scene = scene_from(flown, FlightSettings(poses_until_s=0.0, attitudes="imu")).between(0.0, 4.0)
    known = scene_from(flown, FlightSettings(poses_until_s=4.0)).between(0.0, 4.0)

    def off(turned):
        turns = [turned.attitudes[body].at(TWO_S) * known.attitudes[body].at(TWO_S).inv() for body in BOXES]
        return np.array([turn.as_euler("ZYX")[0, 0] for turn in turns])

    # Integrated from an unknown heading; "b" is put a right angle off, where a first window may have left it.
    scene = scene.turned_by(dict(zip(BOXES, (-off(scene) + [0.0, np.pi / 2]).tolist(), strict=True)))
    a = replace(scene.attitudes["a"], heading_known=True)
    scene = replace(scene, attitudes={**scene.attitudes, "a": a})
    state = interpolated(known.places, np.arange(0.0, 4.0, 0.1), 2).state(scene, np.zeros((0, 3)))
    found, _, unsure = resolve_headings(scene, state)
    assert np.degrees(np.abs(off(scene))).max() > 80
    assert np.degrees(np.abs(off(found))).max() < 16
    assert unsure == ""


def test_inertial_readings_and_anchors_are_enough(flown):
    found = calib.fit_from_ranges(flown, poses_until_s=0.0, attitudes="imu")
    truth = calib.load_ranges(flown)
    away = found.ranges.truth_m - truth.truth_m[np.searchsorted(truth.time_ns, found.ranges.time_ns)]
    # Neither a place nor a heading of a robot was given.
    assert np.std(away) < 0.03
    assert abs(np.mean(away)) < 0.01
    planted = np.array([flown.planted["delays_ns"][str(tag)] for tag in found.calibration.delays_ns])
    error = np.array(list(found.calibration.delays_ns.values())) - planted
    assert np.std(error) < 0.06


def test_a_body_without_inertial_readings_is_named():
    with pytest.raises(calib.UnanswerableError, match="robot0"):
        calib.fit_from_ranges(flight(seconds=4.0), attitudes="imu")
