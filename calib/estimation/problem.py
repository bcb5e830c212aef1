"""A fit as linear algebra: which columns stand for which delays and which pieces of which curve."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib.calibration.power_curves import (
    Bins,
    curvature,
)
from calib.data.ranges import COLUMNS, Ranges
from calib.estimation.design import Design
from calib.estimation.unknowns import Unknowns
from calib.estimator.pairs import Pairs
from calib.estimator.time_blocks import TimeBlocks
from calib.long_columns import computed, let_go
from uwblink.arrays import Bools, Floats, Ints

CELLS: Final = 8
"""Steps of power in which share of reflections and noise may differ."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """Residuals `error + design @ x` (n,) metres; x = delays by way of `directions`, then the curves' coefficients.

    `directions` (tags, rank) turns the first parameters into delays of `tags` in ns; it is the identity where the data
    determine all. `gauges` hold for each of `groups` the first parameters (rank,) that make up for a constant metre in
    its curve, None where pinned delays leave none that do; the splines of a group are less `centres` (groups, splines),
    their averages over the range where a constant is left to the delays. `shares` say how much of each group's curve is
    in a range, None for all of it. What pinned tags add is in `error` already. `bins` hold the rows of the whole
    problem, `span` is the range of power with data. Rows are in order of
    sessions and of time in them, which is cut into `blocks`. `free` are the groups of tags that
    nothing determines.

    `unknowns` say what is looked for. Without a curve there are no splines, and `powered` (n,) says which ranges have a
    power. Where constants belong to pairs, `tags` are the numbers of `pairs` instead.
    """

    ranges: Ranges
    tags: list[int]
    directions: Floats
    error: Floats
    design: Design
    lifted: Floats
    pairs: Pairs
    bins: Bins
    span: tuple[float, float]
    knots: Floats
    centres: Floats
    gauges: tuple[Floats | None, ...]
    groups: tuple[str, ...]
    shares: list[Floats | None]
    free: list[list[int]]
    unknowns: Unknowns
    powered: Bools
    blocks: TimeBlocks

    def share(self, group: int) -> Floats:
        """Return how much of a group's curve is in each range (n,): a half for each end."""
        share = self.shares[group]
        return np.ones(len(self.error)) if share is None else share

    def without_readings(self) -> Problem:
        """Return the problem without the columns of ranges that are in errors and design by now.

        Times, ends and true distances stay; millions of the rest need not be there twice.
        """
        nothing = np.broadcast_to(np.nan, len(self.error))
        self.let_go()
        bare = replace(
            self.ranges,
            protocol=np.broadcast_to(np.array(""), len(self.error)),
            raw_m=nothing,
            weight_initiator=nothing,
            weight_target=nothing,
            fpp1_dbm=nothing,
            fpp2_dbm=nothing,
        )
        return replace(self, ranges=bare)

    def without_design(self) -> Problem:
        """Return the problem for those who only ask what was looked for, and at which powers."""
        self.let_go()
        return replace(self, error=np.empty(0), design=self.design.without_rows())

    def let_go(self) -> None:
        """Leave what lies in files to them."""
        let_go(self.error, self.lifted, self.pairs.number, self.bins.number)
        let_go(*(getattr(self.ranges, name) for name in COLUMNS))

    def residuals(self, x: Floats) -> Floats:
        """Return what parameters (m,) leave of the errors (n,)."""
        fitted = self.design @ x
        found = computed(len(fitted), lambda rows: self.error[rows] + fitted[rows])
        let_go(self.error, found)
        return found

    @property
    def rank(self) -> int:
        """Return how many parameters stand for delays."""
        return int(self.directions.shape[1])

    @property
    def cell(self) -> Ints:
        """Return the step of power of each range (n,)."""
        return computed(len(self.bins.number), self.cell_of, np.int32)

    def cell_of(self, rows: slice) -> Ints:
        """Return the step of power of some ranges."""
        return np.asarray(self.bins.number[rows] * CELLS // len(self.bins.count))

    def penalties(self) -> list[Floats]:
        """Return the roughness of each group's curve as a matrix over all parameters; none where none is fitted."""
        if not self.unknowns.curve:
            return []
        rough, found = curvature(self.knots), []
        for _, columns in self.curves():
            penalty = np.zeros((self.design.shape[1],) * 2)
            penalty[columns, columns] = rough
            found.append(penalty)
        return found

    def curves(self) -> Iterator[tuple[str, slice]]:
        """Yield the groups and the columns of their splines."""
        each = self.centres.shape[1]
        for k, name in enumerate(self.groups):
            yield name, slice(self.rank + k * each, self.rank + (k + 1) * each)
