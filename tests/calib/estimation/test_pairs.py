"""Pairs of tags, numbered whoever initiated; one range is enough for a pair to be one."""

import numpy as np

from calib.pairs import pairs_of


def test_pairs_are_numbered_by_their_tags_and_a_single_range_makes_one():
    initiator, target = np.array([9, 2, 5, 2, 5]), np.array([2, 9, 2, 9, 9])
    found = pairs_of(initiator, target)
    assert found.ends.tolist() == [[2, 5], [2, 9], [5, 9]]
    assert found.number.tolist() == [1, 1, 0, 1, 2]
    rare = pairs_of(np.array([1, 3]), np.array([3, 7]))
    assert rare.ends.tolist() == [[1, 3], [3, 7]]
    assert rare.number.tolist() == [0, 1]
