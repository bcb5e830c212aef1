"""Inertial readings lead back to the motion that they were made of, and err as their grade says."""

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

import uwbsim

FLIGHT = {"model": "random-flight", "box_min_m": [-2, -2, 0.5], "box_max_m": [2, 2, 2.5]}


def flown(imu, height=None, motion=None, seconds=20.0, seed=4):
    drone = {"name": "drone", "motion": motion or FLIGHT, "imu": imu} | ({"height": height} if height else {})
    return uwbsim.simulate(
        {
            "run": {"duration_s": seconds, "seed": seed},
            "ranging": {"rate_hz": 20.0},
            "mocap": {"rate_hz": 200.0},
            "bodies": [drone, {"name": "mast", "motion": {"model": "static", "position_m": [4.0, 0, 2]}}],
            "tags": [{"id": 1, "body": "drone"}, {"id": 2, "body": "mast"}],
        }
    )


def columns(table, kind):
    return np.column_stack([table[f"{kind}{axis}"] for axis in "xyz"])


def test_perfect_readings_integrate_to_the_flight():
    found = flown({"grade": "perfect", "rate_hz": 200.0}, seconds=10.0)
    time = found.imu["time_ns"] * 1e-9
    poses = found.poses[found.poses.body == "drone"]
    turn = Rotation.from_quat(poses.quaternion[: len(time)])
    assert np.array_equal(poses.time_ns[: len(time)], found.imu["time_ns"])
    # Turns: each reading turns half of the way before it and half of that after it.
    steps = (columns(found.imu, "w")[1:] + columns(found.imu, "w")[:-1]) / 2 * np.diff(time)[:, None]
    attitude = turn[0]
    for step in steps:
        attitude = attitude * Rotation.from_rotvec(step)
    assert (attitude.inv() * turn[len(time) - 1]).magnitude() < 1e-4
    world = turn.apply(columns(found.imu, "a")) - (0, 0, 9.81)
    place = poses.position_m[: len(time)]
    start = (place[1] - place[0]) / (time[1] - time[0]) - world[0] * (time[1] - time[0]) / 2
    speed = start + cumulative_trapezoid(world, time, axis=0, initial=0)
    away = place[0] + cumulative_trapezoid(speed, time, axis=0, initial=0) - place
    assert np.abs(away).max() < 2e-3


def test_a_body_at_rest_feels_what_holds_it_up_and_errs_by_its_grade():
    still = {"model": "static", "position_m": [0, 0, 1.0], "yaw_deg": 30}
    imu = {"rate_hz": 100.0, "gyro_bias_dps": 0.0, "gyro_noise_dps_per_sqrt_hz": 0.02, "vibration_mps2": 0.5}
    imu |= {"accel_bias_mps2": 0.0, "accel_noise_mps2_per_sqrt_hz": 0.0}
    found = flown(imu, motion=still, seconds=100.0)
    gyro, force = columns(found.imu, "w"), columns(found.imu, "a")
    # 10 000 readings: a standard deviation is known to 0.7 %, the slow walk of the bias far below the noise.
    assert np.std(np.diff(gyro, axis=0)) / np.sqrt(2) == pytest.approx(np.radians(0.02) * 10, rel=0.03)
    assert force.mean(axis=0) == pytest.approx([0, 0, 9.81], abs=0.05)
    assert np.std(np.diff(force, axis=0)) / np.sqrt(2) == pytest.approx(0.5, rel=0.03)


def test_biases_differ_between_seeds_and_are_as_large_as_said():
    still = {"model": "static", "position_m": [0, 0, 1.0]}
    means = []
    for seed in range(30):
        found = flown({"accel_bias_mps2": 0.2, "rate_hz": 50}, motion=still, seconds=1.0, seed=seed)
        means.append(columns(found.imu, "a").mean(axis=0) - (0, 0, 9.81))
    assert np.std(means) == pytest.approx(0.2, rel=0.25)


def test_heights_and_the_recording(tmp_path):
    found = flown({"grade": "consumer"}, height={"noise_m": 0.02, "rate_hz": 50})
    poses = found.poses[found.poses.body == "drone"]
    true = np.interp(found.height["time_ns"], poses.time_ns, poses.position_m[:, 2])
    assert np.std(found.height["height_m"] - true) == pytest.approx(0.02, rel=0.15)
    found.save(tmp_path / "f.uwb")
    from uwblink import Recording

    with Recording.open(tmp_path / "f.uwb") as recording:
        assert np.array_equal(recording.columns("imu")["ax"], found.imu["ax"])
        assert np.array_equal(recording.columns("height")["height_m"], found.height["height_m"])


def test_no_sensor_no_table():
    found = flown(None, seconds=1.0)
    assert found.imu == {}
    assert found.height == {}


def test_a_grade_that_is_none_is_named():
    with pytest.raises(uwbsim.ScenarioError, match="grade"):
        flown({"grade": "military"})
