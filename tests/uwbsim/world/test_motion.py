"""Where bodies go, and inertial readings that lead back to it and err as their grade says."""

from functools import partial

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

import uwbsim
from uwblink import Recording
from uwbsim.random_streams import stream
from uwbsim.scenario.bodies import Carried, RandomFlight, Waypoints
from uwbsim.world.trajectories import _quaternions, sample
from uwbsim.world.world import World

FLIGHT = {"model": "random-flight", "box_min_m": [-2, -2, 0.5], "box_max_m": [2, 2, 2.5]}
STILL = {"model": "static", "position_m": [0, 0, 1.0], "yaw_deg": 30}


def path_of(motion, duration_s):
    return sample(motion, duration_s, partial(stream, 1, "a"))


def flown(motion=FLIGHT, seconds=20.0, seed=4, **sensors):
    mast = {"name": "mast", "motion": {"model": "static", "position_m": [4.0, 0, 2]}}
    return uwbsim.simulate(
        {
            "run": {"duration_s": seconds, "seed": seed},
            "ranging": {"rate_hz": 1.0},
            "mocap": {"rate_hz": 200.0},
            "bodies": [{"name": "drone", "motion": motion} | sensors, mast],
            "tags": [{"id": 1, "body": "drone"}, {"id": 2, "body": "mast"}],
        }
    )


def drone_poses(flight):
    return flight.poses[np.flatnonzero(flight.poses.body == "drone")]


def columns(table, kind):
    return np.column_stack([table[f"{kind}{axis}"] for axis in "xyz"])


def test_random_flight_stays_in_its_box_at_about_its_speed():
    box = RandomFlight(model="random-flight", box_min_m=(-2, -1, 0.5), box_max_m=(2, 1, 2.5), speed_mps=1.0)
    path = path_of(box, 300.0).position_m(np.linspace(0, 300, 30_001))
    assert np.all((path >= box.box_min_m) & (path <= box.box_max_m))
    assert 0.3 < np.mean(np.linalg.norm(np.diff(path, axis=0), axis=1) * 100) < 1.5
    assert np.abs(np.diff(path, 2, axis=0)).max() * 1e4 < 30, "acceleration is bounded"


def test_waypoints_are_passed_on_time():
    way = Waypoints(model="waypoints", times_s=(0, 2, 5), points_m=((0, 0, 1), (1, 2, 1), (3, 0, 2)))
    path = path_of(way, 10.0).position_m(np.array([0.0, 2.0, 5.0, 9.0]))
    np.testing.assert_allclose(path, [(0, 0, 1), (1, 2, 1), (3, 0, 2), (3, 0, 2)], atol=1e-12)


def test_a_carried_body_stands_still_and_goes_on_smoothly():
    path = path_of(
        Carried(model="carried", places_m=((0, 0, 1), (2, 0, 1), (1, 1, 1)), stay_s=20.0, carry_s=5.0), 100.0
    )
    held = path.position_m(np.array([0.0, 20.0, 22.5, 25.0, 45.0, 50.0, 99.0]))
    expected = [(0, 0, 1)] * 2 + [(1, 0, 1)] + [(2, 0, 1)] * 2 + [(1, 1, 1)] * 2
    np.testing.assert_allclose(held, expected, atol=1e-12)
    steps = np.diff(path.position_m(np.linspace(0, 100, 10_001)), axis=0)
    assert np.linalg.norm(steps, axis=1).max() * 100 < 2 / 5 * 1.51


def test_lever_arm_turns_with_the_body():
    bodies = [
        {"name": n, "motion": STILL | {"position_m": [x, 2.0, 3.0], "yaw_deg": 90.0}} for n, x in (("a", 1), ("b", 5))
    ]
    tags = [{"id": k, "body": "ab"[k], "lever_arm_m": [1.0, 0.0, 0.0]} for k in (0, 1)]
    scenario = {"run": {"duration_s": 1.0}, "ranging": {"rate_hz": 1}, "bodies": bodies, "tags": tags}
    spots, _ = World(uwbsim.load(scenario)).antennas(np.array([0, 1]), np.zeros(2))
    np.testing.assert_allclose(spots, [(1, 3, 3), (5, 3, 3)], atol=1e-12)


def test_a_longer_run_continues_the_same_flight():
    box = RandomFlight(model="random-flight", box_min_m=(0, 0, 0), box_max_m=(1, 1, 1))
    (short, long), time = (path_of(box, duration) for duration in (20.0, 500.0)), np.linspace(0, 20, 101)
    np.testing.assert_array_equal(short.position_m(time), long.position_m(time))
    np.testing.assert_array_equal(short.quaternion(time), long.quaternion(time))


def test_attitudes_are_those_of_scipys_angles():
    angles = np.random.default_rng(1).uniform(-1.5, 1.5, (500, 3))
    expected = Rotation.from_euler("ZYX", angles).as_quat(canonical=True)
    np.testing.assert_allclose(_quaternions(angles), expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize(("shape", "rounds_a_climb"), [("circle", 1), ("eight", 1), ("helix", 5)])
def test_figures_pass_through_points_known_by_hand(shape, rounds_a_climb):
    motion = {"model": "figure", "shape": shape, "centre_m": [1, -2, 1.5], "radius_m": 2.0, "period_s": 4.0}
    poses = drone_poses(flown(motion | {"climb_m": 0.8, "phase_deg": 90.0, "turns_per_period": 0.5}, seconds=21.0))

    def at(seconds, columns):
        since = (poses.time_ns - poses.time_ns[0]) * 1e-9
        return np.column_stack([np.interp(seconds, since, column) for column in columns.T])

    half, place = np.sqrt(2), at([0, 0.5, 1, 1.5, 2, 3], poses.position_m - [1, -2, 1.5])
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


def test_perfect_readings_integrate_to_the_flight():
    found = flown(seconds=10.0, imu={"grade": "perfect", "rate_hz": 200.0})
    time, poses = found.imu["time_ns"] * 1e-9, drone_poses(found)
    turn, place = Rotation.from_quat(poses.quaternion[: len(time)]), poses.position_m[: len(time)]
    assert np.array_equal(poses.time_ns[: len(time)], found.imu["time_ns"])
    # Turns: each reading turns half of the way before it and half of that after it.
    steps = (columns(found.imu, "w")[1:] + columns(found.imu, "w")[:-1]) / 2 * np.diff(time)[:, None]
    attitude = turn[0]
    for step in steps:
        attitude = attitude * Rotation.from_rotvec(step)
    assert (attitude.inv() * turn[len(time) - 1]).magnitude() < 1e-4
    world = turn.apply(columns(found.imu, "a")) - (0, 0, 9.81)
    start = (place[1] - place[0]) / (time[1] - time[0]) - world[0] * (time[1] - time[0]) / 2
    speed = start + cumulative_trapezoid(world, time, axis=0, initial=0)
    away = place[0] + cumulative_trapezoid(speed, time, axis=0, initial=0) - place
    assert np.abs(away).max() < 2e-3


def test_a_body_at_rest_feels_what_holds_it_up_and_errs_by_its_grade():
    imu = {"rate_hz": 100.0, "gyro_bias_dps": 0.0, "gyro_noise_dps_per_sqrt_hz": 0.02, "vibration_mps2": 0.5}
    found = flown(STILL, 100.0, imu=imu | {"accel_bias_mps2": 0.0, "accel_noise_mps2_per_sqrt_hz": 0.0})
    gyro, force = columns(found.imu, "w"), columns(found.imu, "a")
    # 10 000 readings: a standard deviation is known to 0.7 %, the slow walk of the bias far below the noise.
    assert np.std(np.diff(gyro, axis=0)) / np.sqrt(2) == pytest.approx(np.radians(0.02) * 10, rel=0.03)
    assert force.mean(axis=0) == pytest.approx([0, 0, 9.81], abs=0.05)
    assert np.std(np.diff(force, axis=0)) / np.sqrt(2) == pytest.approx(0.5, rel=0.03)


def test_biases_differ_between_seeds_and_are_as_large_as_said():
    imu = {"accel_bias_mps2": 0.2, "rate_hz": 50}
    means = [columns(flown(STILL, 1.0, seed, imu=imu).imu, "a").mean(axis=0) for seed in range(30)]
    assert np.std(np.subtract(means, (0, 0, 9.81))) == pytest.approx(0.2, rel=0.25)


def test_heights_and_the_recording(tmp_path):
    found = flown(imu={"grade": "consumer"}, height={"noise_m": 0.02, "rate_hz": 50})
    poses = drone_poses(found)
    true = np.interp(found.height["time_ns"], poses.time_ns, poses.position_m[:, 2])
    assert np.std(found.height["height_m"] - true) == pytest.approx(0.02, rel=0.15)
    found.save(tmp_path / "f.uwb")
    with Recording.open(tmp_path / "f.uwb") as recording:
        assert np.array_equal(recording.columns("imu")["ax"], found.imu["ax"])
        assert np.array_equal(recording.columns("height")["height_m"], found.height["height_m"])
    without = flown(seconds=1.0)
    assert (without.imu, without.height) == ({}, {})
    with pytest.raises(uwbsim.ScenarioError, match="grade"):
        flown(imu={"grade": "military"})
