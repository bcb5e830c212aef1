"""The pair of tags of each range, in either direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uwblink.arrays import Ints


@dataclass(frozen=True, slots=True)
class Pairs:
    """The pair of each range, `number` (n,), and the tags of every pair, the lower first: `ends` (pairs, 2)."""

    number: Ints
    ends: Ints


def pairs_of(initiator: Ints, target: Ints, tags: list[int]) -> Pairs:
    """Number the pairs of ranges (n,) between `tags`, in order of their lower tags, then of their higher ones."""
    known = np.array(tags)

    first, second = places_of(tags, initiator, target)
    key = np.minimum(first, second) * len(tags) + np.maximum(first, second)
    there = np.bincount(key) > 0
    low, high = np.divmod(np.flatnonzero(there), len(tags))
    place = np.cumsum(there) - 1
    number = place[key].astype(np.int32)
    return Pairs(number, np.column_stack([known[low], known[high]]))


def places_of(tags: list[int], *ids: Ints) -> list[Ints]:
    """Return for each of `ids` (n,) its place among ascending tags."""
    place = np.zeros(tags[-1] + 1, dtype=np.int64)
    place[tags] = np.arange(len(tags))
    return [place[some] for some in ids]
