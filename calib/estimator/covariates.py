"""Delays of antennas over direction and temperature as unknowns: sums over both ends of a range.

All tags share a dependence, or each tag has its own. For directions, each pair of bodies and each pair of tags has a
further dependence. These are effects of places (a wall that is in front of a robot whenever it heads north); they are
fitted so that they are not taken for antennas. All have the mean zero and an estimated standard deviation, like offsets
of pairs. Slopes over temperature vary around a common slope; its prior is from the manual of the DW1000.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from calib.calibration.patterns import harmonics
from calib.data.ranges import Ranges
from calib.estimator.range_rows import Part, block_of
from calib.estimator.unknowns import Prior, Unknown
from calib.pairs import Pairs
from uwblink.arrays import Bools, Floats, Ints

COMMON, OWN, OF_BODIES, OF_PAIR = "pattern", "pattern of tag", "pattern of bodies", "pattern of pair"
"""Kinds of unknowns: of all antennas, of one, of two bodies, and of a pair of tags."""

WARMTH, OWN_WARMTH = "temperature", "temperature of tag"
"""Kinds of unknowns, m/K: the common slope of ranges over the temperature of either end, and its deviation
for a tag.
"""

SPREAD_M = (0.02, 1e-4, 0.3)
"""Standard deviation of coefficients of harmonics: start, and bounds of the estimate, m. Published antennas have
patterns of up to 0.25 m."""

PRIORS = {
    **dict.fromkeys((COMMON, OWN), Prior.of_spread(*SPREAD_M)),
    # A smaller start, so that effects of places do not absorb a pattern in the first steps.
    **dict.fromkeys((OF_BODIES, OF_PAIR), Prior.of_spread(0.005, *SPREAD_M[1:])),
    # The mean of the DW1000 user manual (8.3.1), which gives no spread. Users see up to 2 cm/K (lps-node-firmware 56):
    # 95 % of this prior lie between -1.6 and 2 cm/K.
    WARMTH: Prior.of_deviation(0.0091, 0.00215),
    OWN_WARMTH: Prior.of_spread(0.001, 1e-5, 0.02),
}
"""Priors of coefficients of harmonics (m) and of slopes (m/K)."""

LEAST_SQUARE = 0.2
"""Minimum mean square of a harmonic over the fitted directions for which it is fitted; over all directions it is 1. A
judgement: in a hall where it was 0.09 and less, coefficients of 6 cm made another flight worse by 5 cm."""


@dataclass(frozen=True, kw_only=True)
class Covariate:
    """Values of a covariate minus their `centre` (k,) at both ends of ranges, `lower` first (the smaller id), (n, k).

    Unknown values are 0, and so are directions at tags whose bodies do not turn; `tags` are the tags with other values,
    `bodies` the bodies of tags; `square` (k, k) is the mean product of two values of these tags, and `span` (2, k) are
    the smallest and the largest.
    """

    tags: tuple[int, ...]
    centre: Floats
    lower: Floats
    higher: Floats
    square: Floats
    span: Floats
    bodies: dict[int, str]

    @classmethod
    def of_directions(cls, ranges: Ranges) -> Covariate:
        """Return harmonics over directions; without tags where no direction is known or no body turns."""
        some = np.isfinite(ranges.toward).all(axis=2) & np.isin(ranges.ends, ranges.turning)
        return cls._of(ranges, some, harmonics(ranges.toward[some]), LEAST_SQUARE)

    @classmethod
    def of_temperatures(cls, ranges: Ranges) -> Covariate:
        """Return temperatures in degrees Celsius; without tags where none is known."""
        some = np.isfinite(ranges.temperature_c)
        return cls._of(ranges, some, ranges.temperature_c[some, None].astype(np.float64), 0.0)

    @classmethod
    def _of(cls, ranges: Ranges, some: Bools, known: Floats, least_square: float) -> Covariate:
        """Return the `known` values (m, k) of `some` ends (n, 2), without those that hardly vary."""
        values = np.zeros((*some.shape, known.shape[1]))
        centre, span = np.zeros(known.shape[1]), np.zeros((2, known.shape[1]))
        if len(known):
            centre, span = known.mean(axis=0), np.array([known.min(axis=0), known.max(axis=0)])
            known -= centre
            # In a flight at one height, the dependence on elevation is not determined, and is not extrapolated.
            known[:, np.einsum("nk,nk->k", known, known) < least_square * len(known)] = 0.0
            values[some] = known
        square = known.T @ known / max(len(known), 1)
        # For millions of ranges these arrays have gigabytes.
        del known
        first = np.where(ranges.initiator < ranges.target, 0, 1)
        lower, higher = (values[np.arange(len(ranges)), side] for side in (first, 1 - first))
        tags, bodies = tuple(np.unique(ranges.ends[some]).tolist()), dict(ranges.bodies)
        return cls(tags=tags, centre=centre, lower=lower, higher=higher, square=square, span=span, bodies=bodies)

    def entries(self, kind: str, pairs: Pairs) -> tuple[tuple[str, ...], Ints, Floats]:
        """Return the names of the unknowns of a kind, and the columns and values (n, m) of each range."""
        each, count = np.arange(len(self.centre)), len(self.lower)
        if kind in (COMMON, WARMTH):
            return tuple(map(str, each)), np.broadcast_to(each, (count, len(each))), self.lower + self.higher
        whose = [[self._owner(kind, tag, both) for tag in both] for both in pairs.ends.tolist()]
        names = sorted({one for both in whose for one in both if one})
        ends = np.array([[names.index(one) if one else 0 for one in both] for both in whose])
        columns = (ends[:, :, None] * len(each) + each).reshape(len(ends), -1)
        values = np.concatenate([self.lower, self.higher], axis=1)
        return tuple(f"{name} {k}" for name in names for k in each), columns[pairs.number], values

    def apart_from_places(self, pairs: Pairs) -> bool:
        """Return whether each body ranges with more than two others: with fewer, effects of places can replace own
        patterns.
        """
        bodies = {self.bodies.get(tag, str(tag)) for tag in self.tags}
        return len(self.entries(OF_BODIES, pairs)[0]) > 2 * len(self.centre) * len(bodies)

    def _owner(self, kind: str, tag: int, pair: list[int]) -> tuple[int | str, ...]:
        """Return the owner of the unknowns of a kind that a tag has in a pair, () if it has no value."""
        if tag not in self.tags:
            return ()
        body, *both = (self.bodies.get(one, f"tag {one}") for one in (tag, *pair))
        owners: dict[str, tuple[int | str, ...]] = {OF_BODIES: (*sorted(both), body), OF_PAIR: (*pair, tag)}
        return owners.get(kind, (tag,))

    def blocks(self, kinds: tuple[str, ...], pairs: Pairs) -> Iterator[tuple[Unknown, Part]]:
        """Yield unknowns of some kinds, and the part that they have in residuals."""
        for kind in kinds:
            names, columns, values = self.entries(kind, pairs)
            unknown = Unknown(kind=kind, names=names, start=np.zeros(len(names)), priors=(PRIORS[kind],))
            yield block_of(unknown, columns, -values)


OF_PLACES = (OF_BODIES, OF_PAIR)
COVARIATES: dict[str, tuple[Callable[[Ranges], Covariate], dict[str, tuple[str, ...]]]] = {
    "temperature": (Covariate.of_temperatures, {"shared": (WARMTH,), "tag": (WARMTH, OWN_WARMTH)}),
    "pattern": (Covariate.of_directions, {"shared": (COMMON, *OF_PLACES), "tag": (OWN, *OF_PLACES)}),
}
"""Covariates by setting, and the kinds of unknowns by the value of the setting.

Temperatures come first: a drift could be taken for a pattern, but a pattern, which turns with the robot, is not taken
for a drift.
"""
