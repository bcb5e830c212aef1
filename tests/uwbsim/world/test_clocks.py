"""Clocks: readings and their inverse at any time, and noise as measured by an independent program (allantools)."""

from functools import partial

import allantools
import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

import uwbsim
from tests.uwbsim.simulation.test_protocols import bench
from uwblink import Recording
from uwbsim.random_streams import stream
from uwbsim.scenario.bodies import Carried, RandomFlight, Waypoints
from uwbsim.world.clocks import LONGEST_RUN_S, SUBTICKS, SUBTICKS_PER_SECOND, Clocks
from uwbsim.world.trajectories import _quaternions, sample
from uwbsim.world.world import World

NOMINAL = {
    "white_ppm_sqrt_s": lambda tau: 0.01e-6 / np.sqrt(tau),
    "flicker_ppm": lambda tau: np.full_like(tau, 0.01e-6),
    "drift_ppm_per_sqrt_s": lambda tau: 0.01e-6 * np.sqrt(tau / 3),
}
NOISY = dict.fromkeys(NOMINAL, 0.01)
SHORT, LONG = np.array([1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3, 1.0]), np.array([2.0, 10.0, 30.0, 100.0, 300.0])


def clocks(duration=10.0, skews=(0.0, 0.0), seed=1, ids=(1, 2), **noise):
    scenario = bench(skews=skews, seed=seed)
    tags = tuple(scenario.tags[k % 2].model_copy(update={"id": own} | noise) for k, own in enumerate(ids))
    settings = scenario.run.model_copy(update={"duration_s": duration})
    return Clocks.of(scenario.model_copy(update={"tags": tags, "run": settings}))


def subticks(seconds):
    return np.rint(np.asarray(seconds) * SUBTICKS_PER_SECOND).astype(np.int64)


def ahead_s(clock, time, tag):
    """Return by how much a clock is ahead of true time since its start."""
    return (clock.read(np.full(len(time), tag), time) - time - clock.offset[tag]) / SUBTICKS_PER_SECOND


def test_skew_and_a_ramp_are_what_readings_gain():
    gained = [ahead_s(clocks(skews=(12.0, -7.0), duration=50.0), subticks([50]), k)[0] for k in (0, 1)]
    np.testing.assert_allclose(gained, [600e-6, -350e-6], atol=1e-13)
    ramp = ahead_s(clocks(20_000.0, ramp_ppm_per_s=0.001), subticks([20_000]), 0)[0]
    assert ramp == pytest.approx(0.5 * 0.001e-6 * 20_000**2, rel=1e-4)


@pytest.mark.parametrize(("duration", "begin_s", "noise"), [(10.0, 0, NOISY), (31 * 3600.0, 30 * 3600, {})])
def test_when_inverts_read_to_the_subtick(duration, begin_s, noise):
    c = clocks(duration, (12.0, -7.0), **noise)
    time = begin_s * SUBTICKS_PER_SECOND + np.random.default_rng(1).integers(0, 10 * SUBTICKS_PER_SECOND, 5000)
    which = np.arange(5000) % 2
    assert np.abs(c.when(which, c.read(which, time)) - time).max() <= 1
    assert (LONGEST_RUN_S + 3600) * SUBTICKS_PER_SECOND + 2**40 * SUBTICKS < 2**63


def test_noise_depends_neither_on_what_else_is_asked_nor_on_how_long_the_run_is():
    time, tag = np.random.default_rng(1).integers(0, 10 * SUBTICKS_PER_SECOND, 100), np.arange(100) % 2
    short, long = clocks(**NOISY), clocks(100.0, **NOISY)
    whole = short.read(tag, time)
    one_by_one = [short.read(tag[k : k + 1], time[k : k + 1])[0] for k in range(99, -1, -1)][::-1]
    np.testing.assert_array_equal(whole, one_by_one)
    np.testing.assert_array_equal(whole, long.read(tag, time))


def test_noisy_clocks_begin_at_their_offset_and_always_change():
    c = clocks(clock_offset_s=1.0, **NOISY)
    np.testing.assert_array_equal(c.read(np.array([0, 1]), np.zeros(2, dtype=np.int64)), c.offset)
    assert (c.offset // SUBTICKS).tolist() == [63_897_600_000] * 2
    fine = 3 * SUBTICKS_PER_SECOND + np.arange(0, 100_000_000, 1_000_000)
    assert np.diff(c.read(np.zeros(len(fine), dtype=np.int64), fine)).min() > 0.999 * 1_000_000


def test_drawn_offsets_are_any_reading_of_the_counter_and_any_part_of_a_tick():
    ticks, parts = np.divmod(clocks(ids=range(1, 65)).offset, SUBTICKS)
    assert 0 <= ticks.min() < 2**36
    assert 2**39 < ticks.max() < 2**40
    assert len(np.unique(parts)) > 50


def test_the_noises_of_two_clocks_are_independent():
    c, time = clocks(100.0, white_ppm_sqrt_s=0.01, flicker_ppm=0.01), subticks(np.arange(0, 100, 0.001))
    # 100,000 independent pairs determine a correlation to 0.003.
    assert abs(np.corrcoef(*(np.diff(ahead_s(c, time, k)) for k in (0, 1)))[0, 1]) < 0.015


@pytest.mark.parametrize("span_s", [130e-6, 0.1])
def test_the_rate_of_a_noisy_clock_is_what_its_reading_gains_over_a_preamble_or_an_exchange(span_s):
    c, span = clocks(white_ppm_sqrt_s=0.01, flicker_ppm=0.01), round(span_s * SUBTICKS_PER_SECOND)
    time, which = (
        np.random.default_rng(1).integers(SUBTICKS_PER_SECOND, 10 * SUBTICKS_PER_SECOND, 500),
        np.arange(500) % 2,
    )
    gained = (c.read(which, time) - c.read(which, time - span)) / span - 1
    found = c.rate(which, time, span_s)
    # A reading is rounded to a sub-tick at either end.
    np.testing.assert_allclose(found, gained, rtol=0, atol=1.01 / span)
    assert np.std(found[which == 0]) > 2 / span, "there is noise in it"


# For the long ones, 20 hours altogether: 240 independent spans of 300 s, known to 5 %.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("kinds", "long"), [([kind], long) for kind in NOMINAL for long in (False, True)] + [([*NOMINAL], False)]
)
def test_allan_deviations_are_nominal_and_add_up_in_variance(kinds, long):
    step_s, duration_s, taus, seeds = (2.0, 36_000.0, LONG, 1) if long else (0.5e-3, 30.0, SHORT, 3)
    time, squares = subticks(np.arange(0, duration_s, step_s)), []
    for seed in range(seeds):
        c = clocks(duration_s, seed=seed + 1, **dict.fromkeys(kinds, 0.01))
        phases = [ahead_s(c, time, k) for k in (0, 1)]
        squares += [allantools.oadev(p, rate=1 / step_s, data_type="phase", taus=taus)[1] ** 2 for p in phases]
    expected = np.sqrt(sum(NOMINAL[kind](taus) ** 2 for kind in kinds))
    np.testing.assert_allclose(np.sqrt(np.mean(squares, axis=0)), expected, rtol=0.10)


# Motion of bodies, and inertial readings that integrate to it, with errors by their grade.


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
    np.testing.assert_allclose(held, [(0, 0, 1)] * 2 + [(1, 0, 1)] + [(2, 0, 1)] * 2 + [(1, 1, 1)] * 2, atol=1e-12)
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
    # The path has its middle height at the x axis, and rises from there.
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
    # Rotations: each reading turns by half of the interval before it and half of that after it.
    steps = (columns(found.imu, "w")[1:] + columns(found.imu, "w")[:-1]) / 2 * np.diff(time)[:, None]
    attitude = turn[0]
    for step in steps:
        attitude = attitude * Rotation.from_rotvec(step)
    assert (attitude.inv() * turn[len(time) - 1]).magnitude() < 1e-4
    world = turn.apply(columns(found.imu, "a")) - (0, 0, 9.81)
    start = (place[1] - place[0]) / (time[1] - time[0]) - world[0] * (time[1] - time[0]) / 2
    speed = start + cumulative_trapezoid(world, time, axis=0, initial=0)
    assert np.abs(place[0] + cumulative_trapezoid(speed, time, axis=0, initial=0) - place).max() < 2e-3


def test_a_body_at_rest_feels_what_holds_it_up_and_errs_by_its_grade():
    imu = {"rate_hz": 100.0, "gyro_bias_dps": 0.0, "gyro_noise_dps_per_sqrt_hz": 0.02, "vibration_mps2": 0.5}
    found = flown(STILL, 100.0, imu=imu | {"accel_bias_mps2": 0.0, "accel_noise_mps2_per_sqrt_hz": 0.0})
    gyro, force = columns(found.imu, "w"), columns(found.imu, "a")
    # 10,000 readings: a standard deviation is known to 0.7 %; the slow walk of the bias is far below the noise.
    assert np.std(np.diff(gyro, axis=0)) / np.sqrt(2) == pytest.approx(np.radians(0.02) * 10, rel=0.03)
    assert force.mean(axis=0) == pytest.approx([0, 0, 9.81], abs=0.05)
    assert np.std(np.diff(force, axis=0)) / np.sqrt(2) == pytest.approx(0.5, rel=0.03)


def test_biases_differ_between_seeds_and_have_the_set_size():
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
