"""The model of ranges besides their distances: delays, curves over power, offsets, and parameters of errors.

`RangeModel.of` makes unknowns and parts of these for any ranges. Fits to known distances, surveys and flights share it,
and differ only in the source of distances.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from calib.calibration.power_curves import DEGREE, SIGMA_SEGMENTS, curvature, knots_for, lifted_power, populated
from calib.data.ranges import Ranges
from calib.errors import BadInputError, UnanswerableError
from calib.estimator.error_unknowns import error_unknowns, scattered
from calib.estimator.identifiability import free_directions, square_of
from calib.estimator.range_rows import RESIDUAL, Errors, Geometry, Mixture, Part, RangeRows
from calib.estimator.rows import NormalRows
from calib.estimator.unknowns import Layout, Prior, Unknown
from calib.pairs import Pairs, pairs_of
from calib.spread import robust_spread
from uwblink.arrays import Bools, Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT

METRES_A_NS = SPEED_OF_LIGHT * 1e-9
DELAY_NS = 600.0
"""Prior standard deviation of a delay: a board without a programmed delay has 514 ns. The prior decides only
combinations that no range determines, and chooses the smallest delays there."""

HELD_NS, HELD_M = 1e-3, 1e-5
"""Standard deviations of what is set to zero because no range determines it: far below those of any result."""

CURVE_M = 0.5
"""Prior standard deviation of the bias over power: published curves reach 0.2 m (DW1000 user manual, APS011)."""

SEGMENTS_A_FOLD, SEGMENTS = 4.5, (10, 28)
"""Segments of a bias curve per factor e of lifted power, and their bounds. Roughness is estimated, so more segments
change nothing (the study of `make accuracy`)."""

FEWEST_OF_GROUP = 20
"""Minimum number of ranges for the curve of a group."""

SAME_POWER = 1e-6
"""Lifted powers that differ by less count as equal."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Spline:
    """Cubic B-splines at lifted powers (n,): the four that are not zero, `values` (n, 4), from number `first` (n,)."""

    knots: Floats
    values: Floats
    first: Ints

    @classmethod
    def at(cls, lifted: Floats, knots: Floats) -> Spline:
        """Return the splines of `knots` at lifted powers, clamped to their span."""
        inside = np.clip(lifted, knots[0], knots[-1])
        values = BSpline.design_matrix(inside, knots, DEGREE).data.reshape(-1, DEGREE + 1)
        first = np.clip(np.searchsorted(knots, inside, side="right") - 1, DEGREE, len(knots) - DEGREE - 2) - DEGREE
        return cls(knots=knots, values=values, first=first.astype(np.int32))

    @property
    def columns(self) -> Ints:
        """Return the numbers of the four splines (n, 4)."""
        return np.asarray(self.first[:, None] + np.arange(DEGREE + 1, dtype=np.int32))

    @property
    def size(self) -> int:
        """Return the number of splines."""
        return len(self.knots) - DEGREE - 1


@dataclass(frozen=True, kw_only=True)
class RangeModel:
    """Unknowns and parts of `ranges` (n,), with curves over `lifted` powers within `span`.

    `unknowns` are delays, curves and offsets; `error_model` adds those of errors. `gauged` tells for each group whether
    its curve is zero at `reference`; the others keep a constant that pinned delays determine. Delays have no part
    along the directions `held` (tags, k), which no range determines and which shift the tags of the groups `free`.
    """

    ranges: Ranges
    lifted: Floats
    powered: Bools
    span: tuple[float, float]
    pairs: Pairs
    tags: list[int]
    groups: Mapping[str, tuple[int, ...]]
    curve: Spline | None
    noise: Spline | None
    unknowns: tuple[Unknown, ...]
    parts: tuple[Part, ...]
    gauged: tuple[bool, ...]
    reference: float | None
    constants: str
    looked_for_curve: bool
    held: Floats
    free: list[list[int]]

    @classmethod
    def of(  # noqa: PLR0913 - keyword-only settings of one fit
        cls,
        ranges: Ranges,
        *,
        lift: str,
        alpha_dbm: float,
        fixed_ns: Mapping[int, float],
        groups: Mapping[str, tuple[int, ...]],
        curve: bool,
        constants: str = "tag",
        reference: float | None = 1.0,
        offsets: bool = True,
        trimmed: bool = True,
    ) -> RangeModel:
        """Return the model of ranges; `reference` is the lifted power at which curves are zero, None for no such
        condition.

        With `trimmed`, ranges at the outer half per cent of powers at either end are left out, because they do not
        determine the curve there. Raises `BadInputError` for tags and groups that are not in the ranges.
        """
        lifted = lifted_power(ranges.fpp1_dbm, ranges.fpp2_dbm, lift, alpha_dbm)
        powered = np.isfinite(lifted)
        # Ranges without power get the median power, where they do not bend the curve.
        lifted = np.where(powered, lifted, np.median(lifted[powered]) if powered.any() else 1.0)
        ordered = np.sort(lifted)
        low, high = populated(ordered)
        varied = high - low > SAME_POWER
        looked_for, curve = curve, curve and varied
        if curve and trimmed:
            inside = (lifted >= low) & (lifted <= high)
            ranges, lifted, powered = ranges[inside], lifted[inside], powered[inside]
            ordered = ordered[np.searchsorted(ordered, low) : np.searchsorted(ordered, high, side="right")]
        tags = ranges.tags()
        _check_tags(ranges, tags, fixed_ns, groups)
        pairs = pairs_of(ranges.initiator, ranges.target)
        held, free = _free_directions(ranges, tags, fixed_ns, constants)
        unknowns, parts = _constants(ranges, pairs, tags, fixed_ns, constants)
        bias = noise = None
        gauged: list[bool] = []
        if curve:
            bias = Spline.at(lifted, _knots(ordered, low, high))
            for name, share in _shares(ranges, groups):
                kind = f"curve {name}".strip()
                unknowns.append(_curve(kind, bias))
                values = -bias.values if share is None else -share[:, None] * bias.values
                parts.append(Part(parameter=RESIDUAL, kind=kind, columns=bias.columns, values=values))
                gauged.append(constants == "pair" or _delays_absorb(pairs, tags, fixed_ns, groups.get(name)))
        if powered.all() and varied:
            noise = Spline.at(lifted, knots_for(ordered, SIGMA_SEGMENTS, (low, high)))
        if offsets:
            _add_offsets(
                ranges,
                pairs,
                tags,
                unknowns,
                parts,
                identifiable=_offsets_identifiable(pairs, tags, fixed_ns, constants, gauged),
            )
        return cls(
            ranges=ranges,
            lifted=lifted,
            powered=powered,
            span=(low, high),
            pairs=pairs,
            tags=tags,
            groups=groups,
            curve=bias,
            noise=noise,
            unknowns=tuple(unknowns),
            parts=tuple(parts),
            gauged=tuple(gauged),
            reference=reference,
            constants=constants,
            looked_for_curve=looked_for,
            held=held,
            free=free,
        )

    def curve_kinds(self) -> list[str]:
        """Return the kinds of unknowns that are curves, one a group."""
        return [block.kind for block in self.unknowns if block.kind.split(" ")[0] == "curve"]

    def key(self) -> Ints:
        """Return a number for each range (n,); ranges with equal numbers depend on the same unknowns."""
        key = self.pairs.number.astype(np.int64)
        if self.ranges.sessions[1:]:
            key = key * (int(self.ranges.session.max()) + 1) + self.ranges.session
        for spline in (self.curve, self.noise):
            if spline is not None:
                key = key * spline.size + spline.first
        return key

    def gauge_rows(self, layout: Layout) -> list[NormalRows]:
        """Return rows that set curves to zero at the reference power, where delays can take the constant."""
        if self.curve is None or self.reference is None:
            return []
        at = Spline.at(np.array([self.reference]), self.curve.knots)
        return [
            NormalRows(
                value=np.zeros(1),
                std=np.full(1, HELD_M),
                entries=at.values,
                columns=at.columns + layout.where[kind].start,
            )
            for kind, gauged in zip(self.curve_kinds(), self.gauged, strict=True)
            if gauged
        ]

    def held_rows(self, layout: Layout) -> list[NormalRows]:
        """Return rows that set free directions of delays to zero: skews of clocks would pin them to 100 ns."""
        delays = layout.indices(["delay"])[None]
        return [
            NormalRows(value=np.zeros(1), std=np.full(1, HELD_NS), entries=one[None], columns=delays)
            for one in self.held.T
        ]

    def error_model(self, residual: Floats) -> tuple[Mixture, tuple[Unknown, ...], tuple[Part, ...]]:
        """Return the error model with its unknowns and parts, started from robust spreads of residuals (n,)."""
        names = tuple(f"{a}-{b}" for a, b in self.pairs.ends.tolist())
        unknowns, parts = error_unknowns(max(robust_spread(residual), 1e-3), names, self.pairs.number)
        if self.noise is not None:
            rough = Prior(weight=1.0, structure=curvature(self.noise.knots), bounds=(1e-3, 1e6))
            several = tuple(map(str, range(self.noise.size)))
            for name, share in _shares(self.ranges, self.groups):
                values = self.noise.values if share is None else share[:, None] * self.noise.values
                for parameter, deviation in (("noise", 1.0), ("odds", 0.7)):
                    kind = f"{parameter} curve {name}".strip()
                    priors = (rough, Prior.of_deviation(deviation))
                    unknowns.append(Unknown(kind=kind, names=several, start=np.zeros(len(several)), priors=priors))
                    parts.append(Part(parameter=parameter, kind=kind, columns=self.noise.columns, values=values))
        return Mixture(), tuple(unknowns), tuple(parts)

    def build(
        self,
        residual: Floats,
        errors: Errors,
        more: Sequence[Unknown] = (),
        parts: Sequence[Part] = (),
        geometry: Geometry | None = None,
        only: Sequence[str] | None = None,
    ) -> tuple[Layout, RangeRows]:
        """Return the layout of all unknowns, and the rows of ranges with residuals (n,) less unknown distances."""
        unknowns = [u for u in self.unknowns if only is None or u.kind in only]
        kinds = {u.kind for u in unknowns}
        layout = Layout((*unknowns, *more))
        used = [*(p for p in self.parts if p.kind in kinds), *parts]
        return layout, RangeRows.of(residual, self.key(), used, errors, layout, geometry)


def _free_directions(
    ranges: Ranges, tags: list[int], fixed_ns: Mapping[int, float], constants: str
) -> tuple[Floats, list[list[int]]]:
    """Return the directions of delays (tags, k) that the pairs leave free, and their tags."""
    own = [k for k, tag in enumerate(tags) if tag not in fixed_ns]
    held, free = np.zeros((len(tags), 0)), list[list[int]]()
    if own and constants == "tag":
        square, ends = square_of(tags, ranges.initiator, ranges.target, ranges.weight_initiator, ranges.weight_target)
        directions, free = free_directions(square[np.ix_(own, own)], [tags[k] for k in own], ends)
        held = np.zeros((len(tags), directions.shape[1]))
        held[own] = directions
    return held, free


def _constants(
    ranges: Ranges, pairs: Pairs, tags: list[int], fixed_ns: Mapping[int, float], constants: str
) -> tuple[list[Unknown], list[Part]]:
    """Return delays of tags, or constants of pairs, in ns."""
    if constants == "pair":
        names = tuple(f"{a}-{b}" for a, b in pairs.ends.tolist())
        values = np.full((len(ranges), 1), METRES_A_NS)
        block = Unknown(kind="delay", names=names, start=np.zeros(len(names)), priors=(Prior.of_deviation(DELAY_NS),))
        return [block], [Part(parameter=RESIDUAL, kind="delay", columns=pairs.number[:, None], values=values)]
    known = np.array([tag in fixed_ns for tag in tags])
    start = np.array([fixed_ns.get(tag, 0.0) for tag in tags])
    block = Unknown(
        kind="delay", names=tuple(map(str, tags)), start=start, known=known, priors=(Prior.of_deviation(DELAY_NS),)
    )
    columns = np.searchsorted(tags, pairs.ends)[pairs.number]
    lower_first = (ranges.initiator < ranges.target)[:, None]
    weights = np.column_stack([ranges.weight_initiator, ranges.weight_target])
    values = METRES_A_NS * np.where(lower_first, weights, weights[:, ::-1])
    return [block], [Part(parameter=RESIDUAL, kind="delay", columns=columns, values=values)]


def _curve(kind: str, spline: Spline) -> Unknown:
    rough = Prior(weight=1e2, structure=curvature(spline.knots), bounds=(1e-3, 1e9))
    return Unknown(
        kind=kind,
        names=tuple(map(str, range(spline.size))),
        start=np.zeros(spline.size),
        scale=CURVE_M,
        priors=(rough, Prior.of_deviation(CURVE_M)),
    )


TYPICAL_OFFSET_M = 0.035
"""Prior standard deviation of offsets between days and between halves of a flight (3 to 4 cm: MILUV, STAR-loc)."""

OFFSETS = (0.01, 1e-4, 1.0)
"""Standard deviation of other constants in the ranges of a pair, such as a wall: start and bounds, m."""


def _add_offsets(
    ranges: Ranges, pairs: Pairs, tags: list[int], unknowns: list[Unknown], parts: list[Part], *, identifiable: bool
) -> None:
    """Add offsets of pairs, and of pairs and tags in each of several sessions."""
    names = tuple(f"{a}-{b}" for a, b in pairs.ends.tolist())
    number = pairs.number[:, None]
    if identifiable:
        unknowns.append(scattered("offset of pair", names, OFFSETS))
        parts.append(Part(parameter=RESIDUAL, kind="offset of pair", columns=number))
    count = len(ranges.sessions)
    if count < 2:
        return
    session = ranges.session[:, None].astype(np.int64)
    ends = np.searchsorted(tags, pairs.ends)[pairs.number]
    for kind, whose, columns in (
        ("offset of pair in session", names, number * count + session),
        ("offset of tag in session", tuple(map(str, tags)), ends * count + session),
    ):
        several = tuple(f"{name} in {where}" for name in whose for where in ranges.sessions)
        unknowns.append(scattered(kind, several, OFFSETS))
        parts.append(Part(parameter=RESIDUAL, kind=kind, columns=columns.astype(np.int32)))


def _offsets_identifiable(
    pairs: Pairs, tags: list[int], fixed: Mapping[int, float], constants: str, gauged: Sequence[bool]
) -> bool:
    """Return whether ranges determine offsets of pairs beside delays and constants of curves."""
    if constants == "pair":
        return False
    free = [tag for tag in tags if tag not in fixed]
    ends = (pairs.ends[:, :, None] == np.array(free, dtype=np.int64)).sum(axis=1)
    taken = np.linalg.matrix_rank(ends) if ends.size else 0
    return len(pairs.ends) > taken + sum(not zero for zero in gauged)


def _check_tags(
    ranges: Ranges, tags: list[int], fixed: Mapping[int, float], groups: Mapping[str, tuple[int, ...]]
) -> None:
    unknown = sorted(set(fixed) - set(tags))
    if unknown:
        raise BadInputError(f"found tag {unknown[0]}, the tags are {', '.join(map(str, tags))}", parameter="fixed_ns")
    member = {tag for own in groups.values() for tag in own}
    lonely = [tag for tag in tags if groups and tag not in member]
    if lonely:
        raise BadInputError(f"tag {lonely[0]} is in no group; the groups are {', '.join(groups)}", parameter="groups")
    unused = [name for name, own in groups.items() if not set(own) & set(tags)]
    if unused:
        raise BadInputError(f"no tag of group {unused[0]!r} ranges in {ranges.source}", parameter="groups")


def _shares(ranges: Ranges, groups: Mapping[str, tuple[int, ...]]) -> list[tuple[str, Floats | None]]:
    """Return the weight of each group's curve in each range (n,): a half for each end; None for a single curve."""
    if not groups:
        return [("", None)]
    shares: list[tuple[str, Floats | None]] = [
        (name, 0.5 * np.isin(ranges.initiator, own) + 0.5 * np.isin(ranges.target, own)) for name, own in groups.items()
    ]
    for name, share in shares:
        if share is not None and np.count_nonzero(share) < FEWEST_OF_GROUP:
            raise UnanswerableError(
                f"group {name!r} has too few ranges for a curve, at least {FEWEST_OF_GROUP} are needed",
                parameter="groups",
            )
    return shares


def _delays_absorb(pairs: Pairs, tags: list[int], fixed: Mapping[int, float], group: tuple[int, ...] | None) -> bool:
    """Return whether free delays can compensate a constant of a group's curve."""
    free = [tag for tag in tags if tag not in fixed]
    if not free:
        return False
    aim = np.ones(len(pairs.ends)) if group is None else 0.5 * np.isin(pairs.ends, group).sum(axis=1)
    ends = 0.5 * (pairs.ends[:, :, None] == np.array(free)).sum(axis=1)
    left = aim - ends @ np.linalg.lstsq(ends, aim, rcond=None)[0]
    return bool(left @ left < 1e-4 * (aim @ aim))


def _knots(ordered: Floats, low: float, high: float) -> Floats:
    """Return clamped knots from `low` to `high`, halfway between equal counts and equal lengths of the root of lifted
    power.

    Curves are steep at small lifted powers, where roots are dense.
    """
    segments = int(np.clip(round(SEGMENTS_A_FOLD * np.log(high / low)), *SEGMENTS))
    counts = np.interp(np.linspace(0, len(ordered) - 1, segments + 1), np.arange(len(ordered)), ordered)
    roots = np.sqrt(np.clip(counts, low, high)) + np.linspace(np.sqrt(low), np.sqrt(high), segments + 1)
    inner = roots**2 / 4
    inner[[0, -1]] = low, high
    return np.concatenate([[low] * DEGREE, inner, [high] * DEGREE])
