"""Puts a fit into columns: which powers have a curve, where its knots are, and the derivatives of every range."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.interpolate import BSpline

from calib.calibration.power_curves import (
    DEGREE,
    Bins,
    lifted_power,
    populated,
)
from calib.data.ranges import Ranges
from calib.errors import BadInputError, UnanswerableError
from calib.estimation.design import PIECES_AT_ONCE, Design
from calib.estimation.identifiability import identifiable_directions, require_determined
from calib.estimation.problem import CELLS, Problem
from calib.estimation.row_order import stable_order
from calib.estimation.spacing import bins_of, splines
from calib.estimation.unknowns import Unknowns
from calib.estimator.pairs import Pairs, pairs_of
from calib.estimator.time_blocks import in_order, time_blocks
from calib.long_columns import EVERY, computed, empty, let_go, picked, put
from uwblink.arrays import Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT

FEWEST: Final = 100

SPANNED: Final = 1e-4
"""Delays can make up for a constant of a curve if no more than this of it is left, in squares."""


SAME_POWER: Final = 1e-6
"""Lifted powers that differ by no more are one."""

ROWS_AT_ONCE: Final = 8192


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
    """Put a fit into columns; raises what `calib.fitting.fitting.fit` raises.

    In a `sequential` one the curves keep their constants, and ranges of all powers stay, for the delays; so do they
    without a curve. Where power never changes no curve is looked for.
    """
    if len(ranges) < FEWEST:
        raise UnanswerableError(
            f"{ranges.source}: {len(ranges)} usable exchanges are too few, at least {FEWEST} are needed"
        )
    ranges = in_order(ranges)
    fpp1, fpp2 = ranges.fpp1_dbm, ranges.fpp2_dbm
    lifted = computed(len(ranges), lambda rows: lifted_power(fpp1[rows], fpp2[rows], lift, alpha_dbm))
    let_go(fpp1, fpp2)
    powered = np.isfinite(lifted)
    if not powered.all():
        # What has no power stands at the middle of the others, where it bends nothing.
        lifted[~powered] = np.median(lifted[powered]) if powered.any() else 1.0
    ordered = empty(len(lifted))
    put(ordered, EVERY, lifted)
    let_go(lifted, ranges.time_ns)
    ordered.sort()
    low, high = populated(ordered)
    unknowns = (unknowns or Unknowns()).at_powers(varied=high - low > SAME_POWER)
    # Beyond the populated powers a curve is held constant: what it is there is not for these ranges to say.
    if not sequential and unknowns.curve:
        inside = (lifted >= low) & (lifted <= high)
        ranges, lifted, powered = ranges[inside], picked(lifted, inside), powered[inside]
        ordered = ordered[np.searchsorted(ordered, low) : np.searchsorted(ordered, high, side="right")]
    everyone = ranges.tags()
    pairs = pairs_of(ranges.initiator, ranges.target, everyone)
    shares = _shares(ranges, groups, everyone)
    _known_tags(everyone, fixed)
    knots, averages = splines(ordered, (low, high), unknowns)
    bins = bins_of(lifted, ordered)
    del ordered
    kinds, kind = np.unique(_shares_of(pairs.ends, groups), axis=0, return_inverse=True)
    raw = _raw(ranges, everyone, pairs, lifted, bins, knots, kind.ravel(), unknowns)
    carriers = raw.shape[1] - len(kinds) * len(averages)
    weights = raw.part(slice(0, carriers))
    square = weights.normal()
    tags, directions, free = list(range(len(pairs.ends))), np.eye(carriers), list[list[int]]()
    known: Floats = np.broadcast_to(0.0, len(lifted))
    if not unknowns.of_pairs:
        pinned = np.array([tag in fixed for tag in everyone])
        if pinned.any():
            known = weights @ np.array([fixed.get(tag, 0.0) for tag in everyone])
        tags = np.array(everyone)[~pinned].tolist()
        found = np.eye(len(tags))
        if tags:
            found, free = identifiable_directions(square[np.ix_(~pinned, ~pinned)], tags, pairs.ends)
        directions = np.zeros((carriers, found.shape[1]))
        directions[~pinned] = found
    _something_left(unknowns, tags)
    if not minimum_norm:
        require_determined(free)
    reach = replace(weights, turn=directions)
    gauges = tuple(_making_up(reach, share) for share in shares)
    centred = [gauge is not None and not sequential for gauge in gauges]
    centres = np.outer(np.array(centred, dtype=float), averages)
    return Problem(
        ranges=ranges,
        tags=tags,
        directions=directions if unknowns.of_pairs else directions[~pinned],
        error=computed(len(ranges), lambda rows: ranges.raw_m[rows] - ranges.truth_m[rows] + known[rows]),
        design=replace(raw, turn=_turn(directions, kinds, centres)),
        lifted=lifted,
        pairs=pairs,
        bins=bins,
        span=(low, high),
        knots=knots,
        centres=centres,
        gauges=gauges,
        groups=tuple(groups) or ("",),
        shares=shares,
        free=free,
        unknowns=unknowns,
        powered=powered,
        blocks=time_blocks(ranges.time_ns, ranges.session),
    )


def _making_up(delays: Design, share: Floats | None) -> Floats | None:
    """Return the parameters that make up for a constant in a curve with a `share` in ranges (n,), None if none do."""
    if not delays.shape[1]:
        return None
    aim = delays.kept(np.broadcast_to(1.0, len(delays)) if share is None else share)
    pull = delays.pull(aim)
    found = np.linalg.lstsq(delays.normal(), pull, rcond=1e-12)[0]
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


def _shares_of(ends: Ints, groups: Mapping[str, tuple[int, ...]]) -> Floats:
    """Return how much of each group's curve is in the ranges of pairs of tags, (pairs, groups)."""
    if not groups:
        return np.ones((len(ends), 1))
    return np.column_stack([0.5 * np.isin(ends, tags).sum(axis=1) for tags in groups.values()])


def _raw(
    ranges: Ranges,
    everyone: list[int],
    pairs: Pairs,
    lifted: Floats,
    bins: Bins,
    knots: Floats,
    kind: Ints,
    unknowns: Unknowns,
) -> Design:
    """Return the derivatives of ranges by delays in ns (or constants of pairs) and by splines, of every kind of pair.

    `kind` (pairs,) numbers those that have the same curve. Blocks are of one pair, step of power and piece of curve.
    """
    each = max(len(knots) - DEGREE - 1, 0)
    first: Ints = np.broadcast_to(np.int64(0), len(lifted))
    if each:
        first = computed(len(lifted), lambda rows: _first_splines(lifted[rows], knots), np.int32)
    several = max(each, 1)

    def place(rows: slice) -> Ints:
        cell = bins.number[rows] * CELLS // len(bins.count)
        return np.asarray((pairs.number[rows] * CELLS + cell) * several + first[rows])

    key = computed(len(lifted), place, np.int32)
    order = stable_order(key)
    sizes = np.bincount(key)
    del key
    which = np.flatnonzero(sizes)
    pair, first = which // (CELLS * several), which % several
    columns = [pair] if unknowns.of_pairs else list(np.searchsorted(everyone, pairs.ends[pair]).T)
    carriers = len(pairs.ends) if unknowns.of_pairs else len(everyone)
    values = empty(len(lifted), each=(len(columns) + (DEGREE + 1) * bool(each),))
    if each:
        columns += [carriers + kind[pair] * each + first + k for k in range(DEGREE + 1)]
    for into, weight in zip(values, _weights(ranges, unknowns), strict=False):
        put(into, EVERY, picked(weight, order))
    ordered = picked(lifted, order)
    for begin in range(0, len(lifted) if each else 0, ROWS_AT_ONCE):
        rows = slice(begin, begin + ROWS_AT_ONCE)
        some = BSpline.design_matrix(np.clip(ordered[rows], knots[0], knots[-1]), knots, DEGREE).data
        for into, spline in zip(values[-DEGREE - 1 :], some.reshape(-1, DEGREE + 1).T, strict=True):
            put(into, rows, spline)
        if begin % (PIECES_AT_ONCE * ROWS_AT_ONCE) == 0:
            let_go(values, ordered)
    let_go(values, lifted)
    count = carriers + each * (int(kind.max()) + 1)
    starts = np.concatenate([[0], np.cumsum(sizes[which])])
    return Design(values, order, starts, np.column_stack(columns), np.eye(count)).in_short_blocks()


def _first_splines(lifted: Floats, knots: Floats) -> Ints:
    """Return the number of the first spline that is not zero at each lifted power (n,)."""
    found = np.searchsorted(knots, np.clip(lifted, knots[0], knots[-1]), side="right") - 1
    return np.asarray(np.clip(found, DEGREE, len(knots) - DEGREE - 2) - DEGREE)


def _weights(ranges: Ranges, unknowns: Unknowns) -> Iterator[Floats]:
    """Yield the derivatives of ranges (n,) by the delays of their lower and higher tags in ns, or by a constant."""
    metres = SPEED_OF_LIGHT * 1e-9
    if unknowns.of_pairs:
        yield np.broadcast_to(metres, len(ranges))
        return
    first, second = ranges.weight_initiator, ranges.weight_target
    for one, other in ((first, second), (second, first)):

        def of(rows: slice, one: Floats = one, other: Floats = other) -> Floats:
            return metres * np.where(ranges.initiator[rows] < ranges.target[rows], one[rows], other[rows])

        yield computed(len(ranges), of)
        let_go(first, second, ranges.initiator, ranges.target)


def _turn(directions: Floats, kinds: Floats, centres: Floats) -> Floats:
    """Return what makes parameters of weights of tags and splines of kinds of pairs, (raw, m).

    Splines enter with the opposite sign, less their centres: they sum to one everywhere, so a centre is a share of all.
    """
    (carriers, rank), (groups, each) = directions.shape, centres.shape
    found = np.zeros((carriers + len(kinds) * each, rank + groups * each))
    found[:carriers, :rank] = directions
    for k, shares in enumerate(kinds):
        rows = slice(carriers + k * each, carriers + (k + 1) * each)
        for group, share in enumerate(shares):
            columns = slice(rank + group * each, rank + (group + 1) * each)
            found[rows, columns] = share * (centres[group] - np.eye(each))
    return found
