"""A recorded flight (MILUV: three robots, six anchors, 317 exchanges) with motion capture for its first ten seconds."""

import tarfile

import numpy as np

import calib
from tests.shared_data import shared
from uwblink.importers import read_source


def test_ten_seconds_of_motion_capture_and_an_imu_follow_a_real_flight(tmp_path):
    with tarfile.open(shared("miluv_cirObstacles_3_random_0.tar.xz")) as archive:
        archive.extractall(tmp_path, filter="data")
    flown = read_source(tmp_path / "cirObstacles_3_random_0", importer="miluv")
    found = calib.fit_from_ranges(flown, poses_until_s=10.0, attitudes="imu")
    whole = calib.fit(flown, loss="cauchy").calibration
    truth = calib.load_ranges(flown)
    away = found.ranges.truth_m - truth.truth_m[np.searchsorted(truth.time_ns, found.ranges.time_ns)]
    # Four ranges a second for three robots: the accelerometer bridges what is between them.
    assert abs(np.median(away)) < 0.02
    assert np.median(np.abs(away)) < 0.1
    tags = [tag for tag, std in found.calibration.delays_std_ns.items() if np.isfinite(std)]
    assert len(tags) >= 6
    differ = np.array([found.calibration.delays_ns[tag] - whole.delays_ns[tag] for tag in tags])
    joint = [np.hypot(found.calibration.delays_std_ns[tag], whole.delays_std_ns[tag]) for tag in tags]
    assert np.sqrt(np.mean((differ / joint) ** 2)) < 1.5
