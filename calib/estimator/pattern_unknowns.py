"""Delays of antennas over direction as unknowns: harmonics in the frames of bodies that turn.

A pattern is shared by all antennas, or each has its own. Beside it two bodies have a part of their own, and two tags:
these belong to places (a wall that a robot sees whenever it heads north), and are fitted so that they do not pass for
the antennas'. All are draws about zero whose standard deviations are estimated, as those of offsets of pairs are.
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

COMMON, OWN, OF_BODIES, OF_PAIR = "pattern", "pattern of tag", "pattern of bodies", "pattern of pair"
"""Kinds of unknowns: of all antennas, of one, of two bodies, and of a pair of tags."""

SPREAD_M = (0.02, 1e-4, 0.3)
"""Standard deviation of factors of harmonics: start, and bounds between which it is estimated, m. Published antennas
have patterns of up to 0.25 m."""


OF_PLACES_M = (0.005, *SPREAD_M[1:])
"""The same of what belongs to places: a smaller start, so that it does not take a pattern at once."""

LEAST_SQUARE = 0.2
"""Mean square of a harmonic over the fitted directions from which it is fitted, of 1 over all directions. A judgement:
in a hall where it was 0.09 and less, factors of 6 cm made another flight worse by 5 cm."""


@dataclass(frozen=True, kw_only=True)
class Directions:
    """Harmonics less their `centre` (8,) at both ends of ranges, `lower` first (the smaller id), (n, 8) each.

    They are 0 where a direction is not known and at tags whose bodies do not turn; `tags` are those that have others,
    and `bodies` are those that carry tags; `square` (8, 8) is the mean product of two harmonics there.
    """

    tags: tuple[int, ...]
    centre: Floats
    lower: Floats
    higher: Floats
    square: Floats
    bodies: dict[int, str]

    @classmethod
    def of(cls, ranges: Ranges) -> Directions:
        """Return those of ranges; without tags where no direction is known or no body turns."""
        ends = np.stack([ranges.initiator, ranges.target], axis=1)
        some = np.isfinite(ranges.toward).all(axis=2) & np.isin(ends, ranges.turning)
        values = np.zeros((*ends.shape, HARMONICS))
        values[some] = harmonics(ranges.toward[some])
        centre = values[some].mean(axis=0) if some.any() else np.zeros(HARMONICS)
        values[some] -= centre
        # In a flight on one level, what goes with elevation stays unknown, and is not extrapolated.
        values[..., np.mean(values[some] ** 2, axis=0) < LEAST_SQUARE if some.any() else []] = 0.0
        first = np.where(ranges.initiator < ranges.target, 0, 1)
        lower, higher = (values[np.arange(len(ranges)), side] for side in (first, 1 - first))
        square = values[some].T @ values[some] / max(np.count_nonzero(some), 1)
        tags = tuple(np.unique(ends[some]).tolist())
        return cls(tags=tags, centre=centre, lower=lower, higher=higher, square=square, bodies=dict(ranges.bodies))

    def entries(self, kind: str, pairs: Pairs) -> tuple[tuple[str, ...], Ints, Floats]:
        """Return the names of the unknowns of a kind, and of each range the columns and values (n, k) that it has."""
        each, count = np.arange(HARMONICS), len(self.lower)
        if kind == COMMON:
            return tuple(map(str, each)), np.broadcast_to(each, (count, HARMONICS)), self.lower + self.higher
        whose = [[self._owner(kind, tag, both) for tag in both] for both in pairs.ends.tolist()]
        names = sorted({one for both in whose for one in both if one})
        ends = np.array([[names.index(one) if one else 0 for one in both] for both in whose])
        columns = (ends[:, :, None] * HARMONICS + each).reshape(len(ends), -1)
        values = np.concatenate([self.lower, self.higher], axis=1)
        return tuple(f"{name} {k}" for name in names for k in each), columns[pairs.number], values

    def apart_from_places(self, pairs: Pairs) -> bool:
        """Return whether bodies see more than two others each: with fewer, places can do all that own patterns do."""
        bodies = {self.bodies.get(tag, str(tag)) for tag in self.tags}
        return len(self.entries(OF_BODIES, pairs)[0]) > 2 * HARMONICS * len(bodies)

    def _owner(self, kind: str, tag: int, pair: list[int]) -> tuple[int | str, ...]:
        """Return whose unknowns of a kind a tag has in a pair, () where it sees no direction."""
        if tag not in self.tags:
            return ()
        body, *both = (self.bodies.get(one, f"tag {one}") for one in (tag, *pair))
        owners: dict[str, tuple[int | str, ...]] = {OF_BODIES: (*sorted(both), body), OF_PAIR: (*pair, tag)}
        return owners.get(kind, (tag,))

    def blocks(self, kinds: tuple[str, ...], pairs: Pairs) -> Iterator[tuple[Unknown, Part]]:
        """Yield unknowns of some kinds, and the part that they have in residuals."""
        for kind in kinds:
            names, columns, values = self.entries(kind, pairs)
            spread = OF_PLACES_M if kind in OF_PLACES else SPREAD_M
            yield scattered(kind, names, spread), Part(parameter=RESIDUAL, kind=kind, columns=columns, values=-values)


OF_PLACES = (OF_BODIES, OF_PAIR)
KINDS = {"shared": (COMMON, *OF_PLACES), "tag": (OWN, *OF_PLACES)}
"""Kinds of unknowns by the setting `pattern`."""
