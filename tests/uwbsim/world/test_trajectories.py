"""Where bodies go: inside their box, smoothly, through their waypoints."""

from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import uwbsim
from uwbsim.random_streams import stream
from uwbsim.scenario.bodies import Carried, RandomFlight, Waypoints
from uwbsim.world.trajectories import _quaternions, sample
from uwbsim.world.world import World


def test_random_flight_stays_in_its_box_at_about_its_speed():
    box = RandomFlight(model="random-flight", box_min_m=(-2, -1, 0.5), box_max_m=(2, 1, 2.5), speed_mps=1.0)
    flight = sample(box, 300.0, partial(stream, 1, "a"))
    time = np.linspace(0, 300, 30_001)
    path = flight.position_m(time)
    assert np.all(path >= box.box_min_m)
    assert np.all(path <= box.box_max_m)
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) * 100
    assert 0.3 < np.mean(speed) < 1.5
    assert np.abs(np.diff(path, 2, axis=0)).max() * 1e4 < 30, "acceleration is bounded"


def test_waypoints_are_passed_on_time():
    way = Waypoints(model="waypoints", times_s=(0, 2, 5), points_m=((0, 0, 1), (1, 2, 1), (3, 0, 2)))
    path = sample(way, 10.0, partial(stream, 1, "a")).position_m(np.array([0.0, 2.0, 5.0, 9.0]))
    np.testing.assert_allclose(path, [(0, 0, 1), (1, 2, 1), (3, 0, 2), (3, 0, 2)], atol=1e-12)


def test_a_carried_body_stands_still_and_goes_on_smoothly():
    motion = Carried(model="carried", places_m=((0, 0, 1), (2, 0, 1), (1, 1, 1)), stay_s=20.0, carry_s=5.0)
    path = sample(motion, 100.0, partial(stream, 1, "a"))
    held = path.position_m(np.array([0.0, 20.0, 25.0, 45.0, 50.0, 99.0]))
    np.testing.assert_allclose(held, [(0, 0, 1)] * 2 + [(2, 0, 1)] * 2 + [(1, 1, 1)] * 2, atol=1e-12)
    np.testing.assert_allclose(path.position_m(np.array([22.5])), [(1, 0, 1)], atol=1e-12)
    time = np.linspace(0, 100, 10_001)
    assert np.linalg.norm(np.diff(path.position_m(time), axis=0), axis=1).max() * 100 < 2 / 5 * 1.51


def test_lever_arm_turns_with_the_body():
    turned = {"model": "static", "position_m": [1.0, 2.0, 3.0], "yaw_deg": 90.0}
    bodies = [{"name": "a", "motion": turned}, {"name": "b", "motion": turned | {"position_m": [5.0, 2.0, 3.0]}}]
    tags = [{"id": k, "body": "ab"[k], "lever_arm_m": [1.0, 0.0, 0.0]} for k in (0, 1)]
    scenario = {"run": {"duration_s": 1.0}, "ranging": {"rate_hz": 1}, "bodies": bodies, "tags": tags}
    spots, _ = World(uwbsim.load(scenario)).antennas(np.array([0, 1]), np.zeros(2))
    np.testing.assert_allclose(spots, [(1, 3, 3), (5, 3, 3)], atol=1e-12)


def test_a_longer_run_continues_the_same_flight():
    box = RandomFlight(model="random-flight", box_min_m=(0, 0, 0), box_max_m=(1, 1, 1))
    short, long = (sample(box, duration, partial(stream, 1, "a")) for duration in (20.0, 500.0))
    time = np.linspace(0, 20, 101)
    np.testing.assert_array_equal(short.position_m(time), long.position_m(time))
    np.testing.assert_array_equal(short.quaternion(time), long.quaternion(time))


def test_attitudes_are_those_of_scipys_angles():
    angles = np.random.default_rng(1).uniform(-1.5, 1.5, (500, 3))
    expected = Rotation.from_euler("ZYX", angles).as_quat(canonical=True)
    np.testing.assert_allclose(_quaternions(angles), expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize(("shape", "rounds_a_climb"), [("circle", 1), ("eight", 1), ("helix", 5)])
def test_figures_pass_through_points_known_by_hand(shape, rounds_a_climb):
    motion = {"model": "figure", "shape": shape, "centre_m": [1, -2, 1.5], "radius_m": 2.0, "period_s": 4.0}
    flying = {"name": "flying", "motion": motion | {"climb_m": 0.8, "phase_deg": 90.0, "turns_per_period": 0.5}}
    post = {"name": "post", "motion": {"model": "static", "position_m": [0, 0, 1]}}
    tags = [{"id": 1, "body": "flying"}, {"id": 2, "body": "post"}]
    scenario = {"run": {"duration_s": 21.0}, "ranging": {"rate_hz": 1}, "bodies": [flying, post], "tags": tags}
    poses = uwbsim.simulate(scenario).poses
    poses = poses[np.flatnonzero(poses.body == "flying")]

    def at(seconds, columns):
        since = (poses.time_ns - poses.time_ns[0]) * 1e-9
        return np.column_stack([np.interp(seconds, since, column) for column in columns.T])

    half = np.sqrt(2)
    place = at([0, 0.5, 1, 1.5, 2, 3], poses.position_m - [1, -2, 1.5])
    # A round takes 4 s, counter-clockwise, from the positive y axis; an eight crosses its centre there.
    np.testing.assert_allclose(place[:, 0], [0, -half, -2, -half, 0, 2], atol=1e-3)
    sideways = [0, -1, 0, 1, 0, 0] if shape == "eight" else [2, half, 0, -half, -2, 0]
    np.testing.assert_allclose(place[:, 1], sideways, atol=1e-3)
    # The path is at its middle height at the x axis, from where it climbs.
    climbs = np.arange(1, 22) / 4 / rounds_a_climb
    height = at(np.arange(21.0), poses.position_m)[:, 2]
    np.testing.assert_allclose(height, 1.5 + 0.4 * np.sin(2 * np.pi * climbs), atol=1e-3)
    nose = Rotation.from_quat(poses.quaternion).as_matrix()[:, :, 0]
    np.testing.assert_allclose(at([0.0, 2.0, 4.0], nose), [(1, 0, 0), (0, 1, 0), (-1, 0, 0)], atol=1e-3)
