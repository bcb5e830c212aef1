"""True distances from poses and lever arms."""

import numpy as np
import pytest

from uwblink.recording.distances import distances_m
from uwblink.recording.schema import Poses, Tag


def poses(rows):
    time, body, position, quaternion = zip(*rows, strict=True)
    return Poses(np.array(time), np.array(body), np.array(position, float), np.array(quaternion, float))


LEVEL = (0, 0, 0, 1)
YAW_90 = (0, 0, np.sqrt(0.5), np.sqrt(0.5))


def distance(p, tags, time_ns):
    one = np.array([1]), np.array([2]), np.array([time_ns])
    return distances_m(p, tags, *one)[0]


def test_positions_are_interpolated_and_lever_arms_turn_with_the_body():
    p = poses([(0, "a", (0, 0, 0), YAW_90), (100, "a", (2, 0, 0), YAW_90), (0, "b", (1, 4, 0), LEVEL)])
    tags = [Tag(1, "a", (1.0, 0.0, 0.0)), Tag(2, "b", (0.0, 0.0, 0.0))]
    # At half time body a is at (1, 0, 0), and its arm, turned by 90 degrees, points along y.
    assert distance(p, tags, 50) == pytest.approx(3.0)


def test_both_signs_of_a_quaternion_are_one_attitude():
    flipped = tuple(-q for q in YAW_90)
    p = poses([(0, "a", (0, 0, 0), YAW_90), (100, "a", (0, 0, 0), flipped), (0, "b", (0, 4, 0), LEVEL)])
    tags = [Tag(1, "a", (1.0, 0.0, 0.0)), Tag(2, "b", (0.0, 0.0, 0.0))]
    assert distance(p, tags, 50) == pytest.approx(3.0)


@pytest.mark.parametrize("time_ns", [-1, 101])
def test_outside_the_poses_there_is_no_truth(time_ns):
    p = poses([(0, "a", (0, 0, 0), LEVEL), (100, "a", (0, 0, 0), LEVEL), (0, "b", (0, 4, 0), LEVEL)])
    tags = [Tag(1, "a", (0.0, 0.0, 0.0)), Tag(2, "b", (0.0, 0.0, 0.0))]
    assert np.isnan(distance(p, tags, time_ns))
