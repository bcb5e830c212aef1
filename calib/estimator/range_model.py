"""The model of ranges besides their distances: delays, curves over power, offsets, and parameters of errors.

`RangeModel.of` makes the unknowns and the parts of ranges from them. Fits to known distances and flights without them
share it and differ only in the source of distances. Surveys use it for the mean ranges of pairs, from which
`calib.surveys.network` estimates positions and delays.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import BSpline

from calib.calibration.document import Split
from calib.calibration.power_curves import DEGREE, SIGMA_SEGMENTS, curvature, knots_for, lift, lifted_power, populated
from calib.data.ranges import Ranges
from calib.errors import UnanswerableError
from calib.estimator.covariates import COVARIATES, Covariate
from calib.estimator.grouped_errors import ReflectionFeatures, error_unknowns, logarithms, scattered
from calib.estimator.identifiability import free_directions
from calib.estimator.range_rows import Errors, Mixture, Part, RangeRows, block_of
from calib.estimator.rows import NormalRows
from calib.estimator.unknowns import Layout, Prior, Unknown
from calib.pairs import Pairs, pairs_of_bodies
from calib.settings import FitSettings, refuse
from calib.spread import robust_spread
from uwblink.arrays import Bools, Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT

METRES_A_NS = SPEED_OF_LIGHT * 1e-9
"""Metres that light travels in a nanosecond."""

DELAY_NS = 600.0
"""Prior standard deviation of a delay: a board without a programmed delay has 514 ns. The prior affects only
combinations that no range determines, and gives the smallest delays there."""

BOARD_DELAY_STD_NS = 2.0
"""Prior standard deviation of a programmed board's delay where distances are unknown and a scale of the places can be
taken for a delay: three times the difference of published delays (0.6 ns)."""

HELD_NS, HELD_M = 1e-3, 1e-5
"""Standard deviations of combinations that are set to zero because no range determines them: far below the standard
error of any result."""

CURVE_M = 0.5
"""Prior standard deviation of the bias over power: published curves reach 0.2 m (DW1000 user manual, APS011)."""

SEGMENTS_A_FOLD, CURVE_SEGMENT_BOUNDS = 4.5, (10, 28)
"""Segments of a bias curve per factor e of lifted power, and their bounds. Roughness is estimated, so more segments
change nothing (the study of `make accuracy`)."""

MIN_RANGES_OF_GROUP = 20
"""Minimum number of ranges for the curve of a group."""


OFFSET_OF_BODIES, OFFSET_OF_PAIR = OFFSET_KINDS = "offset of bodies", "offset of pair"
"""Kinds of unknowns: other constants in all ranges between two bodies, and in the ranges of a pair of tags."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SplineValues:
    """Cubic B-splines at lifted powers (n,): the four that are not zero, `values` (n, 4), from number `first` (n,)."""

    knots: Floats
    values: Floats
    first: Ints

    @classmethod
    def at(cls, lifted: Floats, knots: Floats) -> SplineValues:
        """Return the splines of `knots` at lifted powers, clamped to their span."""
        found = BSpline.design_matrix(np.clip(lifted, knots[0], knots[-1]), knots, DEGREE)
        first: Ints = np.asarray(found.indices[:: DEGREE + 1], dtype=np.int32)
        return cls(knots=knots, values=found.data.reshape(-1, DEGREE + 1), first=first)

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

    `unknowns` are delays, curves and offsets; `error_model` adds those of errors. `carriers` has for each curve the
    weights (tags,) with which delays can absorb its constant; None if the curve keeps its constant, which pinned delays
    determine. Delays are zero along the directions `held` (tags, k), which no range determines and which shift the tags
    of the groups `free`. `covariates` are the covariates of delays in this fit, by setting.
    """

    ranges: Ranges
    settings: FitSettings
    lifted: Floats
    powered: Bools
    span: tuple[float, float]
    pairs: Pairs
    tags: list[int]
    curve: SplineValues | None
    noise: SplineValues | None
    unknowns: tuple[Unknown, ...]
    parts: tuple[Part, ...]
    carriers: tuple[Floats | None, ...]
    held: Floats
    free: list[Split]
    covariates: Mapping[str, Covariate] = field(default_factory=dict)

    @classmethod
    def of(
        cls, ranges: Ranges, settings: FitSettings, *, offsets: Sequence[str] = OFFSET_KINDS, trimmed: bool = True
    ) -> RangeModel:
        """Return the model of ranges, with some kinds of `offsets`, and with any of these also those of sessions.

        With `trimmed`, ranges at the outer half per cent of powers at either end are left out, because they do not
        determine the curve there. Raises `BadInputError` for tags and groups that are not in the ranges.
        """
        lifted = lifted_power(ranges.fpp1_dbm, ranges.fpp2_dbm, settings.lift, settings.alpha_dbm)
        powered = np.isfinite(lifted)
        # Ranges without power get the median power, at which they do not bend the curve.
        lifted = np.where(powered, lifted, np.median(lifted[powered]) if powered.any() else 1.0)
        ordered = np.sort(lifted)
        low, high = populated(ordered)
        # Smaller differences of lifted powers are rounding errors.
        varied = high - low > 1e-6
        curve = varied and not settings.delays_only
        if curve and trimmed:
            inside = (lifted >= low) & (lifted <= high)
            ranges, lifted, powered = ranges[inside], lifted[inside], powered[inside]
            ordered = ordered[np.searchsorted(ordered, low) : np.searchsorted(ordered, high, side="right")]
        tags = ranges.tags()
        _check_tags(ranges, tags, settings)
        pairs = ranges.pairs
        held, free = _free_directions(ranges, tags, settings)
        blocks = [_constants(ranges, pairs, tags, settings)]
        bias = noise = None
        carriers: list[Floats | None] = []
        if curve:
            bias = SplineValues.at(lifted, _knots(ordered, low, high))
            for name, share in _shares(ranges, settings.groups):
                blocks.append(_curve(f"curve {name}".strip(), bias, share))
                carriers.append(_carrier(pairs, tags, settings, settings.groups.get(name)))
        if powered.all() and varied:
            noise = SplineValues.at(lifted, knots_for(ordered, SIGMA_SEGMENTS, (low, high)))
        if offsets:
            blocks += _offsets(ranges, pairs, tags, settings, carriers, offsets)
        covariates = {}
        for name, (read, kinds) in COVARIATES.items():
            if (asked := getattr(settings, name)) in kinds:
                covariates[name] = read(ranges)
                blocks += covariates[name].blocks(kinds[asked], pairs)
        return cls(
            ranges=ranges,
            settings=settings,
            covariates=covariates,
            lifted=lifted,
            powered=powered,
            span=(low, high),
            pairs=pairs,
            tags=tags,
            curve=bias,
            noise=noise,
            unknowns=tuple(unknown for unknown, _ in blocks),
            parts=tuple(part for _, part in blocks),
            carriers=tuple(carriers),
            held=held,
            free=free,
        )

    @property
    def reference(self) -> float | None:
        """Return the lifted power at which curves are zero, None for no such condition."""
        dbm = self.reference_dbm
        return None if dbm is None else float(lift(np.array(dbm), self.settings.alpha_dbm))

    @property
    def reference_dbm(self) -> float | None:
        """Return the power in dBm at which curves are zero, None for no such condition."""
        settings, stated_dbm = self.settings, self.settings.reference_power_dbm
        return settings.alpha_dbm if stated_dbm is None and not settings.sequential else stated_dbm

    @property
    def pinned(self) -> bool:
        """Return whether all delays are known."""
        return set(self.tags) <= set(self.settings.fixed_ns)

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

    def _carried(self) -> list[tuple[str, Floats, SplineValues]]:
        """Return kind and carrier of each curve whose constant delays can absorb, and its splines at the reference
        power."""
        if self.curve is None or self.reference is None:
            return []
        at, curves = SplineValues.at(np.array([self.reference]), self.curve.knots), self.curve_kinds()
        return [(kind, one, at) for kind, one in zip(curves, self.carriers, strict=True) if one is not None]

    def gauge_rows(self, layout: Layout) -> list[NormalRows]:
        """Return rows that set curves to zero at the reference power, if delays can absorb the constant."""
        zero, std = np.zeros(1), np.full(1, HELD_M)
        return [
            NormalRows(value=zero, std=std, entries=at.values, columns=at.columns + layout.where[kind].start)
            for kind, _, at in self._carried()
        ]

    def held_rows(self, layout: Layout) -> list[NormalRows]:
        """Return rows that set undetermined directions of delays to zero: clock skews would set them to 100 ns."""
        delays = layout.indices(["delay"])[None]
        return [
            NormalRows(value=np.zeros(1), std=np.full(1, HELD_NS), entries=one[None], columns=delays)
            for one in self.held.T
            if delays.size
        ]

    def at_reference(self, values: Mapping[str, Floats]) -> dict[str, Floats]:
        """Return unknowns by kind with curves that are zero at the reference power: delays absorb the constants."""
        stated = dict(values)
        for kind, carrier, at in self._carried():
            constant_m = float(at.values[0] @ values[kind][at.columns[0]])
            stated[kind] = values[kind] - constant_m
            stated["delay"] = stated["delay"] - carrier * constant_m / METRES_A_NS
        return stated

    def error_model(self, residual: Floats) -> tuple[Mixture, tuple[Unknown, ...], tuple[Part, ...]]:
        """Return the error model with its unknowns and parts, started from robust spreads of residuals (n,)."""
        unknowns, parts = error_unknowns(max(robust_spread(residual), 1e-3), self.pairs.names, self.pairs.number)
        if self.noise is not None:
            rough = Prior(weight=1.0, structure=curvature(self.noise.knots), bounds=(1e-3, 1e6))
            several = tuple(map(str, range(self.noise.size)))
            for name, share in _shares(self.ranges, self.settings.groups):
                values = self.noise.values if share is None else share[:, None] * self.noise.values
                for parameter, deviation in (("noise", 1.0), ("odds", 0.7)):
                    kind = f"{parameter} curve {name}".strip()
                    unknowns.append(
                        logarithms(kind, several, np.zeros(len(several)), rough, Prior.of_deviation(deviation))
                    )
                    parts.append(Part(parameter=parameter, kind=kind, columns=self.noise.columns, values=values))
        if (features := ReflectionFeatures.of(self.ranges)) is not None:
            unknown, part = features.block()
            unknowns.append(unknown)
            parts.append(part)
        return Mixture(), tuple(unknowns), tuple(parts)

    def build(
        self,
        residual: Floats,
        errors: Errors,
        more: Sequence[Unknown] = (),
        parts: Sequence[Part] = (),
        only: Sequence[str] | None = None,
    ) -> tuple[Layout, RangeRows]:
        """Return the layout of the model's unknowns, or of some kinds, followed by others, and the rows of ranges with
        residuals (n,)."""
        unknowns = [u for u in self.unknowns if only is None or u.kind in only]
        kinds = {u.kind for u in unknowns}
        layout = Layout((*unknowns, *more))
        used = [*(p for p in self.parts if p.kind in kinds), *parts]
        return layout, RangeRows.of(residual, self.key(), used, errors, layout)


def _free_directions(ranges: Ranges, tags: list[int], settings: FitSettings) -> tuple[Floats, list[Split]]:
    """Return the directions of delays (tags, k) that the pairs do not determine, and their sides."""
    own = [tag for tag in tags if tag not in settings.fixed_ns]
    if not own or settings.constants == "pair":
        return np.zeros((len(tags), 0)), []
    directions, free = free_directions(own, ranges)
    held = np.zeros((len(tags), directions.shape[1]))
    held[np.isin(tags, own)] = directions
    return held, free


def _constants(ranges: Ranges, pairs: Pairs, tags: list[int], settings: FitSettings) -> tuple[Unknown, Part]:
    """Return delays of tags, or constants of pairs, in ns."""
    prior = (Prior.of_deviation(DELAY_NS),)
    if settings.constants == "pair":
        block = Unknown(kind="delay", names=pairs.names, start=np.zeros(len(pairs.ends)), priors=prior)
        return block_of(block, pairs.number[:, None], np.full((len(ranges), 1), METRES_A_NS))
    known = np.array([tag in settings.fixed_ns for tag in tags])
    start = np.array([settings.fixed_ns.get(tag, 0.0) for tag in tags])
    block = Unknown(kind="delay", names=tuple(map(str, tags)), start=start, known=known, priors=prior)
    lower_first = (ranges.initiator < ranges.target)[:, None]
    weights = np.column_stack([ranges.weight_initiator, ranges.weight_target])
    values = METRES_A_NS * np.where(lower_first, weights, weights[:, ::-1])
    return block_of(block, pairs.among(tags), values)


def _curve(kind: str, spline: SplineValues, share: Floats | None) -> tuple[Unknown, Part]:
    """Return the coefficients of a curve; each range depends on a `share` (n,) of it, None for the whole."""
    rough = Prior(weight=1e2, structure=curvature(spline.knots), bounds=(1e-3, 1e9))
    block = Unknown(
        kind=kind,
        names=tuple(map(str, range(spline.size))),
        start=np.zeros(spline.size),
        priors=(rough, Prior.of_deviation(CURVE_M)),
    )
    values = -spline.values if share is None else -share[:, None] * spline.values
    return block_of(block, spline.columns, values)


TYPICAL_OFFSET_M = 0.035
"""Prior standard deviation of offsets between days and between halves of a flight (3 to 4 cm: MILUV, STAR-loc)."""

OFFSETS = (0.01, 1e-4, 1.0)
"""Standard deviation of other constants in the ranges of a pair, such as a wall: start and bounds, m."""


def _offsets(
    ranges: Ranges,
    pairs: Pairs,
    tags: list[int],
    settings: FitSettings,
    carriers: Sequence[Floats | None],
    kinds: Sequence[str],
) -> Iterator[tuple[Unknown, Part]]:
    """Yield offsets of some kinds, if ranges determine some in addition to delays and constants of curves, and offsets
    of pairs and tags in each of several sessions."""
    number, count = pairs.number[:, None], len(ranges.sessions)
    known = np.eye(len(pairs.ends)) if settings.constants == "pair" else free_ends(pairs, tags, settings)
    determined = _rank(known) + sum(one is None for one in carriers)
    # An obstacle changes the mean of the ranges between two bodies, or of a pair, and makes them noisy.
    group = pairs_of_bodies(pairs, dict(ranges.bodies)) if OFFSET_OF_BODIES in kinds else None
    if group is not None:
        owners = np.eye(int(group.max()) + 1)[group]
        rank = _rank(np.hstack([known, owners]))
        if rank > determined:
            determined, names = rank, tuple(map(str, range(owners.shape[1])))
            # `calib.checks.places` states what a spread of few offsets of bodies adds to intervals.
            block = scattered(
                OFFSET_OF_BODIES, names, OFFSETS, unit="noise of pair", members=(owners / owners.sum(axis=0)).T
            )
            yield block_of(block, group[number])
    if OFFSET_OF_PAIR in kinds and (freedom := len(pairs.ends) - determined) > 0:
        block = scattered(OFFSET_OF_PAIR, pairs.names, OFFSETS, freedom, unit="noise of pair")
        yield block_of(block, number)
    if count < 2:
        return
    for kind, whose, columns in (
        ("offset of pair in session", pairs.names, number),
        ("offset of tag in session", tuple(map(str, tags)), pairs.among(tags)),
    ):
        names = tuple(f"{name} in {where}" for name in whose for where in ranges.sessions)
        own: Ints = np.asarray(columns.astype(np.int64) * count + ranges.session[:, None], dtype=np.int32)
        yield block_of(scattered(kind, names, OFFSETS), own)


def _rank(columns: Floats) -> int:
    """Return the rank of a matrix (pairs, k) of zeros and ones."""
    return int(np.linalg.matrix_rank(columns.T @ columns, hermitian=True))


def free_ends(pairs: Pairs, tags: list[int], settings: FitSettings) -> Floats:
    """Return which tags (tags,) with unknown delays are in each pair, as 0 and 1 (pairs, tags)."""
    free = np.array([tag not in settings.fixed_ns for tag in tags])
    return np.asarray((pairs.ends[:, :, None] == np.array(tags)).sum(axis=1) * free, dtype=np.float64)


def _carrier(pairs: Pairs, tags: list[int], settings: FitSettings, group: tuple[int, ...] | None) -> Floats | None:
    """Return the weights (tags,), or (pairs,) for constants of pairs, with which delays replace a constant of a group's
    curve; None if unknown delays cannot."""
    aim = np.ones(len(pairs.ends)) if group is None else 0.5 * np.isin(pairs.ends, group).sum(axis=1)
    if settings.constants == "pair":
        return aim
    ends = 0.5 * free_ends(pairs, tags, settings)
    weights = np.asarray(np.linalg.lstsq(ends, aim, rcond=None)[0])
    left = aim - ends @ weights
    return weights if left @ left < 1e-4 * (aim @ aim) else None


def strangers(fixed_ns: Mapping[int, float], tags: Sequence[int]) -> Iterator[tuple[str, bool, str]]:
    """Yield a row of `refuse` for each known delay of a tag without ranges."""
    for tag in sorted(set(fixed_ns) - set(tags)):
        yield "fixed_ns", True, f"found tag {tag}, the tags are {', '.join(map(str, tags))}"


def _check_tags(ranges: Ranges, tags: list[int], settings: FitSettings) -> None:
    groups = settings.groups
    member = {tag for own in groups.values() for tag in own}
    refuse(
        [
            *strangers(settings.fixed_ns, tags),
            *(
                ("groups", True, f"tag {tag} is not in any group; the groups are {', '.join(groups)}")
                for tag in tags
                if groups and tag not in member
            ),
            *(
                ("groups", True, f"no tag of group {name!r} has ranges in {ranges.source}")
                for name, own in groups.items()
                if not set(own) & set(tags)
            ),
        ]
    )


def _shares(ranges: Ranges, groups: Mapping[str, tuple[int, ...]]) -> list[tuple[str, Floats | None]]:
    """Return the weight of each group's curve in each range (n,): a half for each end; None for a single curve."""
    shares: list[tuple[str, Floats | None]] = [] if groups else [("", None)]
    for name, own in groups.items():
        share = 0.5 * np.isin(ranges.initiator, own) + 0.5 * np.isin(ranges.target, own)
        if np.count_nonzero(share) < MIN_RANGES_OF_GROUP:
            raise UnanswerableError(
                f"group {name!r} has too few ranges for a curve; at least {MIN_RANGES_OF_GROUP} are needed",
                parameter="groups",
            )
        shares.append((name, share))
    return shares


def _knots(ordered: Floats, low: float, high: float) -> Floats:
    """Return clamped knots from `low` to `high`, halfway between equal counts and equal lengths of the root of lifted
    power.

    Curves are steep at small lifted powers, where roots are dense.
    """
    segments = int(np.clip(round(SEGMENTS_A_FOLD * np.log(high / low)), *CURVE_SEGMENT_BOUNDS))
    counts = np.interp(np.linspace(0, len(ordered) - 1, segments + 1), np.arange(len(ordered)), ordered)
    roots = np.sqrt(np.clip(counts, low, high)) + np.linspace(np.sqrt(low), np.sqrt(high), segments + 1)
    inner = roots**2 / 4
    inner[[0, -1]] = low, high
    return np.concatenate([[low] * DEGREE, inner, [high] * DEGREE])
