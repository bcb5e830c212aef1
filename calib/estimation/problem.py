"""A fit as linear algebra: which columns stand for which delays and which pieces of which curve."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib.calibration.power_curves import (
    DEGREE,
    SIGMA_BINS,
    Bins,
    basis,
    curvature,
    equal_bins,
    lifted_power,
    populated,
)
from calib.errors import BadInputError, UnanswerableError
from calib.estimation.identifiability import identifiable_directions, require_determined
from calib.estimation.pairs import Pairs, pairs_of
from calib.estimation.robust import design
from calib.estimation.unknowns import Unknowns
from calib.ranges import Ranges
from uwblink.arrays import Bools, Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT

FEWEST: Final = 100
SPANNED: Final = 1e-4
"""Delays can make up for a constant of a curve if no more than this of it is left, in squares."""

SEGMENTS_A_FOLD: Final = 4.5
SEGMENTS: Final = (10, 28)
"""Pieces of a bias curve: so many where lifted power grows e-fold, and bounds of their number."""

SAME_POWER: Final = 1e-6
"""Lifted powers that differ by no more are one."""

ROWS_AT_ONCE: Final = 4096


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """Residuals `error + design @ x` (n,) metres; x = delays by way of `directions`, then the curves' coefficients.

    `directions` (tags, rank) turns the first parameters into delays of `tags` in ns; it is the identity where the data
    determine all. `gauges` hold for each of `groups` the first parameters (rank,) that make up for a constant metre in
    its curve, None where pinned delays leave none that do; the splines of a group are less `centres` (groups, splines),
    their averages over the range where a constant is left to the delays. `shares` say how much of each group's curve is
    in a range, None for all of it. What pinned tags add is in `error` already. `bins` hold the rows of the whole
    problem, `span` is the range of power with data. Rows are in order of time. `free` are the groups of tags that
    nothing determines.

    `unknowns` say what is looked for. Without a curve there are no splines, and `powered` (n,) says which ranges have a
    power. Where constants belong to pairs, `tags` are the numbers of `pairs` instead.
    """

    ranges: Ranges
    tags: list[int]
    directions: Floats
    error: Floats
    design: Floats
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

    def share(self, group: int) -> Floats:
        """Return how much of a group's curve is in each range (n,): a half for each end."""
        share = self.shares[group]
        return np.ones(len(self.error)) if share is None else share

    @property
    def rank(self) -> int:
        """Return how many parameters stand for delays."""
        return int(self.directions.shape[1])

    def sample(self, rows: Ints) -> Problem:
        """Return the problem of some rows only."""
        chosen = ("error", "design", "lifted", "powered")
        pairs = replace(self.pairs, number=self.pairs.number[rows])
        return replace(
            self, ranges=self.ranges[rows], pairs=pairs, **{name: getattr(self, name)[rows] for name in chosen}
        )

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


def build_problem(
    ranges: Ranges,
    *,
    lift: str,
    alpha_dbm: float,
    fixed: Mapping[int, float],
    groups: Mapping[str, tuple[int, ...]],
    minimum_norm: bool,
    sequential: bool = False,
    unknowns: Unknowns | None = None,
) -> Problem:
    """Put a fit into columns; raises what `calib.estimation.fitting.fit` raises.

    In a `sequential` one the curves keep their constants, and ranges of all powers stay, for the delays; so do they
    without a curve. Where power never changes no curve is looked for.
    """
    if len(ranges) < FEWEST:
        raise UnanswerableError(
            f"{ranges.source}: {len(ranges)} usable exchanges are too few, at least {FEWEST} are needed"
        )
    if np.any(np.diff(ranges.time_ns) < 0):
        ranges = ranges[np.argsort(ranges.time_ns, kind="stable")]
    lifted = lifted_power(ranges.fpp1_dbm, ranges.fpp2_dbm, lift, alpha_dbm)
    powered = np.isfinite(lifted)
    # What has no power stands at the middle of the others, where it bends nothing.
    lifted = np.where(powered, lifted, np.median(lifted[powered]) if powered.any() else 1.0)
    low, high = populated(np.sort(lifted))
    unknowns = (unknowns or Unknowns()).at_powers(varied=high - low > SAME_POWER)
    # Beyond the populated powers a curve is held constant: what it is there is not for these ranges to say.
    if not sequential and unknowns.curve:
        inside = (lifted >= low) & (lifted <= high)
        ranges, lifted, powered = ranges[inside], lifted[inside], powered[inside]
    ordered = np.sort(lifted)
    everyone = ranges.tags()
    shares = _shares(ranges, groups, everyone)
    matrix = design(ranges, everyone)
    _known_tags(everyone, fixed)
    pinned = np.array([tag in fixed or unknowns.of_pairs for tag in everyone])
    known = matrix[:, pinned] @ np.array([fixed.get(tag, 0.0) for tag in np.array(everyone)[pinned].tolist()])
    tags: list[int] = np.array(everyone)[~pinned].tolist()
    pairs = pairs_of(ranges.initiator, ranges.target, everyone)
    # Without a copy where nothing is pinned: a column of millions is not cheap.
    apart = _by_pairs(pairs) if unknowns.of_pairs else matrix[:, ~pinned] if pinned.any() else matrix
    directions, free = np.eye(apart.shape[1]), list[list[int]]()
    if unknowns.of_pairs:
        tags = list(range(len(pairs.ends)))
    elif tags:
        directions, free = identifiable_directions(apart, tags, ranges.initiator, ranges.target)
    delays = apart @ directions if free else apart
    _something_left(unknowns, tags)
    if not minimum_norm:
        require_determined(free)
    knots, averages = _splines(ordered, (low, high), unknowns)
    gauges = tuple(_making_up(delays, share) for share in shares)
    centred = [gauge is not None and not sequential for gauge in gauges]
    centres = np.outer(np.array(centred, dtype=float), averages)
    return Problem(
        ranges=ranges,
        tags=tags,
        directions=directions,
        error=ranges.raw_m - ranges.truth_m + known,
        design=_columns(delays, lifted, knots, centres, shares),
        lifted=lifted,
        pairs=pairs,
        bins=_bins(lifted, ordered),
        span=(low, high),
        knots=knots,
        centres=centres,
        gauges=gauges,
        groups=tuple(groups) or ("",),
        shares=shares,
        free=free,
        unknowns=unknowns,
        powered=powered,
    )


def _knots(ordered: Floats, low: float, high: float) -> Floats:
    """Return clamped knots from `low` to `high`, halfway between equal counts and equal lengths, both of square roots.

    Curves are steep where lifted power is small: there the roots lie dense, and few ranges do not spread them.
    Powers over more decades take more knots.
    """
    segments = int(np.clip(round(SEGMENTS_A_FOLD * np.log(high / low)), *SEGMENTS))
    counts = np.interp(np.linspace(0, len(ordered) - 1, segments + 1), np.arange(len(ordered)), ordered)
    roots = np.sqrt(np.clip(counts, low, high)) + np.linspace(np.sqrt(low), np.sqrt(high), segments + 1)
    inner = roots**2 / 4
    inner[[0, -1]] = low, high
    return np.concatenate([[low] * DEGREE, inner, [high] * DEGREE])


def _bins(lifted: Floats, ordered: Floats) -> Bins:
    """Return bins of equal counts of powers (n,) that stand sorted in `ordered` (n,), at least 20 each."""
    count, size = min(SIGMA_BINS, max(1, len(lifted) // 20)), len(lifted)
    edges = -(-np.arange(count + 1) * size // count)
    # Sorting values and looking them up is several times faster than sorting their places, which equal powers need.
    number = np.searchsorted(ordered[edges[1:-1]], lifted, side="right")
    counts = np.bincount(number, minlength=count)
    if 2 * int(counts.min()) < size // count:
        return equal_bins(lifted)
    return Bins(number, ordered[(edges[1:] + edges[:-1]) // 2], counts)


def _splines(ordered: Floats, span: tuple[float, float], unknowns: Unknowns) -> tuple[Floats, Floats]:
    """Return the knots of curves and each spline's average over their span; none where no curve is fitted."""
    if not unknowns.curve:
        return np.zeros(0), np.zeros(0)
    knots = _knots(ordered, *span)
    # The integral of a B-spline is its coefficients times a quarter of each one's span.
    return knots, (knots[DEGREE + 1 :] - knots[: -DEGREE - 1]) / (DEGREE + 1) / (span[1] - span[0])


def _by_pairs(pairs: Pairs) -> Floats:
    """Return the derivative of ranges by a constant in ns of each pair (n, pairs)."""
    matrix = np.zeros((len(pairs.number), len(pairs.ends)))
    matrix[np.arange(len(matrix)), pairs.number] = SPEED_OF_LIGHT * 1e-9
    return matrix


def _making_up(delays: Floats, share: Floats | None) -> Floats | None:
    """Return the parameters that make up for a constant in a curve with a `share` in ranges (n,), None if none do."""
    if not delays.shape[1]:
        return None
    aim = np.ones(len(delays)) if share is None else share
    pull = delays.T @ aim
    found = np.linalg.lstsq(delays.T @ delays, pull, rcond=1e-12)[0]
    return np.asarray(found) if float(aim @ aim - pull @ found) < SPANNED * float(aim @ aim) else None


def _known_tags(everyone: list[int], fixed: Mapping[int, float]) -> None:
    unknown = sorted(set(fixed) - set(everyone))
    if unknown:
        raise BadInputError(
            f"found tag {unknown[0]}, the tags are {', '.join(map(str, everyone))}", parameter="fixed_ns"
        )


def _something_left(unknowns: Unknowns, tags: list[int]) -> None:
    if not tags and not unknowns.curve:
        raise BadInputError(
            "every tag is pinned and no curve is fitted, so nothing is left to fit", parameter="fixed_ns"
        )


def _shares(ranges: Ranges, groups: Mapping[str, tuple[int, ...]], everyone: list[int]) -> list[Floats | None]:
    """Return for each group its share in each range: a half for each end that belongs to it; None for all of it."""
    if not groups:
        return [None]
    member = {tag: name for name, tags in groups.items() for tag in tags}
    lonely = [tag for tag in everyone if tag not in member]
    if lonely:
        raise BadInputError(f"tag {lonely[0]} is in no group; the groups are {', '.join(groups)}", parameter="groups")
    unused = [name for name, tags in groups.items() if not set(tags) & set(everyone)]
    if unused:
        raise BadInputError(f"no tag of group {unused[0]!r} ranges in {ranges.source}", parameter="groups")
    return [0.5 * np.isin(ranges.initiator, tags) + 0.5 * np.isin(ranges.target, tags) for tags in groups.values()]


def _columns(delays: Floats, lifted: Floats, knots: Floats, centres: Floats, shares: list[Floats | None]) -> Floats:
    """Return delays beside the splines of every group, filled in pieces to keep memory at one copy."""
    rank, each = delays.shape[1], centres.shape[1]
    columns = np.empty((len(lifted), rank + each * len(shares)))
    columns[:, :rank] = delays
    if not each:
        return columns
    for begin in range(0, len(lifted), ROWS_AT_ONCE):
        rows = slice(begin, begin + ROWS_AT_ONCE)
        splines = basis(lifted[rows], knots)
        for k, share in enumerate(shares):
            part = centres[k] - splines
            part = part if share is None else part * share[rows, None]
            columns[rows, rank + k * each : rank + (k + 1) * each] = part
    return columns
