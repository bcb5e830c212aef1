"""Numbers of the pairs of tags in ranges; both directions are one pair."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from uwblink.arrays import Ints


@dataclass(frozen=True, slots=True)
class Pairs:
    """The pair of each range, `number` (n,), and the tags of each pair, `ends` (pairs, 2), the smaller id first."""

    number: Ints
    ends: Ints

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the pairs, such as 1-2."""
        return tuple(f"{a}-{b}" for a, b in self.ends.tolist())

    def among(self, tags: Sequence[int]) -> Ints:
        """Return the indices (n, 2) of both tags of each range among `tags` in order, the lower tag's first."""
        return np.searchsorted(tags, self.ends)[self.number]


def pairs_of(initiator: Ints, target: Ints) -> Pairs:
    """Return the pairs of ranges (n,), numbered in order of their smaller id, then of their larger id."""
    low, high = np.minimum(initiator, target).astype(np.int64), np.maximum(initiator, target).astype(np.int64)
    codes, number = np.unique(low << 32 | high, return_inverse=True)
    return Pairs(number.astype(np.int32), np.column_stack([codes >> 32, codes & 0xFFFFFFFF]))


def pairs_of_bodies(pairs: Pairs, bodies: Mapping[int, str]) -> Ints | None:
    """Return the number of the two bodies of each pair (pairs,), by the body of each tag; None if no two pairs have the
    same bodies.

    A tag without a known body is a body itself.
    """
    ends = [frozenset(bodies.get(tag, f"tag {tag}") for tag in both) for both in pairs.ends.tolist()]
    number = {both: k for k, both in enumerate(dict.fromkeys(ends))}
    return np.array([number[both] for both in ends]) if len(number) < len(ends) else None
