"""A recorded flight (MILUV: three robots, six anchors, 317 exchanges), with little or none of its motion capture; and
a simulated one whose tags range with anchors only."""

import tarfile
from typing import Any

import numpy as np
import pytest

import calib
import uwbsim
from tests.shared_data import shared
from uwblink.importers import read_source

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    folder = tmp_path_factory.mktemp("miluv")
    with tarfile.open(shared("miluv_cirObstacles_3_random_0.tar.xz")) as archive:
        archive.extractall(folder, filter="data")
    return read_source(folder / "cirObstacles_3_random_0", importer="miluv")


def joint_scores(found, flown):
    """Differences from a fit with all of the motion capture over joint standard errors, of all boards."""
    whole = calib.fit(flown, loss="cauchy").calibration
    std = np.sqrt(np.diag(found.uncertainty.delays_ns2))
    tags = found.uncertainty.tags
    differ = np.array([found.delays_ns[tag] - whole.delays_ns[tag] for tag in tags])
    return differ / np.hypot(std, [whole.delays_std_ns[tag] for tag in tags])


def test_ten_seconds_of_motion_capture_an_imu_and_heights_follow_a_real_flight(flown):
    found = calib.fit_from_ranges(flown, poses_until_s=10.0, attitudes="imu")
    truth = calib.load_ranges(flown)
    away = found.ranges.truth_m - truth.truth_m[np.searchsorted(truth.time_ns, found.ranges.time_ns)]
    # Four ranges a second for three robots: accelerometer and height bridge what is between them.
    assert abs(np.median(away)) < 0.03
    assert np.median(np.abs(away)) < 0.1
    assert sum(map(np.isfinite, found.calibration.delays_std_ns.values())) >= 10
    scores = joint_scores(found.calibration, flown)
    assert np.sqrt(np.mean(scores**2)) < 1.5
    assert np.abs(scores).max() < 2.5


def test_anchors_alone_leave_the_delays_open_and_intervals_say_how_far(flown):
    found = calib.fit_from_ranges(flown, poses_until_s=0.0, minimum_norm=True)
    assert "the ranges determine no delay" in found.warnings[0]
    assert np.isinf(list(found.calibration.delays_std_ns.values())).all()
    assert np.abs(joint_scores(found.calibration, flown)).max() < 2.5


def test_tags_that_range_with_anchors_only_leave_delays_open_whatever_the_skews_of_clocks():
    flown = uwbsim.simulate(uwbsim.load("anchors_and_tag/bipartite", {"run.duration_s": 10.0}))
    given: dict[str, Any] = {"poses_until_s": 6.0, "delays_only": True}
    # What all delays have in common is not determined, either, and no number is given for it.
    words = r"ranges between two sides are known to ± [4-6] cm"
    with pytest.raises(calib.UnanswerableError, match=words) as raised:
        calib.fit_from_ranges(flown, **given)
    assert raised.value.undetermined == [[0, 1, 2, 3, 4, 5, 10, 11]]
    found = calib.fit_from_ranges(flown, minimum_norm=True, **given).calibration
    assert found.undetermined_splits == (((0, 1, 2, 3, 4, 5), (10, 11)),)
    assert np.isinf(list(found.delays_std_ns.values())).all()
    of_tags = found.delays_ns[10] + found.delays_ns[11]
    assert of_tags == pytest.approx(sum(found.delays_ns.values()) - of_tags, abs=0.01)
