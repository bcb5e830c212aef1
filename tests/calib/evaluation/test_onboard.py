"""Localization on board: flights as formulas, whose readings share no code with the filter."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib import BadInputError, OnboardSettings, UnanswerableError, localize_onboard
from calib.calibration import error_model, patterns, read_miluv
from calib.data.samples import stamped
from calib.evaluation import filters, onboard_json, onboard_text, write_tum
from tests.calib import synthetic
from tests.calib.evaluation.inertial import readings, table
from tests.calib.synthetic import track_errors
from tests.shared_data import miluv, shared
from uwblink import Contents, Poses, Tag, importers, raw_range

ANCHORS = np.array([[3, 3, 0.3], [-3, 3, 2.2], [-3, -3, 0.4], [3, -3, 2.4], [0, 3.5, 1.2], [3.5, 0, 1.4]])
ARMS = {10: (0.15, -0.15, -0.05), 11: (-0.15, 0.15, -0.05)}
NOISE_M, NS = 0.05, 10**12
IMU = filters.ProcessNoise(force=0.02, gyro=0.002, force_bias=0.001, gyro_bias=0.0001, height_offset=0.001)
BIASES = np.array([0.004, -0.006, 0.003]), np.array([0.15, -0.1, 0.08])


def place(t):
    """Return the position of the body: sums of sines, with the speed of a careful drone."""
    return np.stack(
        [1.5 * np.sin(0.5 * t) + 0.3 * np.sin(1.3 * t), 1.3 * np.cos(0.4 * t), 1.4 + 0.4 * np.sin(0.7 * t)], axis=-1
    )


def attitude(t):
    """Return the attitude: a heading over all directions, and a tilt."""
    angles = np.stack([0.6 * t + 1.0, 0.1 * np.sin(0.9 * t), 0.08 * np.cos(1.1 * t)], axis=-1)
    return Rotation.from_euler("ZYX", angles)


def flight(seconds=20.0, seed=1, reflected=0.0, rate=50.0):
    """Return a flight among anchors with inertial readings at 100 Hz and heights at 10 Hz, with the noise of `IMU`."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, 1 / rate)
    tag, anchor = np.where(np.arange(len(t)) % 2, 10, 11), rng.integers(0, len(ANCHORS), len(t))
    antenna = place(t) + attitude(t).apply(np.array([ARMS[k] for k in tag.tolist()]))
    measured = np.linalg.norm(antenna - ANCHORS[anchor], axis=1) + NOISE_M * rng.normal(size=len(t))
    measured += np.where(rng.random(len(t)) < reflected, rng.exponential(0.35, len(t)), 0.0)
    ends = np.column_stack([tag, anchor])
    ends[::3] = ends[::3, ::-1]  # some are initiated by the anchor
    ti, th = np.arange(-1.0, seconds + 1, 0.01), np.arange(0, seconds, 0.1)
    # White noise of the density d in readings 10 ms apart has the standard deviation d / sqrt(10 ms).
    noise = [rng.normal(size=(len(ti), 3)) * density / 0.1 for density in (IMU.gyro, IMU.force)]
    read = readings(place, attitude, ti) + np.hstack(BIASES) + np.hstack(noise)
    height = place(th)[:, 2] + 0.12 + IMU.height_m * rng.normal(size=len(th))
    names = [f"anchor{k}" for k in range(len(ANCHORS))]
    poses = Poses(
        np.append(ns(ti), np.full(len(names), NS)),
        np.array(["drone"] * len(ti) + names),
        np.vstack([place(ti), ANCHORS]),
        np.vstack([attitude(ti).as_quat(), np.tile([0.0, 0, 0, 1], (len(names), 1))]),
    )
    mounted = [(k, "drone", arm) for k, arm in ARMS.items()] + [(k, name, (0.0,) * 3) for k, name in enumerate(names)]
    return Contents(
        exchanges=stamped(ns(t), ends, measured, np.full((2, len(t)), -85.0)),
        tags=[Tag(*one) for one in mounted],
        poses=poses,
        imu=table(ns(ti), ["drone"], read),
        height={"time_ns": ns(th), "body": np.full(len(th), "drone"), "height_m": height},
    )


def ns(time_s):
    return (time_s * 1e9).astype(np.int64) + NS


def calibration(share=0.001):
    errors = error_model.ErrorModel(
        lifted=(0.1, 1.0), noise_m=(NOISE_M,) * 2, tail_share=(share,) * 2, least_m=0.0, detour_m=0.35,
        outlier_share=1e-4, outlier_m=3.0,
    )  # fmt: skip
    delays_ns = dict.fromkeys([*range(len(ANCHORS)), *ARMS], 0.0)
    return synthetic.calibration(delays_ns, NOISE_M, loss="mixture", errors=errors)


def test_imu_height_and_ranges_find_place_and_heading():
    (track,) = localize_onboard(flight(reflected=0.1), calibration(0.1), OnboardSettings(noise=IMU))
    assert track.used == "ranges, imu, height"
    assert len(track.nis) > 980, "all 1000 ranges but those of the start, by whichever end they were initiated"
    assert np.sqrt(np.mean(track_errors(track, 3.0) ** 2)) < 0.08
    assert track.rmse_m == pytest.approx(np.sqrt(np.mean(track_errors(track) ** 2)))
    off = (attitude((track.time_ns - NS) * 1e-9).inv() * Rotation.from_quat(track.attitude)).magnitude()
    # Headings start in all directions; turns and accelerations determine them.
    assert np.degrees(off[track.time_ns > NS + 10 * 10**9].max()) < 6
    assert track.restarts_s == ()


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_the_filter_is_consistent(seed):
    (track,) = localize_onboard(flight(seed=seed), calibration(), OnboardSettings(noise=IMU))
    late = track.time_ns > track.time_ns[0] + 5_000_000_000
    # Errors of the state last for a second: fifteen independent values of three, whose mean square is known to 15 %.
    assert 1.5 < np.mean(track.nees[late]) < 5.0
    # The stated error has the size of the true error, in metres, within the same share.
    assert np.sqrt(np.mean((track_errors(track) / track.std_m)[late] ** 2)) == pytest.approx(1.0, abs=0.35)
    settled = track.range_time_ns > track.time_ns[0] + 5_000_000_000
    assert np.mean(track.nis[settled]) == pytest.approx(1.0, abs=0.17)
    sure = replace(calibration(), errors=replace(calibration().errors, noise_m=(0.02, 0.02)))
    (found_out,) = localize_onboard(flight(10.0, seed=seed), sure, OnboardSettings(noise=IMU))
    assert np.mean(found_out.nis[len(found_out.nis) // 2 :]) > 2


@pytest.mark.parametrize(
    ("model", "noise", "most_m"), [("imu", IMU, 0.5), ("constant-velocity", filters.ProcessNoise(), 0.7)]
)
@pytest.mark.parametrize("away", [(-3.0, 4.0, 0.0), (0.0, -10.0, 0.0)])
def test_a_wrong_start_is_left_within_two_seconds(model, noise, most_m, away):
    settings = OnboardSettings(model=model, noise=noise, start_m=tuple((place(np.array(0.0)) + away).tolist()))
    (track,) = localize_onboard(flight(4.0, reflected=0.1), calibration(0.1), settings)
    assert track_errors(track)[0] > 4
    assert track.restarts_s
    assert track_errors(track, 2.0).max() < most_m


def test_the_constant_velocity_model_needs_no_imu():
    contents = flight(12.0, reflected=0.1)
    settings = OnboardSettings(model="constant-velocity")
    for some, used, most_m in (
        (replace(contents, imu={}), "ranges, height", 0.25),
        (replace(contents, imu={}, height={}), "ranges", 0.35),
    ):
        (track,) = localize_onboard(some, calibration(0.1), settings)
        assert track.used == used
        # Without a heading, lever arms of 21 cm have any direction.
        assert np.sqrt(np.mean(track_errors(track, 2.0) ** 2)) < most_m


def test_localization_needs_no_true_poses(tmp_path):
    contents = flight(5.0)
    still = np.char.startswith(contents.poses.body, "anchor")
    replace(contents, poses=contents.poses[still]).save(tmp_path / "f.uwb")
    (track,) = localize_onboard(tmp_path / "f.uwb", calibration(), OnboardSettings(noise=IMU))
    assert np.isnan(track.rmse_m)
    write_tum([track], tmp_path / "blind")
    assert [path.name for path in (tmp_path / "blind").iterdir()] == ["f_uwb-drone-imu.tum"]
    assert onboard_json([track])[0]["rmse_m"] is None
    assert "used: ranges, imu, height" in onboard_text([track], OnboardSettings())
    assert "no true positions" in repr(track)
    (known,) = localize_onboard(contents, calibration(), OnboardSettings(noise=IMU))
    np.testing.assert_allclose(track.estimate_m, known.estimate_m, atol=1e-6)
    write_tum([known], tmp_path / "both")
    truth, t = np.loadtxt(tmp_path / "both" / "memory-drone-imu-truth.tum"), (known.time_ns - NS) * 1e-9
    np.testing.assert_allclose(truth[:, 1:4], place(t), atol=1e-3)
    # Attitudes are those of the nearest pose, at most 5 ms away.
    assert (attitude(t).inv() * Rotation.from_quat(truth[:, 4:])).magnitude().max() < 0.005


def with_patterns(found, size_m):
    """Return a flight in which anchors are rotated and antennas of the robot and of anchor 2 depend on direction, and
    the calibration with that pattern: `size_m` to the front, and the opposite to the back.
    """
    turned = Rotation.from_euler("ZYX", [1.2, 0.2, -0.1])
    poses, x = found.poses, found.exchanges
    quaternion = np.where((poses.body == "anchor2")[:, None], turned.as_quat(), poses.quaternion)
    t = (x.time_ns - NS) * 1e-9
    drone = np.where(np.isin(x.initiator, [10, 11]), x.initiator, x.target)
    anchor = x.initiator + x.target - drone
    away = ANCHORS[anchor] - (place(t) + attitude(t).apply(np.array([ARMS[k] for k in drone.tolist()])))
    away /= np.linalg.norm(away, axis=1)[:, None]
    longer = size_m * attitude(t).inv().apply(away)[:, 0]
    longer += np.where(anchor == 2, size_m * turned.inv().apply(-away)[:, 0], 0.0)
    power = np.full((2, len(t)), -85.0)
    exchanges = stamped(x.time_ns, np.column_stack([x.initiator, x.target]), raw_range(x) + longer, power)
    front = (size_m / np.sqrt(3), *[0.0] * 7)
    pattern = patterns.Pattern((2, 10, 11), front, (0.0,) * 8, ((0.0,) * 8,) * 8, size_m / np.sqrt(3))
    there = replace(found, exchanges=exchanges, poses=replace(poses, quaternion=quaternion))
    return there, replace(calibration(), patterns=(pattern,))


@pytest.mark.slow
def test_patterns_are_corrected_by_the_estimated_pose():
    plain = flight(12.0, seed=5)
    turned, known = with_patterns(plain, 0.25)
    (free,), (corrected,), (wrong,) = (
        localize_onboard(*both) for both in ((plain, calibration()), (turned, known), (turned, calibration()))
    )
    errors = [np.sqrt(np.mean(track_errors(one, 5.0) ** 2)) for one in (free, corrected, wrong)]
    assert errors[1] < min(1.2 * errors[0], 0.5 * errors[2])
    # Poses of the body are only used as truth: without them the estimate is the same.
    (alone,) = localize_onboard(replace(turned, poses=turned.poses[turned.poses.body != "drone"]), known)
    np.testing.assert_array_equal(alone.estimate_m, corrected.estimate_m)


@pytest.mark.slow
def test_without_a_heading_patterns_count_as_noise():
    turned, known = with_patterns(flight(10.0, seed=5), 0.25)
    settings = OnboardSettings(model="constant-velocity")
    (unsure,), (sure,) = (localize_onboard(turned, one, settings) for one in (known, calibration()))
    assert np.median(unsure.std_m) > 1.1 * np.median(sure.std_m)
    assert np.mean(unsure.nees) < 0.5 * np.mean(sure.nees)


FEW = [f"anchor{k}" for k in range(4)]


@pytest.mark.parametrize(
    ("change", "settings", "error", "said"),
    [
        (
            lambda _: {"imu": {}},
            {},
            UnanswerableError,
            r"no inertial readings of drone; add imu.csv .*model constant-vel",
        ),
        (
            lambda flown: {"poses": flown.poses[np.flatnonzero(~np.isin(flown.poses.body, FEW))]},
            {},
            UnanswerableError,
            "by its poses 2 tags stand still",
        ),
        (lambda _: {}, {"model": "magic"}, BadInputError, "`model`: found 'magic', allowed: imu, constant-velocity"),
        (lambda _: {}, {"start_m": (0.0, np.nan, 1.0)}, BadInputError, "`start_m`"),
    ],
)
def test_recordings_without_needed_data_are_refused(change, settings, error, said):
    contents = flight(3.0)
    with pytest.raises(error, match=said):
        localize_onboard(replace(contents, **change(contents)), calibration(), OnboardSettings(**settings))


def test_multilateration_is_exact_and_leaves_a_reflection_out():
    true = np.array([0.7, -1.1, 1.9])
    exact = np.linalg.norm(true - ANCHORS, axis=1)
    np.testing.assert_allclose(filters.multilaterate(exact, ANCHORS, 0.0).place_m, true, atol=1e-6)
    twice, reflected = np.tile(ANCHORS, (2, 1)), np.tile(exact, 2)
    reflected[[2, 9]] += 3.0, 0.8
    assert np.linalg.norm(filters.multilaterate(reflected, twice, 0.0).place_m - true) < 0.15
    # Three anchors leave two mirrored positions, between which a height decides.
    assert filters.multilaterate(exact[:3], ANCHORS[:3] * [1, 1, 0] + [0, 0, 1.0], 0.0, 1.9).place_m[2] > 1.0


@pytest.mark.slow
def test_a_real_flight_by_imu_height_and_ranges_alone(tmp_path):
    """The flight of the data set among obstacles: a range to an anchor every 1.2 s, gaps of 6 s, published delays."""
    contents = importers.read_source(miluv(tmp_path), importer="miluv")
    tracks = localize_onboard(contents, read_miluv(shared("miluv_published_calibration.json")))
    rmse_m = {track.body: track.rmse_m for track in tracks}
    # Measured: 0.80, 0.98 and 1.10 m.
    most_m = {"ifo001": 1.0, "ifo002": 1.2, "ifo003": 2.5}
    assert {body: rmse_m[body] < most_m[body] for body in rmse_m} == dict.fromkeys(most_m, True), rmse_m
