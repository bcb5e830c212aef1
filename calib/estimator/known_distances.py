"""The fit of antenna delays and curves to ranges with known distances (ICRA 2023, sections III and IV).

Delays, curves, offsets of pairs and sessions, and the parameters of errors are estimated together by the likelihood of
`calib.range_errors`. A robust loss, and the two-step procedure of ICRA 2023, are options.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from calib.data.ranges import Ranges
from calib.errors import BadInputError, UnanswerableError
from calib.estimator.covariance import Covariance, Kept, sandwich
from calib.estimator.losses import LOSSES, MIXTURE
from calib.estimator.optimize import Optimum, maximize
from calib.estimator.range_model import METRES_A_NS, RangeModel, Spline
from calib.estimator.range_rows import RESIDUAL, Mixture, Part, RangeRows, Robust
from calib.estimator.rows import NormalRows, Rows
from calib.estimator.time_blocks import TimeBlocks, in_order, time_blocks
from calib.estimator.unknowns import Priors, Unknown
from calib.range_errors.density import ErrorSlopes
from calib.spread import robust_spread
from uwblink.arrays import Bools, Floats, Ints

FEWEST_RANGES = 100
"""Minimum number of ranges: fewer do not determine delays, a curve and a share of reflections together."""

PILOT = 6000
"""Ranges of the sample on which the initial guess is found."""

ASTRAY_M = 0.3
"""If the median residual of a pair grows beyond this, the likelihood has taken the whole pair for reflections, and the
robust fit is kept."""

FIRST_SAMPLE, GROWTH = 9000, 6
"""Ranges of the first sample on which the likelihood is maximised, and the growth of the next samples."""

SCALE_OF_SPREAD = 0.5
"""Scale of a robust loss over the robust spread of the residuals.

Half the spread keeps the optimum with the core when a tenth of the data has a positive tail, and still leaves a Cauchy
loss two thirds of least squares' efficiency on clean data.
"""

LARGEST_SPREAD_M = 3.0
"""With a larger spread of residuals the likelihood of range errors does not apply."""

LEAST_SCALE_M = 0.0005
"""Smallest scale of a loss, a tenth of a tick: simulated ranges may have no errors."""


@dataclass(frozen=True, kw_only=True)
class KnownDistances:
    """A fit to known distances: its `model`, the search that ended it, and the covariances of what was fitted.

    `values` are unknowns by kind, `covariances` those of "delay", of all curves side by side ("curve") and of the noise
    ("noise"). `residuals` (n,) are fitted less true ranges in the order of the model's ranges, metres. `searches` are
    the one search, or that of the delays and that of the curves.
    """

    model: RangeModel
    values: dict[str, Floats]
    covariances: dict[str, Floats]
    searches: tuple[Fitted, ...]
    lasting: Covariance
    blocks: TimeBlocks
    residuals: Floats

    @property
    def free(self) -> list[list[int]]:
        """Return groups of tags whose delays the pairs leave free."""
        return self.model.free

    @property
    def delays(self) -> Floats:
        """Return the delays of all tags (or constants of pairs) in ns."""
        return self.values["delay"]

    @property
    def success(self) -> bool:
        """Return whether every search settled."""
        return all(search.optimum.success for search in self.searches)

    @property
    def steps(self) -> int:
        """Return how many steps all searches took."""
        return sum(search.steps for search in self.searches)


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """Settings of a fit to known distances; `calib.FitSettings` explains them."""

    loss: str = MIXTURE
    scale_m: float | None = None
    lift: str = "mean-of-lifted"
    alpha_dbm: float = -82.0
    fixed_ns: Mapping[int, float]
    groups: Mapping[str, tuple[int, ...]]
    minimum_norm: bool = False
    reference: float | None = 1.0
    curve: bool = True
    constants: str = "tag"
    sequential: bool = False
    min_ranges: int = FEWEST_RANGES


def fit_known_distances(ranges: Ranges, recipe: Recipe) -> KnownDistances:
    """Fit delays, curves, offsets and errors.

    Raises `UnanswerableError` if there are too few ranges or if the pairs do not determine the delays, and
    `BadInputError` for pinned tags or groups that are not in the ranges.
    """
    model = model_of(ranges, recipe)
    error = model.ranges.raw_m - model.ranges.truth_m
    if not recipe.minimum_norm:
        refuse_free(model, by_pair=True)
    blocks = time_blocks(model.ranges.time_ns, model.ranges.session)
    if recipe.sequential and model.curve is not None and not set(model.tags) <= set(recipe.fixed_ns):
        return _in_sequence(model, error, recipe, blocks)
    robust = recipe.loss if recipe.loss != MIXTURE else "cauchy"
    pilot = robust_fit(model, error, robust, recipe.scale_m, ("delay", *model.curve_kinds()), sample=PILOT)
    if recipe.loss == MIXTURE and LEAST_SCALE_M < robust_spread(pilot.residuals) < LARGEST_SPREAD_M:
        fitted = likeliest(model, error, pilot)
        if _farthest_pair(model, fitted.residuals) > ASTRAY_M + 3 * _farthest_pair(model, pilot.residuals):
            fitted = pilot
    else:
        fitted = pilot
    if not isinstance(fitted.rows.errors, Mixture):
        fitted = robust_fit(model, error, robust, recipe.scale_m, [u.kind for u in model.unknowns], start=pilot)
    return described(model, fitted, blocks)


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """The end of a search and its rows; `residuals` (n,) are in the order of the model's ranges.

    `beside` are the rows of other measurements than ranges.
    """

    rows: RangeRows
    gauge: tuple[NormalRows, ...]
    optimum: Optimum
    residuals: Floats
    loss: str
    scale_m: float
    steps: int
    beside: tuple[Rows, ...] = ()

    @property
    def values(self) -> dict[str, Floats]:
        """Return the unknowns by kind."""
        return {kind: self.optimum.x[where] for kind, where in self.optimum.layout.where.items()}


def model_of(ranges: Ranges, recipe: Recipe, *, trimmed: bool = True) -> RangeModel:
    """Return the model of ranges in order of time; raises what `fit_known_distances` raises."""
    if len(ranges) < recipe.min_ranges:
        raise UnanswerableError(
            f"{ranges.source}: {len(ranges)} usable exchanges are too few, at least {recipe.min_ranges} are needed"
        )
    model = RangeModel.of(
        in_order(ranges),
        lift=recipe.lift,
        alpha_dbm=recipe.alpha_dbm,
        fixed_ns=recipe.fixed_ns,
        groups=recipe.groups,
        curve=recipe.curve,
        constants=recipe.constants,
        reference=recipe.reference,
        trimmed=trimmed,
    )
    if model.curve is None and set(model.tags) <= set(recipe.fixed_ns):
        raise BadInputError(
            "every tag is pinned and no curve is fitted, so nothing is left to fit", parameter="fixed_ns"
        )
    return model


def refuse_free(model: RangeModel, *, by_pair: bool = False) -> None:
    """Raise `UnanswerableError` if the pairs leave delays free, whatever the distances.

    The message names the constants of pairs as another answer where they can be had (`by_pair`).
    """
    if model.free:
        named = "; ".join(", ".join(map(str, group)) for group in model.free)
        raise UnanswerableError(
            f"the pairs do not determine the antenna delays of tags {named}: some can grow as others shrink without "
            "changing any range; record three tags that all range with each other, or pin a known delay with "
            "`fixed_ns` (`minimum_norm` fits regardless, and says so"
            f"{'; `constants` pair gives each pair its own' if by_pair else ''})",
            undetermined=model.free,
        )


def robust_fit(
    model: RangeModel,
    error: Floats,
    loss: str,
    scale_m: float | None,
    kinds: Sequence[str],
    sample: int | None = None,
    start: Fitted | None = None,
    weight: Bools | None = None,
) -> Fitted:
    """Return the optimum of a robust loss of errors (n,) by some kinds of unknowns.

    The scale follows the residuals of a few steps, unless it is given, and then stands. Slopes are divided by their
    dispersion, so that priors weigh against them as against a likelihood.
    """
    weights = LOSSES[loss].weights
    layout, whole = model.build(error, Robust(weights=weights, scale_m=1.0), only=kinds)
    every = whole if weight is None else whole.sample(np.flatnonzero(weight))
    gauge = (*model.gauge_rows(layout), *model.held_rows(layout))
    rows, x = every, layout.start(start.values if start is not None else None)
    if sample is not None and sample < len(error):
        # A fixed random choice: a regular one could coincide with the schedule of pairs.
        rows = every.sample(np.sort(np.random.default_rng(0).permutation(len(error))[:sample]))
    priors, steps = Priors(layout), 0
    for turn in range(2 if start is not None else 4):
        residual = rows.residuals(x)
        scale = scale_m or max(SCALE_OF_SPREAD * robust_spread(residual), LEAST_SCALE_M)
        errors = Robust(weights=weights, scale_m=scale).tempered(residual)
        found = maximize([replace(rows, errors=errors), *gauge], priors, x, steps=15, evidence_steps=15 * (turn > 0))
        x, steps = found.x, steps + found.steps
    if sample is None:
        found = maximize([replace(rows, errors=errors), *gauge], priors, x, steps=200, evidence_steps=0)
        x, steps = found.x, steps + found.steps
        final = replace(rows, errors=replace(errors.tempered(rows.residuals(x)), reweighted=False))
        ended = maximize([final, *gauge], priors, x, steps=20, evidence_steps=0)
        if ended.success and _convex(ended):
            found, rows = ended, final
        else:
            # With few ranges most may lie where the loss is concave; weights then replace the curvature.
            rows = replace(rows, errors=errors)
    return Fitted(
        rows=rows,
        gauge=gauge,
        optimum=found,
        residuals=whole.residuals(found.x),
        loss=loss,
        scale_m=scale,
        steps=steps + found.steps,
    )


def _farthest_pair(model: RangeModel, residual: Floats) -> float:
    """Return the largest absolute median residual of a pair, in metres."""
    order = np.argsort(model.pairs.number, kind="stable")
    parts = np.split(residual[order], np.flatnonzero(np.diff(model.pairs.number[order])) + 1)
    return max(abs(float(np.median(part))) for part in parts)


def _convex(optimum: Optimum) -> bool:
    """Return whether the information of rows and priors is positive definite."""
    known = optimum.information + optimum.priors.precision()
    whole = np.asarray(known.todense() if sparse.issparse(known) else known)
    free = optimum.layout.free()
    own = whole[np.ix_(free, free)]
    scale = 1 / np.sqrt(np.maximum(np.diag(own), 1e-300))
    return bool(np.linalg.eigvalsh(own * scale[:, None] * scale)[0] > 1e-10)


def likeliest(model: RangeModel, error: Floats, pilot: Fitted) -> Fitted:
    """Return the maximum of the likelihood, found from a robust start on samples of growing size and then on all
    ranges."""
    errors, unknowns, parts = model.error_model(pilot.residuals)
    layout, rows = model.build(error, errors, unknowns, parts)
    gauge, asked = (
        (*model.gauge_rows(layout), *model.held_rows(layout)),
        layout.indices([u.kind for u in model.unknowns]),
    )
    found, steps = _maximize_by_samples(rows, gauge, Priors(layout), layout.start(pilot.values), asked)
    return Fitted(
        rows=rows,
        gauge=gauge,
        optimum=found,
        residuals=rows.residuals(found.x),
        loss=MIXTURE,
        scale_m=pilot.scale_m,
        steps=pilot.steps + steps,
    )


def _maximize_by_samples(
    rows: RangeRows, gauge: Sequence[NormalRows], priors: Priors, x: Floats, asked: Ints | None = None
) -> tuple[Optimum, int]:
    """Return the optimum of rows, found on samples of growing size and then on all of them, and the steps taken."""
    order = np.random.default_rng(0).permutation(len(rows))
    size, steps = FIRST_SAMPLE, 0
    while 2 * size < len(rows):
        found = maximize([rows.sample(np.sort(order[:size])), *gauge], priors, x, tolerance=1.0, asked=asked)
        x, size, steps = found.x, size * GROWTH, steps + found.steps
    found = maximize([rows, *gauge], priors, x, asked=asked)
    return found, steps + found.steps


def described(model: RangeModel, fitted: Fitted, blocks: TimeBlocks) -> KnownDistances:
    """Return a fit with the covariances of what was fitted."""
    layout = fitted.optimum.layout
    noise = [kind for kind in layout.where if kind.startswith(("noise level", "noise curve"))]
    parts = {
        "delay": layout.indices(["delay"]),
        "curve": layout.indices(model.curve_kinds()),
        "noise": layout.indices(noise),
    }
    parts = {name: own for name, own in parts.items() if len(own)}
    each = len(fitted.residuals) / len(model.pairs.ends)
    kept = [Kept.delays(own, each) if name == "delay" else Kept.curve(own) for name, own in parts.items()]
    lasting = sandwich(fitted.optimum, fitted.rows, kept, blocks, fitted.beside)
    whose = np.repeat(np.arange(len(parts)), [len(own) for own in parts.values()])
    covariances = {name: lasting.matrix[np.ix_(whose == k, whose == k)] for k, name in enumerate(parts)}
    if "offset of pair" in layout.where and "odds of pair" in layout.where:
        wider = _of_another_shape(fitted.optimum, kept[0].indices)
        covariances["delay"] = covariances["delay"] + wider
    return KnownDistances(
        model=model,
        values=fitted.values,
        covariances=covariances,
        searches=(fitted,),
        lasting=lasting,
        blocks=blocks,
        residuals=fitted.residuals,
    )


SHAPE = 0.1
"""Shift of a reflected range, in units of noise, when detours do not have the shape of the model. Gamma-distributed
detours, or two lengths, shift delays by as much (`make worlds`)."""


def _of_another_shape(optimum: Optimum, delays: Ints) -> Floats:
    """Return the covariance (tags, tags) of delays due to reflections of another shape, which shift the ranges of a
    pair.

    Ranges that are longer by b move all unknowns by the covariance times their information on an offset of the pair.
    """
    noise = np.exp(optimum.of("noise level") + optimum.of("noise of pair"))
    share = 1 / (1 + np.exp(-optimum.of("odds level") - optimum.of("odds of pair")))
    unit = np.zeros((optimum.layout.size, len(share)))
    unit[optimum.layout.where["offset of pair"]] = np.eye(len(share))
    moved = (optimum.covariance @ np.asarray(optimum.information @ unit))[delays]
    return np.asarray((moved * (SHAPE * share * noise) ** 2) @ moved.T)


def _in_sequence(model: RangeModel, error: Floats, recipe: Recipe, blocks: TimeBlocks) -> KnownDistances:
    """Fit delays first, then the curves to the residuals, as in ICRA 2023, sections III and IV, with splines.

    The curves keep their constants and the delays are those of the first step, unless a reference power is given.
    """
    free = replace(model, gauged=(False,) * len(model.gauged))
    first = described(free, robust_fit(free, error, recipe.loss, recipe.scale_m, ("delay",)), blocks)
    kinds = free.curve_kinds()
    # Few ranges have the outer powers, and they would bend the curve: it is fitted to the others.
    inside = (free.lifted >= free.span[0]) & (free.lifted <= free.span[1])
    second = robust_fit(free, first.residuals, recipe.loss, first.searches[0].scale_m, kinds, weight=inside)
    curves = described(free, second, blocks)
    values = first.values | {kind: curves.values[kind] for kind in kinds}
    if recipe.reference is not None:
        values = _stated(model, values, recipe)
    return KnownDistances(
        model=model,
        values=values,
        covariances=curves.covariances | {"delay": first.covariances["delay"]},
        searches=(first.searches[0], second),
        lasting=first.lasting,
        blocks=blocks,
        residuals=second.residuals,
    )


def _stated(model: RangeModel, values: dict[str, Floats], recipe: Recipe) -> dict[str, Floats]:
    """Return delays and curves with each curve zero at the reference power: the constant of a group's curve moves to
    the delays of its tags."""
    if model.curve is None or recipe.reference is None:
        return values
    at = Spline.at(np.array([recipe.reference]), model.curve.knots)
    stated, delays = dict(values), values["delay"].copy()
    for kind, gauged in zip(model.curve_kinds(), model.gauged, strict=True):
        constant = float(at.values[0] @ values[kind][at.columns[0]])
        name = kind.removeprefix("curve").strip()
        if gauged:
            own = np.isin(model.tags, model.groups[name]) if name else slice(None)
            delays[own] -= constant / METRES_A_NS
            stated[kind] = values[kind] - constant
    return stated | {"delay": delays}


@dataclass(frozen=True, kw_only=True)
class DescribedErrors:
    """The error model of a fit: unknowns by kind, the covariance of the noise, and how each range looks.

    `slopes` are those of every range (n,) by the residual and the odds, in the order of the model's ranges, for errors
    less `location_m`.
    """

    values: dict[str, Floats]
    covariances: dict[str, Floats]
    slopes: ErrorSlopes
    location_m: float


def described_errors(found: KnownDistances) -> DescribedErrors:
    """Return the error model: as it was fitted, or fitted to the residuals of a robust loss."""
    search, model, location = found.searches[-1], found.model, 0.0
    values, covariances = found.values, found.covariances
    rows, x = search.rows, search.optimum.x
    if not isinstance(rows.errors, Mixture):
        mixture, unknowns, parts = model.error_model(found.residuals)
        centre = Unknown(kind="centre", names=("",), start=np.array([-float(np.median(found.residuals))]))
        everyone = Part(parameter=RESIDUAL, kind="centre", columns=np.zeros((1, 1), dtype=np.int64))
        layout, rows = model.build(found.residuals, mixture, [centre, *unknowns], [everyone, *parts], only=())
        optimum, _ = _maximize_by_samples(rows, (), Priors(layout), layout.start())
        x, location = optimum.x, -float(optimum.of("centre")[0])
        values = {kind: x[where] for kind, where in layout.where.items()}
        noise = layout.indices([kind for kind in values if kind.startswith(("noise level", "noise curve"))])
        covariances = {"noise": optimum.covariance[:, noise][noise]}
    slopes = rows.error_slopes(x, (RESIDUAL, "odds"))
    return DescribedErrors(values=values, covariances=covariances, slopes=slopes, location_m=location)
