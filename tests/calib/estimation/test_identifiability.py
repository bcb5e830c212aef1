"""Pairs of tags, which delays they determine, and from how many ranges on a group has a curve."""

from dataclasses import replace

import numpy as np
import pytest

from calib.errors import UnanswerableError
from calib.estimator.range_model import MIN_RANGES_OF_GROUP as FEWEST
from calib.fitting.fitting import fit
from calib.pairs import pairs_of
from tests.calib.synthetic import ranges


def test_pairs_are_numbered_by_their_tags_and_a_single_range_makes_one():
    initiator, target = np.array([9, 2, 5, 2, 5]), np.array([2, 9, 2, 9, 9])
    found = pairs_of(initiator, target)
    assert found.ends.tolist() == [[2, 5], [2, 9], [5, 9]]
    assert found.number.tolist() == [1, 1, 0, 1, 2]
    assert found.names == ("2-5", "2-9", "5-9")
    assert pairs_of(np.array([1, 3]), np.array([3, 7])).number.tolist() == [0, 1]


@pytest.mark.parametrize(
    ("pairs", "free"),
    [
        ([(1, 2)], [[1, 2]]),
        ([(1, 2), (1, 3), (1, 7)], [[1, 2, 3, 7]]),
        ([(1, 3), (1, 7), (2, 3), (2, 7)], [[1, 2, 3, 7]]),
        ([(1, 2), (3, 7)], [[1, 2], [3, 7]]),
        ([(1, 2), (1, 3), (2, 3), (3, 7)], []),
    ],
)
def test_delays_that_pairs_leave_free_are_named(pairs, free):
    r = ranges(1200)
    r = r[np.array([(i, j) in pairs for i, j in zip(r.initiator, r.target, strict=True)])]
    found = fit(r, minimum_norm=True).calibration
    assert found.provenance.get("undetermined", []) == free
    if free:
        with pytest.raises(UnanswerableError) as refused:
            fit(r)
        assert refused.value.undetermined == free


@pytest.mark.parametrize("loss", ["mixture", "cauchy"])
def test_delays_of_bipartite_pairs_are_the_smallest_on_request(loss):
    """Clock skews that vary, as those of real boards, would pin the free direction to a hundred nanoseconds."""
    r = ranges(8000)
    skew = np.random.default_rng(2).normal(0, 1e-6, len(r))
    r = replace(r, weight_target=0.5 * (1 + skew))[np.isin(r.initiator, [1, 2]) & np.isin(r.target, [3, 7])]
    delays = fit(r, minimum_norm=True, loss=loss).calibration.delays_ns
    assert delays[1] + delays[2] == pytest.approx(delays[3] + delays[7], abs=0.01)


@pytest.mark.parametrize("count", [FEWEST - 1, FEWEST])
def test_a_group_has_a_curve_from_the_fewest_ranges_on(count):
    r = ranges(3000)
    rare = (r.initiator != 7) & (r.target != 7)
    rare[np.flatnonzero(~rare)[:count]] = True
    groups = {"a": (1, 2, 3), "b": (7,)}
    if count < FEWEST:
        with pytest.raises(UnanswerableError, match="group 'b'"):
            fit(r[rare], groups=groups, loss="cauchy")
    else:
        assert set(fit(r[rare], groups=groups, loss="cauchy").calibration.groups) == {"a", "b"}
