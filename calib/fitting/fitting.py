"""`calib.fit` and `calib.add_tag`: from settings and ranges to a calibration with findings.

A constant of the curve and a common shift of all delays cannot be distinguished (docs/theory.md). Delays are therefore
stated for a curve that is zero at a reference power: the same boards then get the same delays whatever powers a
recording holds.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from calib.calibration.document import for_json, split_text
from calib.calibration.error_model import lasting_errors
from calib.calibration.model import Calibration, CalibrationSource, given_calibration
from calib.checks.fitted import examine_fit
from calib.checks.limits import (
    dependence_on_initiator,
    differing_power_levels,
    implausible_values,
    limits,
    limits_of_data,
    refuse_contradicted,
    refuse_impossible,
    refuse_refuted,
)
from calib.data.ranges import Ranges, held_out
from calib.data.sources import Data, load_ranges, require_arrivals
from calib.errors import BadInputError, UnanswerableError
from calib.estimator.known_distances import RangeFit
from calib.estimator.losses import MIXTURE, check_loss
from calib.estimator.to_calibration import calibration_of
from calib.evaluation.statistics import evaluate
from calib.findings import Finding, for_provenance, warning
from calib.fitting.covariates import drift_of, effects_of_supply, fit_with_covariates, with_new_tag
from calib.fitting.passive_listeners import MIN_OF_DELAY
from calib.fitting.result import FitResult, HeldOut
from calib.settings import FitSettings, check_tag, refuse
from uwblink.arrays import Bools
from uwblink.recording.antenna_delays import delays_differ, known_delays


def fit(data: Data | Iterable[Data], settings: FitSettings | None = None, **changes: Any) -> FitResult:
    """Fit antenna delays and the curves of bias and standard deviation to ranges with known truth.

    `data` is what `load_ranges` takes: paths of recordings, simulations in memory, `Ranges`, one or several. `settings`
    and keyword arguments named like its fields select the model and its options (see `FitSettings`).

    Findings begin with what a fit of the chosen kind cannot know: without a curve (`delays_only`), with taken delays
    (`delays_from`), with constants by pair (`constants`). Where power never changes the curve is flat.

    Where tags range only with tags of another side (anchors with robots), a warning says so, and the calibration
    corrects ranges between the sides only (`Calibration.undetermined_splits`).

    Raises `UnanswerableError` when there are too few ranges, or when the result is impossible for a radio (for example
    with true distances in millimetres), and `BadInputError` for known delays or groups of tags that are not in the
    data, and for unusable parameters.

    >>> import calib
    >>> result = calib.fit(calib.sample_flight())
    >>> delays = result.calibration.delays_ns
    >>> f"{delays[2] - delays[1]:.2f} ns, planted 0.40 ns"
    '0.41 ns, planted 0.40 ns'
    """
    settings = replace(settings or FitSettings(), **changes)
    check_loss(settings.loss)
    source = None if settings.delays_from is None else given_calibration(settings.delays_from, "delays_from")
    ranges = load_ranges(data, need_power=not settings.delays_only, use=settings.use)
    if ranges.differences.any() and not ranges.differences.all():
        raise UnanswerableError(
            f"{ranges.source}: ranges and differences of arrival without stamps have different errors: fit them "
            f"separately, ranges with `use` exchanges, differences from recordings without exchanges"
        )
    heard = 0 if ranges.arrivals is None else len(ranges.arrivals)
    if settings.use == "exchanges":
        ranges = replace(ranges, arrivals=None)
    else:
        require_arrivals(ranges)
    fixed = _given_delays(source, ranges, curve=not settings.delays_only) | dict(settings.fixed_ns)
    refuse_impossible(ranges)
    # One thread: sums of several threads differ in the last digits, and threads slow small matrices down.
    with threadpool_limits(limits=1, user_api="blas"):
        found, dependences, vague = fit_with_covariates(ranges, replace(settings, fixed_ns=fixed))
        fitted = dict(zip(found.model.tags, found.delays.tolist(), strict=False))
        refuse_refuted(fitted, found.residuals, found.model.ranges)
        covariance_ns2, findings = examine_fit(found)
        calibration = calibration_of(found, covariance_ns2)
    given = set(fixed) - set(settings.fixed_ns)
    taken = {tag: std for tag, std in source.delays_std_ns.items() if tag in given} if source else {}
    stated = {tag: std for tag, std in calibration.delays_std_ns.items() if tag not in given}
    calibration = replace(calibration, delays_std_ns=stated | taken)
    # Differences of arrival determine delays that ranges between two sides leave open.
    unused = heard if settings.use == "exchanges" and calibration.undetermined_splits else 0
    held = _held_out(ranges, settings) if settings.hold_out else None
    provenance = _provenance(found, ranges, settings) | dependences
    if held:
        provenance["held_out"] = _evaluate_held_out(held, settings)
    result = result_of(
        found,
        replace(calibration, provenance=provenance),
        ranges,
        findings,
        settings=settings,
        fixed=fixed,
        first=[
            warning(
                "unused differences of arrival",
                f"{unused} differences of arrival at other tags would determine the delays of targets",
            )
        ]
        if unused
        else [],
        more=[
            *vague,
            *effects_of_supply(calibration.temperatures, ranges),
            *_settings_without_effect(found, settings),
            *_convergence(found, settings.loss),
        ],
    )
    return replace(result, held_out=held)


def _settings_without_effect(found: RangeFit, settings: FitSettings) -> Iterator[Finding]:
    if settings.reference_power_dbm is not None and all(one is None for one in found.model.carriers):
        why = "no curve is fitted" if found.model.curve is None else "known delays determine the constant of the curve"
        yield warning("reference power without effect", f"the reference power has no effect: {why}")


def _provenance(found: RangeFit, ranges: Ranges, settings: FitSettings) -> dict[str, Any]:
    """Return the provenance of a fit to known distances: data, recipe, gauge and drift."""
    return {
        **({} if found.model.reference_dbm is None else {"reference_power_dbm": found.model.reference_dbm}),
        "recordings": ranges.source.split(", "),
        "recording_ids": [name for _, name in ranges.recordings],
        "recipe": "sequential" if settings.sequential else "joint",
        "fitted": fitted_quantities(found),
        **({"arrivals": len(arrivals.residual)} if (arrivals := found.searches[0].arrivals) else {}),
        **({"arrivals": len(ranges)} if ranges.differences.any() else {}),
        "gauge": gauge_of(found),
        **({"drift": drift} if (drift := drift_of(found)) else {}),
    }


def add_tag(data: Data | Iterable[Data], calibration: CalibrationSource, tag: int, loss: str = MIXTURE) -> FitResult:
    """Fit the delay of one new tag; all other values of the calibration stay the same.

    `data` is what `load_ranges` takes. It is the fit of `calib.fit` to all exchanges of the tag with calibrated ones,
    whose delays and curve are known. A tag that ranges with one side of an undetermined split joins the other side.
    Raises `BadInputError` where the tag is known already or not in the data, `UnanswerableError` where it ranges with
    both sides, and what `calib.fit` raises.

    >>> import calib, dataclasses
    >>> known = calib.fit(calib.sample_flight()).calibration
    >>> two = dataclasses.replace(known, delays_ns={tag: known.delays_ns[tag] for tag in (1, 2)})
    >>> found = calib.add_tag(calib.sample_flight(seed=2), two, 3).calibration
    >>> abs(found.delays_ns[3] - known.delays_ns[3]) < 0.02
    True
    """
    check_tag(tag)
    calibration = given_calibration(calibration)
    ranges = load_ranges(data, need_power=calibration.needs_power)
    some = _ranges_of_new_tag(calibration, tag, ranges)
    joined = _with_side(replace(calibration, delays_ns=calibration.delays_ns | {tag: 0.0}), tag, some)
    joined = with_new_tag(joined, tag, some)
    applied = joined.apply(some)
    straight = replace(some, raw_m=some.raw_m + applied.corrected_m - applied.delay_corrected_m)
    partners = replace(calibration, undetermined_splits=(), patterns=(), temperatures=())
    settings = FitSettings(
        loss=loss,
        delays_from=partners,
        delays_only=True,
        alpha_dbm=calibration.alpha_dbm,
        pattern="none",
        temperature="none",
    )
    found = fit(straight, settings, lift=calibration.lift)
    added = {"tag": tag, "recording": ranges.source, "exchanges": len(some)}
    unshared = warning(
        "pattern of another tag",
        f"tag {tag}: its pattern over direction differs from those of the other tags and is not known: total sigmas "
        f"include a pattern of the same size",
    )
    return replace(
        found,
        calibration=replace(
            joined,
            delays_ns=calibration.delays_ns | {tag: found.calibration.delays_ns[tag]},
            delays_std_ns=calibration.delays_std_ns
            | {tag: math.inf if tag in joined.sides else found.calibration.delays_std_ns[tag]},
            antenna_delays={**calibration.antenna_delays, **known_delays(ranges.antenna_delays, [tag])},
            provenance=calibration.provenance | {"added": [*calibration.provenance.get("added", []), added]},
        ),
        ranges=some,
        # The curve is known, and was taken off before.
        findings=[
            *[one for one in found.findings if one.fault not in ("no curve", "no powers")],
            *([unshared] if len(joined.patterns) > len(calibration.patterns) else []),
        ],
    )


def _ranges_of_new_tag(calibration: Calibration, tag: int, ranges: Ranges) -> Ranges:
    """Return the ranges of a new tag with calibrated tags that the calibration can correct but for its delay.

    Raises the errors of `add_tag` for calibrations, tags and ranges that cannot be used.
    """
    tags = ranges.tags()
    differ = delays_differ(calibration.antenna_delays, ranges.antenna_delays, calibration.delays_ns)
    refuse(
        [
            (
                "calibration",
                calibration.pair_offsets,
                "has constants of pairs and no delays of tags; fit all recordings again",
            ),
            (
                "tag",
                tag in calibration.delays_ns,
                f"the calibration already has a delay of tag {tag}; fit all recordings again to change it",
            ),
            ("calibration", differ, differ),
            (
                "tag",
                tag not in tags,
                f"tag {tag} has no ranges in {ranges.source}; its tags are {', '.join(map(str, tags))}",
            ),
        ]
    )
    known = list(calibration.delays_ns)
    first, second = (np.isin(ends, known) for ends in (ranges.initiator, ranges.target))
    some = ranges[(first & (ranges.target == tag)) | (second & (ranges.initiator == tag))]
    if len(some) < MIN_OF_DELAY:
        raise UnanswerableError(
            f"{ranges.source}: {len(some)} exchanges of tag {tag} with calibrated tags are too few; at least "
            f"{MIN_OF_DELAY} are needed"
        )
    directed = [one for pattern in calibration.patterns for one in pattern.tags]
    blind = np.isnan(some.toward).any(axis=2) & np.isin(some.ends, directed)
    some = some[np.flatnonzero(~blind.any(axis=1))]
    if len(some) < MIN_OF_DELAY:
        raise UnanswerableError(
            f"{ranges.source}: the calibration has patterns over direction, but only {len(some)} exchanges have "
            f"known directions; at least {MIN_OF_DELAY} are needed: add poses with attitudes (`uwblink poses`), or "
            f"fit with `pattern` none"
        )
    return some


def _with_side(calibration: Calibration, tag: int, ranges: Ranges) -> Calibration:
    """Return a calibration in which a tag has the side opposite to its partners', if they have one.

    Raises `UnanswerableError` where they have several.
    """
    sides = {calibration.sides.get(partner, 0) for partner in ranges.tags() if partner != tag}
    if len(sides) > 1:
        raise UnanswerableError(
            f"tag {tag} ranges with tags of several sides of the calibration, so its ranges may determine more "
            f"delays; fit all recordings together ({split_text(calibration.undetermined_splits)})"
        )
    (side,) = sides
    splits = list(calibration.undetermined_splits)
    if side:
        first, second = splits[abs(side) - 1]
        splits[abs(side) - 1] = (first, (*second, tag)) if side > 0 else ((*first, tag), second)
    return replace(calibration, undetermined_splits=tuple(splits))


def _given_delays(known: Calibration | None, ranges: Ranges, *, curve: bool) -> dict[int, float]:
    """Return the delays that a calibration has for tags of these ranges.

    Raises `BadInputError` where it has none, and where it has all and no `curve` is fitted beside them.
    """
    if known is None:
        return {}
    found = {tag: known.delays_ns[tag] for tag in ranges.tags() if tag in known.delays_ns}
    there, here = (", ".join(map(str, sorted(tags))) for tags in (known.delays_ns, ranges.tags()))
    rows = (
        (
            known.undetermined_splits,
            f"{split_text(known.undetermined_splits)}; fit its recordings together with these",
        ),
        (
            known.patterns or known.temperatures,
            "its delays refer to average directions or a reference temperature; fit its recordings together with "
            "these, or use a calibration fitted with `pattern` and `temperature` none",
        ),
        (not found, f"its tags are {there}, but those of the ranges are {here}"),
        (
            not curve and len(found) == len(ranges.tags()),
            "it has the delays of all tags, and `delays_only` fits no curve, so there is nothing to fit",
        ),
    )
    refuse(("delays_from", wrong, text) for wrong, text in rows)
    return found


def result_of(
    found: RangeFit,
    calibration: Calibration,
    ranges: Ranges,
    findings: Iterable[Finding],
    *,
    settings: FitSettings,
    fixed: Mapping[int, float],
    first: Iterable[Finding] = (),
    more: Iterable[Finding] = (),
) -> FitResult:
    """Return the result of a fit: its calibration with lasting errors, findings and provenance, and the residuals.

    `findings` are those of the checks of the fit; those of a kind of fit are `first`, or `more` after the limits of the
    ranges.
    """
    applied = calibration.apply(ranges)
    residuals = applied.corrected_m - ranges.truth_m
    over_sigma = residuals / applied.sigma_m
    inliers: Bools = np.asarray(np.abs(over_sigma) < 3.0)
    findings = [*findings, *dependence_on_initiator(ranges)]
    refuse_contradicted(float(np.mean(inliers)), ranges, findings)
    if calibration.errors is not None:
        known = replace(
            calibration.errors, lasting=lasting_errors(ranges, over_sigma, applied.tail_share, applied.tail_probability)
        )
        calibration = replace(calibration, errors=known)
    splits = calibration.undetermined_splits
    findings = [
        *([warning("undetermined delays", split_text(splits))] if splits else []),
        *first,
        *limits(found, ranges, residuals, fixed),
        *more,
        *findings,
        *implausible_values(calibration.delays_ns, residuals),
        *differing_power_levels(found, ranges, calibration),
        *_without_reference_power(found),
        *limits_of_data(ranges, float(np.mean(inliers)), found.blocks.seconds),
    ]
    provenance: dict[str, Any] = {
        "exchanges": int(np.count_nonzero(~ranges.differences)),
        "inliers": int(np.count_nonzero(inliers)),
        "excluded": ranges.excluded,
        "converged": found.success,
        "standard_errors": f"sandwich over {found.persistence.stretches:.0f} independent stretches of time",
        **for_provenance(findings, settings.changed(), fixed),
        "error_std_m": {"raw": float(np.std(ranges.error_m)), "corrected": float(np.std(residuals))},
    }
    return FitResult(
        calibration=replace(calibration, provenance=calibration.provenance | provenance),
        ranges=ranges,
        residuals_m=residuals,
        inliers=inliers,
        success=found.success,
        message=f"{'converged' if found.success else 'stopped'} after {found.steps} steps",
        findings=findings,
    )


def _held_out(ranges: Ranges, settings: FitSettings) -> HeldOut:
    """Return the ranges that are held out, and a fit to the others.

    Raises `UnanswerableError` where the others do not determine how to correct them.
    """
    rows = held_out(ranges, settings.hold_out, settings.fold)
    known = fit(ranges[~rows], settings, hold_out=0.0, fold="time").calibration
    try:
        known.apply(ranges[rows])
    except BadInputError as error:
        raise UnanswerableError(f"the held-out ranges cannot be evaluated: {error}", parameter="hold_out") from error
    return HeldOut(ranges[rows], known)


def _evaluate_held_out(held: HeldOut, settings: FitSettings) -> dict[str, Any]:
    """Return how a fit to a part of the ranges does on those that are held out, for the provenance."""
    found = evaluate(held.ranges, held.calibration).overall
    judged: dict[str, Any] = {
        "share": settings.hold_out,
        "fold": settings.fold,
        "ranges": found.full.n,
        "raw_median_m": found.raw.median_m,
        "median_m": found.full.median_m,
        "raw_robust_std_m": found.raw.robust_std_m,
        "robust_std_m": found.full.robust_std_m,
        "inside_95": found.inside_95,
    }
    return {name: for_json(value) for name, value in judged.items()}


def _convergence(found: RangeFit, asked_for: str | None) -> Iterator[Finding]:
    if asked_for == MIXTURE and found.searches[0].loss != MIXTURE:
        text = "the likelihood treated all ranges of a pair as reflected, so a robust loss was fitted instead"
        yield warning("another loss", text)
    elif not found.success:
        text = f"the fit stopped after {found.steps} steps before it converged: delays and intervals are not final"
        yield warning("not converged", text)


def _without_reference_power(found: RangeFit) -> Iterator[Finding]:
    """Yield a finding if no range has the reference power, so that delays are stated at the nearest power."""
    model, settings = found.model, found.model.settings
    if model.reference is None or not _has_gauge(found):
        return
    near = float(np.clip(model.reference, *model.span))
    if near != model.reference:
        yield warning(
            "reference power",
            f"no ranges at the reference power of {model.reference_dbm:.1f} dBm: delays refer to the nearest recorded "
            f"power, {settings.alpha_dbm + 10 * np.log10(near):.1f} dBm",
        )


def _has_gauge(found: RangeFit) -> bool:
    """Return whether delays can take over the constant of any curve."""
    return any(carrier is not None for carrier in found.model.carriers)


def fitted_quantities(found: RangeFit) -> str:
    """Return the names of the fitted quantities."""
    model = found.model
    if model.settings.constants == "pair":
        return "constants of pairs" if model.curve is None else "constants of pairs and curve"
    if model.curve is None:
        return "delays only"
    return "curve only" if model.pinned else "delays and curve"


def gauge_of(found: RangeFit) -> str:
    """Return a sentence on the choice of the common constant of delays and curve."""
    carrier = "constants of pairs" if found.model.settings.constants == "pair" else "delays"
    if found.model.curve is None:
        return f"no curve; the {carrier} contain the common constant"
    if not _has_gauge(found):
        return "known delays; the curve contains the common constant"
    if found.model.reference is None:
        return "two steps: delays fitted without a curve; the curve contains the common constant"
    return f"the bias curve is zero at {found.model.reference_dbm:g} dBm; the {carrier} contain the common constant"
