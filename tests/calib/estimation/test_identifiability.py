"""Which delays the pairs of tags determine."""

from dataclasses import replace

import numpy as np
import pytest

from calib.errors import UnanswerableError
from calib.estimator.identifiability import free_directions, square_of
from calib.fitting.fitting import fit
from tests.calib.synthetic import design, ranges
from uwblink.ticks import SPEED_OF_LIGHT


def directions_of(r):
    square, pairs = square_of(r.tags(), r.initiator, r.target, r.weight_initiator, r.weight_target)
    return free_directions(square, r.tags(), pairs)


def test_the_square_is_that_of_the_matrix_written_out():
    r = ranges(600)
    matrix = design(r, r.tags()) / (SPEED_OF_LIGHT * 1e-9)
    square, pairs = square_of(r.tags(), r.initiator, r.target, r.weight_initiator, r.weight_target)
    np.testing.assert_allclose(square, matrix.T @ matrix, rtol=1e-12)
    there = set(zip(r.initiator.tolist(), r.target.tolist(), strict=True))
    assert {(a, b) for a, b in pairs.tolist()} == there | {(b, a) for a, b in there}


@pytest.mark.parametrize("pairs", [[(1, 2)], [(1, 2), (1, 3), (1, 7)], [(1, 3), (1, 7), (2, 3), (2, 7)]])
def test_bipartite_pairs_do_not_determine_delays(pairs):
    r = ranges(600)
    keep = np.array([(i, j) in pairs for i, j in zip(r.initiator, r.target, strict=True)])
    r = r[keep]
    directions, free = directions_of(r)
    assert free == [r.tags()]
    sides = np.where(np.isin(r.tags(), [low for low, _ in pairs]), 1, -1)
    np.testing.assert_allclose(directions * sides[:, None] * sides[0], directions[0, 0], rtol=1e-4)
    with pytest.raises(UnanswerableError, match=r"tags 1, (2|3)"):
        fit(r)


def test_three_tags_that_all_range_are_determined():
    r = ranges(600)
    r = r[np.isin(r.initiator, [1, 2, 3]) & np.isin(r.target, [1, 2, 3])]
    directions, free = directions_of(r)
    assert free == []
    assert directions.shape == (3, 0)


def test_groups_that_shift_together_are_told_apart():
    r = ranges(600)
    keep = np.array([(i, j) in [(1, 2), (3, 7)] for i, j in zip(r.initiator, r.target, strict=True)])
    r = r[keep]
    assert directions_of(r)[1] == [[1, 2], [3, 7]]


@pytest.mark.parametrize("loss", ["mixture", "cauchy"])
def test_delays_of_bipartite_pairs_are_the_smallest_on_request(loss):
    """Clock skews that vary, as those of real boards, would pin the free direction to a hundred nanoseconds."""
    r = ranges(8000)
    skew = np.random.default_rng(2).normal(0, 1e-6, len(r))
    r = replace(r, weight_target=0.5 * (1 + skew))[np.isin(r.initiator, [1, 2]) & np.isin(r.target, [3, 7])]
    delays = fit(r, minimum_norm=True, loss=loss).calibration.delays_ns
    assert delays[1] + delays[2] == pytest.approx(delays[3] + delays[7], abs=0.01)
