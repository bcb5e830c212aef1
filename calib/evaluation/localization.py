"""What a calibration is worth to a robot: an EKF that tracks one body from its ranges to the others.

State is the body's position; its velocity and attitude are inputs taken from motion capture, velocity with noise; the
other bodies are known (ICRA 2023, section V). Four filters see the same ranges and the same noise of velocity: raw and
calibrated with fixed variances, calibrated with the variance of the sigma curve, and calibrated with all that a
calibration says of errors, reflections included. `calib.evaluation.onboard` does without motion capture.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from calib.calibration.model import Calibration, require_calibration
from calib.data.sources import Data, Flight, load_flight, require_times
from calib.errors import UnanswerableError
from calib.evaluation.tracking import FixedStd, Localization, Settings
from calib.evaluation.tracking_filters import filter_ranges, run_filters
from calib.evaluation.tracking_problem import Noise, problems
from calib.evaluation.tracking_runs import FilterRanges, Run

PAPER_RMSE_M: Final = {"raw": 0.804, "calibrated": 0.500, "variance": 0.431}
"""Mean over six scenarios (ICRA 2023, its only table): flights of its own, another filter's noise."""

TUNED_OVER: Final = (0.04, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4, 0.6, 1.0)
"""Fixed standard deviations that are tried, in metres."""

TUNED_RANGES: Final = 2500
"""Ranges of each body of a training flight by which they are judged."""


def localize(
    data: Data | Flight,
    calibration: Calibration,
    settings: Settings | None = None,
    *,
    training: Data | Flight | None = None,
) -> list[Localization]:
    """Track every body that moves and ranges in a recording, one at a time, with extended Kalman filters.

    `data` is the path of a recording, an open `Recording`, or anything with `exchanges`, `poses` and `tags`. The fixed
    variances are the best ones on the flight `training`; without it those of the errors that the calibration was fitted
    to, as it remembers them; never those of the flight itself, which a filter cannot know. Raises what
    `Calibration.apply` raises, and `UnanswerableError` where no body moves or the recording has no poses.

    >>> import calib
    >>> known = calib.fit(calib.sample_flight()).calibration
    >>> found = calib.localize(calib.sample_flight(seed=2), known)
    >>> [one.body for one in found]
    ['robot1', 'robot2', 'robot3']
    >>> found[0].tracks["calibrated"].rmse_m < 0.1
    True
    """
    require_calibration(calibration)
    chosen = settings or Settings()
    flight = data if isinstance(data, Flight) else load_flight(data, need_power=calibration.needs_power)
    fixed = fixed_std(calibration, chosen, training)
    require_times(flight.ranges)
    applied = calibration.apply(flight.ranges)
    runs = []
    for problem in problems(flight):
        noises = [Noise.drawn(problem, chosen, chosen.seed + k) for k in range(chosen.seeds)]
        ranges = filter_ranges(flight.ranges[problem.rows], applied, problem.rows, calibration, fixed.std_m)
        runs.append(Run(problem, ranges, noises))
    if not runs:
        raise UnanswerableError(
            f"{flight.ranges.source}: no body moves among poses and ranges, so there is nothing to localize"
        )
    return [
        Localization(
            source=flight.ranges.source,
            body=run.problem.body,
            tracks={name: own[0] for name, own in tracks.items()},
            rmse_m={name: np.array([track.rmse_m for track in own]) for name, own in tracks.items()},
            fixed=fixed,
            simulated=flight.ranges.planted is not None,
        )
        for run, tracks in zip(runs, run_filters(runs, chosen), strict=True)
    ]


def fixed_std(calibration: Calibration, settings: Settings, training: Data | Flight | None = None) -> FixedStd:
    """Return the fixed standard deviations of raw and calibrated ranges, by what is known before the flight.

    The one that is given; else the best ones on a training flight; else those of the errors that the calibration was
    fitted to, or its sigma at the middle of its powers, where it is too old to remember them.
    """
    if settings.fixed_std_m is not None:
        return FixedStd(dict.fromkeys(("raw", "calibrated"), settings.fixed_std_m), "given")
    if training is not None:
        return _tuned(training if isinstance(training, Flight) else load_flight(training), calibration, settings)
    known = calibration.provenance.get("error_std_m")
    if isinstance(known, dict) and {"raw", "corrected"} <= set(known):
        return FixedStd(
            {"raw": float(known["raw"]), "calibrated": float(known["corrected"])}, "of the errors that were fitted"
        )
    middle = float(calibration.sigma_curve(np.array([np.mean(calibration.sigma_curve.range)]))[0])
    return FixedStd(dict.fromkeys(("raw", "calibrated"), middle), "the sigma curve's middle")


def _tuned(flight: Flight, calibration: Calibration, settings: Settings) -> FixedStd:
    """Return the standard deviations with which the filters err least on a flight."""
    applied = calibration.apply(flight.ranges)
    runs = []
    for whole in problems(flight):
        problem = whole.first(TUNED_RANGES)
        noises = [Noise.drawn(problem, settings, settings.seed + k) for k in range(settings.seeds)]
        measured = {"raw": applied.raw_m[problem.rows], "calibrated": applied.corrected_m[problem.rows]}
        ranges = {
            f"{name}, {std}": FilterRanges(own, np.full(len(own), std))
            for name, own in measured.items()
            for std in TUNED_OVER
        }
        runs.append(Run(problem, ranges, noises))
    squares = np.zeros((2, len(TUNED_OVER)))
    for tracks in run_filters(runs, settings):
        errors = [[track.rmse_m for track in own] for own in tracks.values()]
        squares += np.sum(np.array(errors) ** 2, axis=1).reshape(squares.shape)
    best = [TUNED_OVER[k] for k in np.argmin(squares, axis=1)]
    return FixedStd({"raw": best[0], "calibrated": best[1]}, f"tuned on {flight.ranges.source}")
