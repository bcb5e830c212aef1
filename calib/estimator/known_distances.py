"""The fit of antenna delays and curves to ranges with known distances (ICRA 2023, sections III and IV).

Delays, curves, offsets of pairs and sessions, and the parameters of errors are estimated together by the likelihood of
`calib.range_errors`. A robust loss, and the two-step procedure of ICRA 2023, are options.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.special import expit

from calib.data.ranges import Ranges
from calib.errors import BadInputError, UnanswerableError
from calib.estimator.arrival_rows import ArrivalModel
from calib.estimator.covariance import Kept, sandwich
from calib.estimator.covariates import COMMON, OWN, OWN_WARMTH, WARMTH
from calib.estimator.losses import LOSSES, MIXTURE
from calib.estimator.optimize import Optimum, maximize
from calib.estimator.range_model import METRES_A_NS, OFFSET_KINDS, OFFSET_OF_PAIR, RangeModel
from calib.estimator.range_rows import RESIDUAL, Mixture, RangeRows, Robust, block_of
from calib.estimator.rows import NormalRows, Rows
from calib.estimator.score_tests import Slopes
from calib.estimator.time_blocks import Persistence, TimeBlocks, in_order, time_blocks
from calib.estimator.unknowns import Layout, Priors, Unknown
from calib.range_errors.densities import ErrorSlopes
from calib.settings import FitSettings
from calib.spread import medians, robust_spread
from uwblink.arrays import Bools, Floats, Ints

FEWEST_RANGES = 100
"""Minimum number of ranges: fewer do not determine delays, a curve and a share of reflections together."""

PILOT = 6000
"""Ranges of the sample on which the initial guess is found. Half or twice as many, or as many of the first sample,
move delays of worlds by 0.01 standard errors (`python -m benchmarks.constants`)."""

ASTRAY_M = 0.3
"""Mean absolute error of a pair that reflections may explain: half of its ranges by 60 cm. If the median residual of a
pair grows by more, the likelihood has taken the whole pair for reflections, and the robust fit is kept."""

FIRST_SAMPLE, SAMPLE_GROWTH = 9000, 6
"""Ranges of the first sample on which the likelihood is maximised, and the growth of the next samples."""

SCALE_OF_SPREAD = 0.5
"""Scale of a robust loss over the robust spread of the residuals.

With half the spread the optimum stays at the core if a tenth of the data has a positive tail, and a Cauchy loss has two
thirds of the efficiency of least squares on clean data.
"""

LEAST_SCALE_M, LARGEST_SPREAD_M = 0.0005, 3.0
"""Smallest scale of a loss, a tenth of a tick: simulated ranges may have no errors. With a larger spread of residuals
the likelihood of range errors does not apply."""


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """The end of a search and its rows; `residuals` (n,) are in the order of the model's ranges.

    `heard` are the rows of differences of arrival, if there are any, and `arrivals` their model.
    `beside` are the rows of other measurements, whose standard errors are known.
    """

    rows: RangeRows
    gauge: tuple[NormalRows, ...]
    optimum: Optimum
    residuals: Floats
    loss: str
    scale_m: float
    steps: int
    heard: RangeRows | None = None
    arrivals: ArrivalModel | None = None
    beside: tuple[Rows, ...] = ()

    def slopes(self, blocks: TimeBlocks) -> list[Slopes]:
        """Return the slopes of ranges and of differences of arrival, each with the sums of both by block of time."""
        kinds = [(self.rows, blocks)]
        if self.heard is not None and self.arrivals is not None:
            kinds.append((self.heard, replace(blocks, number=blocks.number[self.arrivals.exchange])))
        found = [Slopes(own, self.optimum, when) for own, when in kinds]
        sums, count = np.sum([one.own for one in found], axis=0), sum(one.count for one in found)
        for one in found:
            one.own, one.count = sums, count
        return found


@dataclass(frozen=True, kw_only=True)
class RangeFit:
    """A fit to ranges: its `model`, the searches that ended it, and the covariances of the fitted values.

    Distances were known, or estimated along with trajectories.

    `values` are unknowns by kind, `covariances` the covariances of "delay", of all curves together ("curve"), of the
    noise ("noise"), of patterns over direction ("pattern") and of delays and slopes over temperature ("temperature").
    `residuals` (n,) are fitted minus true ranges in the order of the model's ranges, metres. `searches` are the only
    search, or the searches for delays and for curves. `persistence` is the persistence of errors of delays; `slopes`
    and `slopes_of_heard` are from the first search.
    """

    model: RangeModel
    values: dict[str, Floats]
    covariances: dict[str, Floats]
    searches: tuple[Fitted, ...]
    persistence: Persistence
    blocks: TimeBlocks
    slopes: Slopes
    residuals: Floats
    slopes_of_heard: Slopes | None = None

    @property
    def delays(self) -> Floats:
        """Return the delays of all tags (or constants of pairs) in ns."""
        return self.values["delay"]

    @property
    def success(self) -> bool:
        """Return whether every search converged."""
        return all(search.optimum.success for search in self.searches)

    @property
    def steps(self) -> int:
        """Return the number of steps of all searches."""
        return sum(search.steps for search in self.searches)


def fit_known_distances(ranges: Ranges, settings: FitSettings) -> RangeFit:
    """Fit delays, curves, offsets and errors.

    Raises `UnanswerableError` if there are too few ranges, and `BadInputError` for pinned tags or groups that are not
    in the ranges.
    """
    model = model_of(ranges, settings)
    if model.curve is None and model.pinned:
        raise BadInputError(
            "all delays are known and no curve is fitted, so there is nothing to fit", parameter="fixed_ns"
        )
    error = model.ranges.error_m
    blocks = time_blocks(model.ranges.time_ns, model.ranges.session)
    loss = settings.fitted_loss
    scale_m = None if settings.scale_ns is None else settings.scale_ns * METRES_A_NS
    if settings.sequential and model.curve is not None and not model.pinned:
        return _fit_in_sequence(model, error, loss, scale_m, blocks)
    # The loss of ICRA 2023 gives the initial guess of the likelihood.
    robust, heard = loss if loss != MIXTURE else "cauchy", ArrivalModel.of(model)
    first = ("delay", *model.curve_kinds(), COMMON, OWN, WARMTH, OWN_WARMTH)
    pilot = robust_fit(model, error, robust, scale_m, first, sample=PILOT, heard=heard)
    if heard is not None and pilot.heard is not None:
        own = heard.rows(pilot.optimum.layout, pilot.heard.errors).residuals(pilot.optimum.x)
        of_heard, of_ranges = (
            errors.slopes({RESIDUAL: residual})[1][RESIDUAL]
            for errors, residual in ((pilot.heard.errors, own), (pilot.rows.errors, pilot.residuals))
        )
        # The weight of differences of arrival follows from their slopes at the end of the first search.
        heard = heard.with_weight(of_heard, of_ranges, model.pairs.number, blocks)
    if loss == MIXTURE and LEAST_SCALE_M < robust_spread(pilot.residuals) < LARGEST_SPREAD_M:
        likely = fit_likelihood(model, error, pilot, heard)
        if _farthest_pair(model, likely.residuals) <= ASTRAY_M + 3 * _farthest_pair(model, pilot.residuals):
            return with_covariances(model, likely, blocks)
    kinds = [u.kind for u in model.unknowns]
    fitted = robust_fit(model, error, robust, scale_m, kinds, start=pilot, heard=heard)
    return with_covariances(model, fitted, blocks)


def model_of(
    ranges: Ranges, settings: FitSettings, *, offsets: Sequence[str] = OFFSET_KINDS, trimmed: bool = True
) -> RangeModel:
    """Return the model of ranges in order of time.

    Raises `UnanswerableError` if there are too few ranges, and what `RangeModel.of` raises.
    """
    if len(ranges) < FEWEST_RANGES:
        raise UnanswerableError(
            f"{ranges.source}: {len(ranges)} usable exchanges are too few; at least {FEWEST_RANGES} are needed"
        )
    return RangeModel.of(in_order(ranges), settings, offsets=offsets, trimmed=trimmed)


def robust_fit(  # noqa: PLR0913 - a search has that many sides
    model: RangeModel,
    error: Floats,
    loss: str,
    scale_m: float | None,
    kinds: Sequence[str],
    sample: int | None = None,
    start: Fitted | None = None,
    inside: Bools | None = None,
    heard: ArrivalModel | None = None,
) -> Fitted:
    """Return the optimum of a robust loss of errors (n,), and of differences of arrival, by some kinds of unknowns.

    The ranges are a random `sample` of this size, those `inside` (n,), or all. The scale follows the residuals for a
    few steps, unless it is given (`scale_m`), and is then fixed. Slopes are divided by their dispersion, so that priors
    have the same weight relative to them as relative to a likelihood.
    """
    weights = LOSSES[loss].weights
    layout, whole = model.build(error, Robust(weights=weights, scale_m=1.0), only=kinds)
    every = whole if inside is None else whole.sample(np.flatnonzero(inside))
    gauge = (*model.gauge_rows(layout), *model.held_rows(layout))
    x = layout.start(start.optimum.by_kind() if start is not None else None)
    rows, effects = [every], [1.0]
    if heard is not None:
        rows, effects = [every, heard.rows(layout, every.errors)], [1.0, heard.design_effect]
    if sample is not None and sample < len(error):
        # A fixed random choice: a regular one could coincide with the schedule of pairs.
        chosen = np.sort(np.random.default_rng(0).permutation(len(error))[:sample])
        rows = [each.sample(chosen) for each in rows]
    priors, steps = Priors(layout), 0
    for turn in range(2 if start is not None else 4):
        residuals = [each.residuals(x) for each in rows]
        scales = [scale_m or max(SCALE_OF_SPREAD * robust_spread(r), LEAST_SCALE_M) for r in residuals]
        errors = [
            Robust(weights=weights, scale_m=s).with_dispersion(r, effect)
            for s, r, effect in zip(scales, residuals, effects, strict=True)
        ]
        rows = [replace(each, errors=own) for each, own in zip(rows, errors, strict=True)]
        found = maximize([*rows, *gauge], priors, x, steps=15, evidence_steps=15 * (turn > 0))
        x, steps = found.x, steps + found.steps
    if sample is None:
        found = maximize([*rows, *gauge], priors, x, steps=200, evidence_steps=0)
        x, steps = found.x, steps + found.steps
        final = [
            replace(each, errors=replace(own.with_dispersion(each.residuals(x), effect), least=None))
            for each, own, effect in zip(rows, errors, effects, strict=True)
        ]
        ended = maximize([*final, *gauge], priors, x, steps=20, evidence_steps=0)
        # With few ranges most may lie where the loss is concave; then weights are used instead of the curvature.
        if ended.success and _convex(ended):
            found, rows = ended, final
    return Fitted(
        rows=rows[0],
        heard=rows[1] if heard else None,
        arrivals=heard,
        gauge=gauge,
        optimum=found,
        residuals=whole.residuals(found.x),
        loss=loss,
        scale_m=scales[0],
        steps=steps + found.steps,
    )


def _farthest_pair(model: RangeModel, residual: Floats) -> float:
    """Return the largest absolute median residual of a pair, in metres."""
    return float(np.max(np.abs(medians(residual, model.pairs.number))))


def _convex(optimum: Optimum) -> bool:
    """Return whether the information of rows and priors is positive definite."""
    known = optimum.information + optimum.priors.precision()
    whole = np.asarray(known.todense() if sparse.issparse(known) else known)
    free = optimum.layout.free()
    own = whole[np.ix_(free, free)]
    scale = 1 / np.sqrt(np.maximum(np.diag(own), 1e-300))
    return bool(np.linalg.eigvalsh(own * scale[:, None] * scale)[0] > 1e-10)


def fit_likelihood(model: RangeModel, error: Floats, pilot: Fitted, heard: ArrivalModel | None = None) -> Fitted:
    """Return the maximum of the likelihood, found from a robust start on samples of growing size and then on all
    ranges."""
    errors, unknowns, parts = model.error_model(pilot.residuals)
    if heard is not None:
        straight = heard.rows(pilot.optimum.layout, errors).residuals(pilot.optimum.x)
        of_heard, own, own_parts = heard.error_model(straight)
        unknowns = (*unknowns, *heard.unknowns, *own)
    layout, of_ranges = model.build(error, replace(errors, restricted=True), unknowns, parts)
    gauge = (*model.gauge_rows(layout), *model.held_rows(layout))
    asked, rows = layout.indices([u.kind for u in model.unknowns]), [of_ranges]
    if heard is not None:
        rows.append(heard.rows(layout, replace(of_heard, restricted=True), own_parts))
    found, steps = _maximize_by_samples(rows, gauge, layout, layout.start(pilot.optimum.by_kind()), asked)
    of_ranges, *of_arrivals = (own for own in found.rows if isinstance(own, RangeRows))
    return Fitted(
        rows=of_ranges,
        heard=next(iter(of_arrivals), None),
        arrivals=heard,
        gauge=gauge,
        optimum=found,
        residuals=of_ranges.residuals(found.x),
        loss=MIXTURE,
        scale_m=pilot.scale_m,
        steps=pilot.steps + steps,
    )


def _maximize_by_samples(
    rows: Sequence[RangeRows], gauge: Sequence[NormalRows], layout: Layout, x: Floats, asked: Ints | None = None
) -> tuple[Optimum, int]:
    """Return the optimum of rows (ranges first), found on samples of growing size and then on all of them, and the
    number of steps."""
    count, priors, size, steps = len(rows[0]), Priors(layout), FIRST_SAMPLE, 0
    order = np.random.default_rng(0).permutation(count)
    while 2 * size < count:
        some = [one.sample(np.sort(order[:size])) for one in rows]
        found = maximize([*some, *gauge], priors, x, tolerance=1.0, asked=asked)
        x, size, steps = found.x, size * SAMPLE_GROWTH, steps + found.steps
    found = maximize([*rows, *gauge], priors, x, asked=asked)
    return found, steps + found.steps


def with_covariances(model: RangeModel, fitted: Fitted, blocks: TimeBlocks) -> RangeFit:
    """Return a fit with the covariances of the fitted values."""
    layout = fitted.optimum.layout
    kept = {
        "delay": Kept.delays(layout.indices(["delay"]), len(fitted.residuals) / len(model.pairs.ends), model.held),
        "curve": Kept.curve(layout.indices(model.curve_kinds())),
        "noise": Kept.curve(layout.indices(noise_kinds(layout))),
        "pattern": Kept.curve(layout.indices([COMMON, OWN])),
    }
    if len(warmth := layout.indices([WARMTH, OWN_WARMTH])):
        kept["temperature"] = kept["delay"].beside(warmth)
    kept = {name: group for name, group in kept.items() if len(group.indices)}
    slopes, *of_heard = fitted.slopes(blocks)
    found = sandwich(slopes, kept, fitted.beside)
    covariances = {name: matrix for name, (matrix, _) in found.items()}
    if OFFSET_OF_PAIR in layout.where and "odds of pair" in layout.where:
        covariances["delay"] = covariances["delay"] + _covariance_of_other_detours(fitted.optimum)
    return RangeFit(
        model=model,
        values=model.at_reference(fitted.optimum.by_kind()),
        covariances=covariances,
        searches=(fitted,),
        persistence=found[next(iter(kept))][1],
        blocks=blocks,
        slopes=slopes,
        slopes_of_heard=next(iter(of_heard), None),
        residuals=fitted.residuals,
    )


def noise_kinds(layout: Layout) -> list[str]:
    """Return the kinds of unknowns that determine the noise of a range over power."""
    return [kind for kind in layout.where if kind.startswith(("noise level", "noise curve"))]


SHAPE = 0.1
"""Shift of a reflected range, in units of noise, when detours have another distribution than the model.
Gamma-distributed detours, or two lengths, shift delays by this amount (`make worlds`)."""


def _covariance_of_other_detours(optimum: Optimum) -> Floats:
    """Return the covariance (tags, tags) of delays due to reflections of another distribution, which shift the ranges
    of a pair.

    Ranges that are longer by b move all unknowns by the covariance times their information on an offset of the pair.
    """
    noise = np.exp(optimum.of("noise level") + optimum.of("noise of pair"))
    share = expit(optimum.of("odds level") + optimum.of("odds of pair"))
    unit = np.zeros((optimum.layout.size, len(share)))
    unit[optimum.layout.where[OFFSET_OF_PAIR]] = np.eye(len(share))
    moved = (optimum.covariance @ np.asarray(optimum.information @ unit))[optimum.layout.where["delay"]]
    return np.asarray((moved * (SHAPE * share * noise) ** 2) @ moved.T)


def _fit_in_sequence(
    model: RangeModel, error: Floats, loss: str, scale_m: float | None, blocks: TimeBlocks
) -> RangeFit:
    """Fit delays first, then the curves to the residuals, as in ICRA 2023, sections III and IV, with splines.

    The curves keep their constants and the delays are from the first step, unless a reference power is given.
    """
    free = replace(model, carriers=(None,) * len(model.carriers))
    first = with_covariances(free, robust_fit(free, error, loss, scale_m, ("delay",)), blocks)
    kinds = free.curve_kinds()
    # Few ranges have the outer powers, and would bend the curve: it is fitted to the others.
    inside = (free.lifted >= free.span[0]) & (free.lifted <= free.span[1])
    second = robust_fit(free, first.residuals, loss, first.searches[0].scale_m, kinds, inside=inside)
    curves = with_covariances(free, second, blocks)
    return replace(
        first,
        model=model,
        values=model.at_reference(first.values | {kind: curves.values[kind] for kind in kinds}),
        covariances=curves.covariances | {"delay": first.covariances["delay"]},
        searches=(first.searches[0], second),
        residuals=second.residuals,
    )


@dataclass(frozen=True, kw_only=True)
class DescribedErrors:
    """The error model of a fit: unknowns by kind, the covariance of the noise's unknowns, and the slopes of each range.

    `slopes` are the slopes of every range (n,) by the residual and the odds, in the order of the model's ranges, for
    errors minus `location_m`.
    """

    values: dict[str, Floats]
    noise: Floats
    slopes: ErrorSlopes
    location_m: float


def described_errors(found: RangeFit) -> DescribedErrors:
    """Return the error model: the fitted one, or one fitted to the residuals of a robust loss."""
    search = found.searches[-1]
    if not isinstance(search.rows.errors, Mixture):
        return errors_of(found.model, found.residuals)
    slopes = search.rows.error_slopes(search.optimum.x, (RESIDUAL, "odds"))
    return DescribedErrors(values=found.values, noise=found.covariances["noise"], slopes=slopes, location_m=0.0)


def errors_of(model: RangeModel, residual: Floats) -> DescribedErrors:
    """Return the error model fitted to residuals (n,), in the order of the model's ranges."""
    mixture, unknowns, parts = model.error_model(residual)
    start = np.array([-float(np.median(residual))])
    centre, everyone = block_of(Unknown(kind="centre", names=("",), start=start), np.zeros((1, 1), dtype=np.int64))
    layout, rows = model.build(residual, mixture, [centre, *unknowns], [everyone, *parts], only=())
    optimum, _ = _maximize_by_samples([rows], (), layout, layout.start())
    own = layout.indices(noise_kinds(layout))
    return DescribedErrors(
        values=optimum.by_kind(),
        noise=np.asarray(optimum.covariance[:, own][own]),
        slopes=rows.error_slopes(optimum.x, (RESIDUAL, "odds")),
        location_m=-float(optimum.of("centre")[0]),
    )
