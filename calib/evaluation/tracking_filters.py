"""Extended Kalman filters of one body, side by side: what each measures, and how they run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.calibration.model import Calibration
from calib.calibration.parts import CorrectedRanges
from calib.data.ranges import Ranges
from calib.errors import UnanswerableError
from calib.evaluation.multilateration import multilaterate
from calib.evaluation.range_updates import Heard, RangeErrors, gated, weighed
from calib.evaluation.tracking import ROBUST, Settings, Track
from calib.evaluation.tracking_problem import Problem
from calib.evaluation.tracking_runs import Beside, FilterRanges, Run
from uwblink.arrays import Bools, Floats, Ints

FEWEST_IN_WINDOW: Final = 12
LOOK_EVERY: Final = 8
LOST_NIS: Final = 9.0
"""Where half of the latest ranges are off by more than three standard deviations, a filter is not where it thinks."""

AT_ONCE: Final = 1024
"""Ranges after which errors are weighed by what filters say of them, whose covariances are let go then."""

LEAST_OUTLIERS: Final = 1e-3
LEAST_OUTLIER_M: Final = 3.0
"""What a filter has to reckon with that a calibration has not seen: a thousandth of any size."""


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


def range_errors(calibration: Calibration, ranges: Ranges) -> tuple[Floats, RangeErrors]:
    """Return the noise (n,) of corrected ranges, and what their errors are made of besides.

    Raises `UnanswerableError` for a calibration that does not say.
    """
    model = calibration.errors
    if model is None:
        raise UnanswerableError("the calibration does not say what errors are made of; fit anew from a recording")
    lifted = calibration.lifted(ranges)
    shapes = model.shapes(lifted, ranges.initiator, ranges.target)
    errors = RangeErrors(
        share=shapes.tail_share,
        least_m=model.least_m,
        detour_m=shapes.detour_m,
        outlier=max(model.outlier_share, LEAST_OUTLIERS),
        outlier_m=max(model.outlier_m, LEAST_OUTLIER_M),
        long=model.long,
    )
    return np.hypot(shapes.noise_m, calibration.bias_curve.beyond(lifted)), errors


def run_filters(runs: Sequence[Run], settings: Settings) -> list[dict[str, list[Track]]]:
    """Run filters with every noise, those of all bodies at once; return the tracks of each run by filter, a noise each.

    All runs have the same filters.
    """
    if not runs:
        return []
    given = Beside.of(runs, settings)
    body, shape = given.body, (len(given.errors), len(given.body))
    count, eye = len(given.arm), np.eye(3)
    x = np.tile([noise.start for run in runs for noise in run.noises], (shape[0], 1, 1))
    p = np.tile(eye * settings.initial_std_m**2, (*shape, 1, 1))
    kept = _Kept.empty(count, shape)
    began = np.zeros(shape, dtype=np.int64)
    for k in range(count):
        x = x + given.moves[k]
        p = p + given.spread_m2[k][body][:, None, None] * eye
        towards = x + given.arm[k][body] - given.other[k][body]
        distance = np.sqrt(np.einsum("fsi,fsi->fs", towards, towards))
        h = towards / np.maximum(distance, 1e-6)[..., None]
        ph = np.matmul(p, h[..., None])[..., 0]
        innovation = given.measured_m[k].T[:, body] - distance
        s = np.einsum("fsi,fsi->fs", h, ph) + given.variance_m2[k].T[:, body]
        kept.nis[k] = innovation**2 / s
        heard = _heard(innovation, s, [errors and errors.at((k, body)) for errors in given.errors], settings.gate)
        gain = ph / s[..., None]
        x = x + gain * heard.noise_m[..., None]
        p = p + gain[..., None] * gain[..., None, :] * (heard.variance_m2 - s)[..., None, None]
        for f, one in _lost(kept.nis[: k + 1], runs, body, settings, began) if k % LOOK_EVERY == 0 else ():
            window = Window.until(runs[body[one]].problem, given.moves[:, one], k, settings.reopen_s)
            if window is not None:
                fix = multilaterate(given.measured_m[window.first : k + 1, body[one], f], window.anchor_m, 0.0)
                x[f, one], p[f, one] = fix.place_m, fix.covariance_m2
                began[f, one] = k + 1
        kept.estimate_m[k], kept.covariance_m2[k % AT_ONCE], kept.accepted[k] = x, p, heard.believed
        if (k + 1) % AT_ONCE == 0 or k + 1 == count:
            kept.judge(k + 1, given.place, body)
    return [
        {
            name: [kept.track(run.problem, f, own) for own in np.flatnonzero(body == k).tolist()]
            for f, name in enumerate(run.ranges)
        }
        for k, run in enumerate(runs)
    ]


@dataclass(frozen=True, slots=True)
class _Kept:
    """What filters come to at each range, by filter and column; covariances (some, ...) of the latest alone."""

    estimate_m: Floats
    std_m: Floats
    nis: Floats
    nees: Floats
    accepted: Bools
    covariance_m2: Floats

    @classmethod
    def empty(cls, count: int, shape: tuple[int, int]) -> _Kept:
        """Return room for so many ranges."""
        size = (count, *shape)
        std, nis, nees = np.empty((3, *size))
        return cls(np.empty((*size, 3)), std, nis, nees, np.zeros(size, dtype=bool), np.empty((AT_ONCE, *shape, 3, 3)))

    def judge(self, until: int, place: Floats, body: Ints) -> None:
        """Weigh errors at the latest ranges, those before `until`, by what filters say of them.

        `place` (n, bodies, 3) is where bodies are, `body` (columns,) whose each column is.
        """
        some = slice((until - 1) // AT_ONCE * AT_ONCE, until)
        covariance, wrong = self.covariance_m2[: until - some.start], self.estimate_m[some] - place[some, None, body]
        self.std_m[some] = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))
        self.nees[some] = np.einsum("kfsi,kfsi->kfs", wrong, np.linalg.solve(covariance, wrong[..., None])[..., 0])

    def track(self, problem: Problem, f: int, column: int) -> Track:
        """Return the track of one filter and column, as long as its body's ranges."""
        some = (slice(0, len(problem.rows)), f, column)
        return Track(
            time_ns=problem.time_ns,
            attitude=problem.attitude,
            estimate_m=self.estimate_m[some],
            truth_m=problem.place,
            std_m=self.std_m[some],
            nis=self.nis[some],
            nees=self.nees[some],
            accepted=self.accepted[some],
        )


def _lost(nis: Floats, runs: Sequence[Run], body: Ints, settings: Settings, began: Ints) -> Iterator[tuple[int, int]]:
    """Yield which filters (filter, column) cannot explain half of the latest ranges.

    `nis` (n, filters, columns) are those of all ranges so far; those before a filter `began` anew do not count.
    """
    last = len(nis) - 1
    for k, run in enumerate(runs):
        time_ns, mine = run.problem.time_ns, np.flatnonzero(body == k)
        if last >= len(time_ns):
            continue
        first = int(np.searchsorted(time_ns, time_ns[last] - int(settings.reopen_s * 1e9)))
        if last + 1 - first >= FEWEST_IN_WINDOW:
            lost = (np.median(nis[first:, :, mine], axis=0) > LOST_NIS) & (began[:, mine] <= first)
            yield from ((int(f), int(mine[one])) for f, one in np.argwhere(lost))


def _heard(innovation: Floats, variance: Floats, errors: Sequence[RangeErrors | None], gate: float) -> Heard:
    """Return what all filters make of a range: a gate for most, the whole of its error for those who reckon with it."""
    heard = gated(innovation, variance, gate)
    for f, known in enumerate(errors):
        if known is not None:
            own = weighed(innovation[f], variance[f], known)
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
