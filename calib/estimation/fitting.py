"""The fit: antenna delays and the bias curve together, then the curve of standard deviation.

A constant in the curve and a shift common to all delays are the same thing (docs/theory.md), so delays are stated for a
curve that is zero at a reference power (`calib.estimation.gauge`): the same boards then get the same delays whatever
powers a recording holds. A fit is held against its own residuals and against what hardware can do before it is
returned (`calib.estimation.doubts`, `plausibility`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, Final

import numpy as np
from threadpoolctl import threadpool_limits

import uwblink
from calib.calibration.model import Calibration
from calib.calibration.power_curves import lift as lift_power
from calib.data.ranges import COLUMNS, Ranges
from calib.data.sources import Data, load_ranges
from calib.estimation.building import build_problem
from calib.estimation.doubts import doubts
from calib.estimation.known_delays import imported, std_taken_over, taken_over
from calib.estimation.limits import limits
from calib.estimation.losses import MIXTURE, check_loss
from calib.estimation.pairs import pairs_of
from calib.estimation.plausibility import implausible, one_way, refuse_impossible, refuse_refuted
from calib.estimation.power_levels import unlike_powers
from calib.estimation.problem import Problem
from calib.estimation.result import FitResult
from calib.estimation.solver import Ended, Solved, solve
from calib.estimation.stating import calibration_of
from calib.estimation.unknowns import Unknowns
from calib.estimation.warnings import warnings_of
from calib.long_columns import computed, empty, let_go, put, spans, std_of
from calib.settings import FitSettings
from uwblink.arrays import Bools, Floats
from uwblink.ticks import SPEED_OF_LIGHT

INLIER_SIGMAS: Final = 3.0
SEQUENTIAL_LOSS: Final = "cauchy"
"""The loss of ICRA 2023, which asks less of the data than the likelihood does."""

FEWEST_A_PAIR: Final = 15
"""Of fewer ranges a pair on average the likelihood's intervals are too narrow, and its delays no better."""


def fit(data: Data | Iterable[Data], settings: FitSettings | None = None, **changes: Any) -> FitResult:
    """Fit antenna delays and the curves of bias and standard deviation to ranges with known truth.

    `data` is what `load_ranges` takes: paths of recordings, simulations in memory, `Ranges`, one or several. `settings`
    and keyword arguments named like its fields (`FitSettings`, which explains them) say what is fitted and how.

    `warnings` begin with what a fit of the chosen kind cannot know: without a curve (`delays_only`), with taken delays
    (`delays_from`), with constants by pair (`constants`). Where power never changes the curve is flat.

    Raises `UnanswerableError` when there are too few ranges, when the pairs do not determine the delays, or when what
    was found is beyond what any radio has (true distances in millimetres, say), and `BadInputError` for pinned tags or
    groups that are not in the data, and for a parameter that cannot be used.

    >>> import calib
    >>> result = calib.fit(calib.sample_flight())
    >>> delays = result.calibration.delays_ns
    >>> f"{delays[2] - delays[1]:.2f} ns, planted 0.40 ns"
    '0.41 ns, planted 0.40 ns'
    """
    settings = replace(settings or FitSettings(), **changes)
    pinned, groups, sequential = dict(settings.fixed_ns), dict(settings.groups), settings.sequential
    lift, alpha_dbm, delays_only = settings.lift, settings.alpha_dbm, settings.delays_only
    check_loss(settings.loss)
    source = imported(settings.delays_from)
    ranges = load_ranges(data, need_power=not delays_only)
    fixed = taken_over(source, ranges, curve=not delays_only) | pinned
    refuse_impossible(ranges)
    loss = settings.loss or (SEQUENTIAL_LOSS if sequential or _too_few(ranges) else MIXTURE)
    # Before the columns of a fit are there: sorting millions of ranges takes memory too.
    skewed = list(one_way(ranges))
    let_go(*(getattr(ranges, name) for name in COLUMNS))
    # The same bytes on any machine: sums of several threads end in other last digits, and slow small matrices down.
    with threadpool_limits(limits=1, user_api="blas"):
        problem = build_problem(
            ranges,
            lift=lift,
            alpha_dbm=alpha_dbm,
            fixed=fixed,
            groups=groups,
            minimum_norm=settings.minimum_norm,
            sequential=sequential,
            unknowns=Unknowns(curve=not delays_only, constants=settings.constants),
        ).without_readings()
        reference = _reference(settings.reference_power_dbm, alpha_dbm, sequential=sequential)
        found = _solved(problem, loss, settings.scale_ns, reference, alpha_dbm, sequential=sequential)
        if found.astray:
            if settings.loss is None:
                loss = SEQUENTIAL_LOSS
                found = _solved(problem, loss, settings.scale_ns, reference, alpha_dbm, sequential=sequential)
            else:
                found = replace(found, success=False)
        problem.let_go()
        doubted = doubts(problem, found)
        problem.let_go()
        calibration = calibration_of(problem, found, doubted.covariance_ns2, loss, lift, alpha_dbm, fixed, groups)
        given = set(fixed) - set(pinned)
        fitted = {tag: std for tag, std in calibration.delays_std_ns.items() if tag not in given}
        calibration = replace(calibration, delays_std_ns=fitted | std_taken_over(source, given))
        # Of the search no more than this is asked from here on.
        problem, ended = problem.without_design(), found.ended
        del found
        residuals, inliers = _left(calibration, ranges)
        refuse_refuted(calibration.delays_ns, residuals, ranges)
        columns = residuals, inliers, *(getattr(ranges, name) for name in COLUMNS)
        warnings = [
            *limits(ranges, problem, residuals, fixed),
            *_stopped(ended),
            *doubted.sentences,
            *skewed,
            *implausible(calibration.delays_ns, residuals),
            *unlike_powers(ranges, calibration),
            *_beyond(reference, alpha_dbm, problem),
            *warnings_of(ranges, float(np.mean(inliers)), problem.free, problem.blocks.seconds),
        ]
        problem.let_go()
        let_go(*columns)
        provenance = _provenance(ranges, inliers, fixed, sequential, problem, ended, warnings, reference)
        if settings.changed():
            provenance["settings"] = settings.changed()
        provenance["error_std_m"] = {
            "raw": std_of(computed(len(ranges), lambda rows: ranges.raw_m[rows] - ranges.truth_m[rows])),
            "corrected": std_of(residuals),
        }
        let_go(*columns)
        return FitResult(
            calibration=replace(calibration, provenance=provenance),
            ranges=ranges,
            residuals_m=residuals,
            inliers=inliers,
            success=ended.success,
            message=f"{'converged' if ended.success else 'stopped'} after {ended.steps} steps",
            warnings=warnings,
        )


def _left(calibration: Calibration, ranges: Ranges) -> tuple[Floats, Bools]:
    """Return what a calibration leaves of the errors of ranges (n,), and which of them lie within three sigmas."""
    # What errors are made of is known, and of no use for this.
    plain, count = replace(calibration, errors=None), len(ranges)
    residuals, inliers = empty(count), empty(count, np.bool_)
    for rows in spans(count):
        some = ranges[rows]
        applied = plain.apply(some)
        left = applied.corrected_m - some.truth_m
        put(residuals, rows, left)
        put(inliers, rows, np.abs(left) < INLIER_SIGMAS * applied.sigma_m)
        let_go(*(getattr(ranges, name) for name in COLUMNS))
    return residuals, inliers


def _solved(
    problem: Problem, loss: str, scale_ns: float | None, reference: float | None, alpha_dbm: float, *, sequential: bool
) -> Solved:
    """Return the optimum of a loss, whose settings are in the units of `fit`."""
    return solve(
        problem,
        loss,
        None if scale_ns is None else scale_ns * 1e-9 * SPEED_OF_LIGHT,
        sequential=sequential,
        reference=None if reference is None else _lifted(reference, alpha_dbm),
    )


def _too_few(ranges: Ranges) -> bool:
    """Return whether ranges are too few to tell what the errors of their pairs are made of."""
    pairs = pairs_of(ranges.initiator, ranges.target, ranges.tags())
    return len(ranges) < FEWEST_A_PAIR * len(pairs.ends)


def _reference(power_dbm: float | None, alpha_dbm: float, *, sequential: bool) -> float | None:
    """Return the power at which curves are zero; None leaves them as they were fitted."""
    return alpha_dbm if power_dbm is None and not sequential else power_dbm


def _lifted(power_dbm: float, alpha_dbm: float) -> float:
    """Return a power, lifted."""
    return float(lift_power(np.array(power_dbm), alpha_dbm))


def _stopped(ended: Ended) -> list[str]:
    if ended.success:
        return []
    return [f"the fit stopped after {ended.steps} steps before it settled: delays and intervals are not final"]


def _beyond(reference: float | None, alpha_dbm: float, problem: Problem) -> list[str]:
    """Warn where the reference power is not among those recorded, so that the delays are stated at the nearest."""
    if reference is None or not problem.unknowns.curve or all(gauge is None for gauge in problem.gauges):
        return []
    low, high = problem.span
    if low <= _lifted(reference, alpha_dbm) <= high:
        return []
    near = low if _lifted(reference, alpha_dbm) < low else high
    return [
        f"no ranges at the reference power of {reference:.1f} dBm: delays are stated at "
        f"{alpha_dbm + 10 * np.log10(near):.1f} dBm, the nearest recorded, and compare only with others stated there"
    ]


def _provenance(
    ranges: Ranges,
    inliers: Bools,
    fixed: dict[int, float],
    sequential: bool,
    problem: Problem,
    ended: Ended,
    warnings: list[str],
    reference: float | None,
) -> dict[str, Any]:
    more: dict[str, Any] = {}
    if fixed:
        more["fixed_ns"] = {str(tag): delay for tag, delay in sorted(fixed.items())}
    if problem.free:
        more["undetermined"] = problem.free
    if reference is not None:
        more["reference_power_dbm"] = reference
    return more | {
        "writer": f"uwbcal {uwblink.__version__}",
        "recordings": ranges.source.split(", "),
        "recording_ids": [found for _, found in ranges.recordings],
        "exchanges": len(ranges),
        "inliers": int(np.count_nonzero(inliers)),
        "excluded": ranges.excluded,
        "recipe": "sequential" if sequential else "joint",
        "fitted": problem.unknowns.told(len(problem.tags)),
        "converged": ended.success,
        "standard_errors": f"sandwich over {ended.stretches:.0f} independent stretches of time",
        "warnings": warnings,
        "gauge": _gauge(problem, reference),
    }


def _gauge(problem: Problem, reference: float | None) -> str:
    """Say which of the delays that fit equally well were chosen."""
    carrier = "constants of pairs" if problem.unknowns.of_pairs else "delays"
    if not problem.unknowns.curve:
        return f"no curve; the {carrier} carry the constant"
    if all(gauge is None for gauge in problem.gauges):
        return "pinned delays; the curve carries the constant"
    if reference is None:
        return "that of the recipe: delays as fitted without a curve, which carries the constant"
    return f"the bias curve is zero at {reference:g} dBm; the {carrier} carry the constant"
