"""In which order a design keeps its rows, and how they are cut: blocks, runs within them, and what sorts keys."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calib.long_columns import empty, let_go, spans
from uwblink.arrays import Floats, Ints

Order = NDArray[np.signedinteger[Any]]
"""Numbers of rows, in as few bytes as they take."""

DIGIT: Final = 1 << 16

WIDE: Final = 1 << 31
"""Rows whose numbers take more than four bytes."""


@dataclass(frozen=True, slots=True)
class Runs:
    """Stretches of kept rows within blocks of a design: `starts` (runs + 1,) bound them, `block` (runs,) is theirs."""

    starts: Ints
    block: Ints

    def sums(self, *stacked: Floats) -> Floats:
        """Return sums of columns (k, n) over the rows of each run (runs, k)."""
        return np.vstack([np.add.reduceat(some, self.starts[:-1], axis=-1) for some in stacked]).T

    @property
    def lengths(self) -> Ints:
        """Return the number of rows of each run (runs,)."""
        return np.diff(self.starts)

    def rows(self, values: Ints) -> Ints:
        """Return what rows (n,) have, of what runs have (runs,)."""
        return np.repeat(values, self.lengths)


def cut(starts: Ints, most: int) -> Ints:
    """Return bounds of blocks with more between them, so that none has more rows than `most`."""
    counts = np.diff(starts)
    parts = -(-counts // most)
    if not np.any(parts > 1):
        return starts
    within = _within(parts)
    which = np.repeat(np.arange(len(counts)), parts)
    return np.append(starts[which] + within * counts[which] // parts[which], starts[-1])


def _within(parts: Ints) -> Ints:
    """Return 0, 1, 2 ... anew for each number of parts."""
    return np.asarray(np.arange(int(parts.sum())) - np.repeat(np.cumsum(parts) - parts, parts))


def stable_order(key: Ints) -> Order:
    """Return what sorts keys from 0 (n,), equal ones in their order: by digits, much faster than by comparison."""
    if len(key) and int(key.max()) < DIGIT and len(key) < WIDE:
        return _few_sorted(key)
    order = np.argsort((key % DIGIT).astype(np.uint16), kind="stable")
    high = key // DIGIT
    while high.any():
        order = order[np.argsort((high[order] % DIGIT).astype(np.uint16), kind="stable")]
        high = high // DIGIT
    return order


def _few_sorted(key: Ints) -> Order:
    """Return what sorts keys (n,) of one digit, some rows at a time, each to its place behind the equal ones before."""
    found, size = empty(len(key), np.int32), int(key.max()) + 1
    counts = np.zeros(size, dtype=np.int64)
    for rows in spans(len(key)):
        counts += np.bincount(key[rows], minlength=size)
    free = np.cumsum(counts) - counts
    for rows in spans(len(key)):
        own = np.argsort(key[rows].astype(np.uint16), kind="stable")
        sizes = np.bincount(key[rows], minlength=size)
        found[np.repeat(free - np.cumsum(sizes) + sizes, sizes) + np.arange(len(own))] = own + rows.start
        free += sizes
        let_go(found, key)
    return found
