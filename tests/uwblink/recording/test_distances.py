"""True distances from poses and lever arms."""

import numpy as np
import pytest

from uwblink.recording.distances import distances_m
from uwblink.recording.schema import Poses, Tag

LEVEL = (0, 0, 0, 1)
YAW_90 = (0, 0, np.sqrt(0.5), np.sqrt(0.5))
NEGATED = tuple(-q for q in YAW_90)


@pytest.mark.parametrize(
    ("begin", "end", "stands", "time_ns", "expected"),
    [
        # At half time body a is at (1, 0, 0), and its arm, turned by 90 degrees, points along y.
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
