"""True distances from poses and lever arms."""

import numpy as np
import pytest

from uwblink.recording.distances import distances_m, poses_around, tracks_of
from uwblink.recording.schema import Poses, Tag

LEVEL = (0, 0, 0, 1)
YAW_90 = (0, 0, np.sqrt(0.5), np.sqrt(0.5))
NEGATED = tuple(-q for q in YAW_90)


@pytest.mark.parametrize(
    ("begin", "end", "stands", "time_ns", "expected"),
    [
        # At half of the time, body a is at (1, 0, 0), and its arm, rotated by 90 degrees, points along y.
        (((0, 0, 0), YAW_90), ((2, 0, 0), YAW_90), (1, 4, 0), 50, 3.0),
        (((0, 0, 0), YAW_90), ((0, 0, 0), NEGATED), (0, 4, 0), 50, 3.0),
        (((0, 0, 0), LEVEL), ((0, 0, 0), LEVEL), (0, 4, 0), -1, np.nan),
        (((0, 0, 0), LEVEL), ((0, 0, 0), LEVEL), (0, 4, 0), 101, np.nan),
    ],
    ids=["between poses", "both signs of a quaternion", "before the poses", "after the poses"],
)
def test_distances_are_those_of_antennas_on_their_way(begin, end, stands, time_ns, expected):
    position, quaternion = zip(begin, end, (stands, LEVEL), strict=True)
    poses = Poses.from_arrays([0, 100, 0], ["a", "a", "b"], position, quaternion)
    tags = [Tag(1, "a", (1.0, 0.0, 0.0)), Tag(2, "b", (0.0, 0.0, 0.0))]
    (found,) = distances_m(poses, tags, np.array([1]), np.array([2]), np.array([time_ns]))
    assert found == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize(("step_m", "stands"), [(0.1, False), (0.0, True)])
def test_positions_in_gaps_of_poses_are_unknown(step_m, stands):
    seconds = np.r_[0:2:0.1, 5:7:0.1]
    poses = Poses.from_arrays(
        [*(seconds * 1e9).astype(int), 0],
        ["a"] * len(seconds) + ["b"],
        [*((step_m * k, 0, 0) for k in range(len(seconds))), (0, 4, 0)],
    )
    tags, ones = [Tag(1, "a", (0.0, 0.0, 0.0)), Tag(2, "b", (0.0, 0.0, 0.0))], np.ones(4, np.int64)
    at_ns = np.array([1_500_000_000, 1_950_000_000, 3_000_000_000, 6_000_000_000])
    for some in (poses, poses_around(tracks_of(poses), 2_500_000_000, 3_500_000_000)):
        lost = ~np.isfinite(distances_m(some, tags, ones, 2 * ones, at_ns))
        assert lost[1:3].tolist() == [not stands] * 2
    assert np.isfinite(distances_m(poses, tags, ones, 2 * ones, at_ns))[[0, 3]].all()
