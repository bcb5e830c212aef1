"""Delays of antennas over direction as unknowns: harmonics in the frames of bodies that turn.

A pattern has a part that all antennas share, one of each antenna, and one of each pair of tags. The last belongs to
places (a wall that a robot sees whenever it heads north), and is fitted so that it does not pass for the antennas'. All
three are draws about zero whose standard deviations are estimated, as those of offsets of pairs are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from calib.calibration.patterns import HARMONICS, harmonics
from calib.data.ranges import Ranges
from calib.estimator.grouped_errors import scattered
from calib.estimator.range_rows import RESIDUAL, Part
from calib.estimator.unknowns import Unknown
from calib.pairs import Pairs
from uwblink.arrays import Floats, Ints

SHARED, OWN, OF_PAIR = "pattern", "pattern of tag", "pattern of pair"
"""Kinds of unknowns: of all antennas, of one, and of a pair of tags."""

SPREAD_M = (0.02, 1e-4, 0.3)
"""Standard deviation of factors of harmonics: start, and bounds between which it is estimated, m. Published antennas
have patterns of up to 0.25 m."""


@dataclass(frozen=True, kw_only=True)
class Directions:
    """Harmonics less their `centre` (8,) at both ends of ranges, `lower` first (the smaller id), (n, 8) each.

    They are 0 where a direction is not known and at tags whose bodies do not turn; `tags` are those that have others,
    and `square` (8, 8) is the mean product of two harmonics there.
    """

    tags: tuple[int, ...]
    centre: Floats
    lower: Floats
    higher: Floats
    square: Floats

    @classmethod
    def of(cls, ranges: Ranges) -> Directions:
        """Return those of ranges; without tags where no direction is known or no body turns."""
        ends = np.stack([ranges.initiator, ranges.target], axis=1)
        some = np.isfinite(ranges.toward).all(axis=2) & np.isin(ends, ranges.turning)
        values = np.zeros((*ends.shape, HARMONICS))
        values[some] = harmonics(ranges.toward[some])
        centre = values[some].mean(axis=0) if some.any() else np.zeros(HARMONICS)
        values[some] -= centre
        first = np.where(ranges.initiator < ranges.target, 0, 1)
        lower, higher = (values[np.arange(len(ranges)), side] for side in (first, 1 - first))
        square = values[some].T @ values[some] / max(np.count_nonzero(some), 1)
        tags = tuple(np.unique(ends[some]).tolist())
        return cls(tags=tags, centre=centre, lower=lower, higher=higher, square=square)

    def entries(self, kind: str, pairs: Pairs) -> tuple[tuple[str, ...], Ints, Floats]:
        """Return the names of the unknowns of a kind, and of each range the columns and values (n, k) that it has.

        A pair's own part goes by the direction at its lower tag, or at the higher one if the lower has none.
        """
        each, count = np.arange(HARMONICS, dtype=np.int32), len(self.lower)
        if kind == SHARED:
            return tuple(map(str, each)), np.broadcast_to(each, (count, HARMONICS)), self.lower + self.higher
        if kind == OWN:
            whose, ends = tuple(map(str, self.tags)), np.searchsorted(self.tags, pairs.ends) % len(self.tags)
            values = np.concatenate([self.lower, self.higher], axis=1)
        else:
            whose, ends = pairs.names, np.arange(len(pairs.ends))[:, None]
            seen = np.isin(pairs.ends[:, 0], self.tags)[pairs.number]
            values = np.where(seen[:, None], self.lower, self.higher)
        columns = (ends[:, :, None] * HARMONICS + each).reshape(len(ends), -1).astype(np.int32)
        return tuple(f"{name} {k}" for name in whose for k in each), columns[pairs.number], values

    def blocks(self, kinds: tuple[str, ...], pairs: Pairs) -> Iterator[tuple[Unknown, Part]]:
        """Yield unknowns of some kinds, and the part that they have in residuals."""
        for kind in kinds:
            names, columns, values = self.entries(kind, pairs)
            yield scattered(kind, names, SPREAD_M), Part(parameter=RESIDUAL, kind=kind, columns=columns, values=-values)


KINDS = {"shared": (SHARED, OF_PAIR), "tag": (SHARED, OWN, OF_PAIR)}
"""Kinds of unknowns by the setting `pattern`."""
