"""Extended Kalman filters of one body, side by side: what each measures, and how they run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.calibration.model import Calibration
from calib.calibration.parts import CorrectedRanges
from calib.errors import UnanswerableError
from calib.evaluation.multilateration import multilaterate
from calib.evaluation.range_updates import Heard, RangeErrors, gated, weighed
from calib.evaluation.tracking import ROBUST, Settings, Track
from calib.evaluation.tracking_problem import Noise, Problem, velocity_spread
from calib.ranges import Ranges
from uwblink.arrays import Floats, Ints

FEWEST_IN_WINDOW: Final = 12
LOOK_EVERY: Final = 8
LOST_NIS: Final = 9.0
"""Where half of the latest ranges are off by more than three standard deviations, a filter is not where it thinks."""

LEAST_OUTLIERS: Final = 1e-3
LEAST_OUTLIER_M: Final = 3.0
"""What a filter has to reckon with that a calibration has not seen: a thousandth of any size."""


@dataclass(frozen=True, slots=True)
class FilterRanges:
    """What a filter measures (n,), its standard deviation (n,), and what errors are made of if it reckons with it."""

    measured_m: Floats
    std_m: Floats
    errors: list[RangeErrors] | None = None


def filter_ranges(
    ranges: Ranges, applied: CorrectedRanges, rows: Ints, calibration: Calibration, fixed: dict[str, float]
) -> dict[str, FilterRanges]:
    """Return what each of `FILTERS` measures; the robust one only where it is known what errors are made of."""
    raw, corrected, sigma = applied.raw_m[rows], applied.corrected_m[rows], applied.sigma_m[rows]
    found = {
        "raw": FilterRanges(raw, np.full(len(rows), fixed["raw"])),
        "calibrated": FilterRanges(corrected, np.full(len(rows), fixed["calibrated"])),
        "variance": FilterRanges(corrected, sigma),
    }
    if calibration.errors is not None:
        noise, errors = range_errors(calibration, ranges)
        found[ROBUST] = FilterRanges(corrected - calibration.errors.location_m, noise, errors)
    return found


def range_errors(calibration: Calibration, ranges: Ranges) -> tuple[Floats, list[RangeErrors]]:
    """Return the noise (n,) of corrected ranges, and what their errors are made of besides.

    Raises `UnanswerableError` for a calibration that does not say.
    """
    model = calibration.errors
    if model is None:
        raise UnanswerableError("the calibration does not say what errors are made of; fit anew from a recording")
    lifted = calibration.lifted(ranges)
    shapes = model.shapes(lifted, ranges.initiator, ranges.target)
    errors = [
        RangeErrors(
            share=float(share),
            least_m=model.least_m,
            detour_m=float(detour),
            outlier=max(model.outlier_share, LEAST_OUTLIERS),
            outlier_m=max(model.outlier_m, LEAST_OUTLIER_M),
        )
        for share, detour in zip(shapes.tail_share, shapes.detour_m, strict=True)
    ]
    return np.hypot(shapes.noise_m, calibration.bias_curve.beyond(lifted)), errors


def run_filters(
    problem: Problem, ranges: list[FilterRanges], noises: list[Noise], settings: Settings
) -> list[list[Track]]:
    """Run filters with every noise, all at once: arrays are (filters, noises, ...). Return their tracks."""
    shape, count = (len(ranges), len(noises)), len(problem.rows)
    spread, eye = velocity_spread(problem, settings), np.eye(3)
    measured, variance = (np.array([getattr(r, name) for r in ranges]) for name in ("measured_m", "std_m"))
    variance = variance**2
    moves = np.array([noise.moves for noise in noises])
    x = np.tile([noise.start for noise in noises], (len(ranges), 1, 1))
    p = np.tile(eye * settings.initial_std_m**2, (*shape, 1, 1))
    estimate, covariance = np.empty((count, *shape, 3)), np.empty((count, *shape, 3, 3))
    nis, accepted = np.empty((count, *shape)), np.zeros((count, *shape), dtype=bool)
    began = np.zeros(shape, dtype=np.int64)
    for k in range(count):
        x = x + moves[:, k]
        p = p + spread[k] * eye
        towards = x + problem.arm[k] - problem.other[k]
        distance = np.sqrt(np.einsum("fsi,fsi->fs", towards, towards))
        h = towards / np.maximum(distance, 1e-6)[..., None]
        ph = np.matmul(p, h[..., None])[..., 0]
        innovation = measured[:, k, None] - distance
        s = np.einsum("fsi,fsi->fs", h, ph) + variance[:, k, None]
        nis[k] = innovation**2 / s
        heard = _heard(innovation, s, ranges, k, settings.gate)
        gain = ph / s[..., None]
        x = x + gain * heard.noise_m[..., None]
        p = p + gain[..., None] * gain[..., None, :] * (heard.variance_m2 - s)[..., None, None]
        for f, one in _lost(nis[: k + 1], problem, settings, began):
            window = Window.until(problem, moves[one], k, settings.reopen_s)
            if window is not None:
                fix = multilaterate(measured[f, window.first : k + 1], window.anchor_m, 0.0)
                x[f, one], p[f, one] = fix.place_m, fix.covariance_m2
                began[f, one] = k + 1
        estimate[k], covariance[k], accepted[k] = x, p, heard.believed
    wrong = estimate - problem.place[:, None, None, :]
    nees = np.einsum("kfsi,kfsi->kfs", wrong, np.linalg.solve(covariance, wrong[..., None])[..., 0])
    std = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))
    return [
        [
            Track(
                time_ns=problem.time_ns,
                attitude=problem.attitude,
                estimate_m=estimate[:, f, s],
                truth_m=problem.place,
                std_m=std[:, f, s],
                nis=nis[:, f, s],
                nees=nees[:, f, s],
                accepted=accepted[:, f, s],
            )
            for s in range(shape[1])
        ]
        for f in range(shape[0])
    ]


def _lost(nis: Floats, problem: Problem, settings: Settings, began: Ints) -> list[tuple[int, int]]:
    """Return which filters (filter, noise) cannot explain half of the latest ranges, looked at now and then.

    `nis` (n, filters, noises) are those of all ranges so far; those before a filter `began` anew do not count.
    """
    last = len(nis) - 1
    if last % LOOK_EVERY:
        return []
    first = int(np.searchsorted(problem.time_ns, problem.time_ns[last] - int(settings.reopen_s * 1e9)))
    if last + 1 - first < FEWEST_IN_WINDOW:
        return []
    lost = (np.median(nis[first:], axis=0) > LOST_NIS) & (began <= first)
    return [(int(f), int(s)) for f, s in np.argwhere(lost)]


def _heard(innovation: Floats, variance: Floats, ranges: list[FilterRanges], k: int, gate: float) -> Heard:
    """Return what all filters make of range k: a gate for most, the whole of its error for those who reckon with it."""
    heard = gated(innovation, variance, gate)
    for f, one in enumerate(ranges):
        if one.errors is not None:
            own = weighed(innovation[f], variance[f], one.errors[k])
            heard.noise_m[f], heard.variance_m2[f], heard.believed[f] = own.noise_m, own.variance_m2, own.believed
    return heard


@dataclass(frozen=True, slots=True)
class Window:
    """The latest ranges of a body: rows `first` to `last`, and where antennas would be, were it where it is now (n, 3).

    What it moved meanwhile is known from its velocity, and counted to the anchors.
    """

    first: int
    last: int
    anchor_m: Floats

    @classmethod
    def until(cls, problem: Problem, moves: Floats, last: int, seconds: float) -> Window | None:
        """Return the window that ends at a range, None where it holds too few or does not reach back so far."""
        began = problem.time_ns[last] - int(seconds * 1e9)
        first = int(np.searchsorted(problem.time_ns, began))
        if problem.time_ns[0] > began or last + 1 - first < FEWEST_IN_WINDOW:
            return None
        rows = slice(first, last + 1)
        since = moves[first + 1 : last + 1][::-1].cumsum(axis=0)[::-1]
        since = np.vstack([since, np.zeros(3)])
        return cls(first, last, problem.other[rows] - problem.arm[rows] + since)
