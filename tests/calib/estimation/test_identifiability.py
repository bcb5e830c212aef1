"""Which delays the pairs of tags determine."""

import numpy as np
import pytest

from calib.errors import UnanswerableError
from calib.estimation.identifiability import identifiable_directions, require_determined
from calib.estimation.robust import design
from tests.calib.synthetic import ranges


@pytest.mark.parametrize("pairs", [[(1, 2)], [(1, 2), (1, 3), (1, 7)], [(1, 3), (1, 7), (2, 3), (2, 7)]])
def test_bipartite_pairs_do_not_determine_delays(pairs):
    r = ranges(600)
    keep = np.array([(i, j) in pairs for i, j in zip(r.initiator, r.target, strict=True)])
    r = r[keep]
    directions, free = identifiable_directions(design(r, r.tags()), r.tags(), r.initiator, r.target)
    assert free == [r.tags()]
    assert directions.shape == (len(r.tags()), len(r.tags()) - 1)
    with pytest.raises(UnanswerableError, match=r"tags 1, (2|3)"):
        require_determined(free)


def test_three_tags_that_all_range_are_determined():
    r = ranges(600)
    r = r[np.isin(r.initiator, [1, 2, 3]) & np.isin(r.target, [1, 2, 3])]
    directions, free = identifiable_directions(design(r, r.tags()), r.tags(), r.initiator, r.target)
    assert free == []
    require_determined(free)
    np.testing.assert_array_equal(directions, np.eye(3))


def test_groups_that_shift_together_are_told_apart():
    r = ranges(600)
    keep = np.array([(i, j) in [(1, 2), (3, 7)] for i, j in zip(r.initiator, r.target, strict=True)])
    r = r[keep]
    assert identifiable_directions(design(r, r.tags()), r.tags(), r.initiator, r.target)[1] == [[1, 2], [3, 7]]
