"""Errors over power, as curves over power see them: their core bin by bin, of each pair and of all ranges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.calibration.model import Calibration
from calib.calibration.parts import CorrectedRanges
from calib.data.ranges import Ranges
from calib.error_mixture import fit_error_mixtures
from calib.evaluation.statistics import pair_rows
from uwblink.arrays import Floats

BINS: Final = 20
BINS_OF_PAIR: Final = 6
FEWEST_IN_BIN: Final = 60
"""Errors of which a core can be told from a tail; below, their median stands for both."""


@dataclass(frozen=True, slots=True)
class Binned:
    """Errors by lifted power: median power, centre, and standard deviation in each bin, metres.

    Of the errors' core, noise without reflections, or of all of them where the curve was fitted to those.
    """

    lifted: Floats
    centre_m: Floats
    std_m: Floats
    median_m: Floats


def binned(lifted: Floats, error_m: Floats, loss: str, bins: int) -> Binned:
    """Return what errors (n,) come to by lifted power (n,), as a fit with this loss sees them.

    The curve of a robust fit follows the errors' core: reflections only lengthen, so medians and means lie above it.
    Least squares follow the mean.
    """
    return _all_binned([(lifted, error_m, bins)], loss)[0]


def _all_binned(sets: Sequence[tuple[Floats, Floats, int]], loss: str) -> list[Binned]:
    """Return the same of some sets of lifted powers, errors and a number of bins; all their cores are found at once."""
    rows = [np.array_split(np.argsort(x), max(1, min(bins, len(x) // FEWEST_IN_BIN))) for x, _, bins in sets]
    errors = [error_m[some] for (_, error_m, _), groups in zip(sets, rows, strict=True) for some in groups]
    centres = iter(_centres(errors, loss))
    found = []
    for (lifted, error_m, _), groups in zip(sets, rows, strict=True):
        own = np.array([next(centres) for _ in groups])
        median = np.array([np.median(error_m[some]) for some in groups])
        found.append(Binned(np.array([np.median(lifted[some]) for some in groups]), own[:, 0], own[:, 1], median))
    return found


def _centres(groups: Sequence[Floats], loss: str) -> list[tuple[float, float]]:
    """Return centre and spread of each group of errors (n,)."""
    if loss == "l2":
        return [(float(np.mean(error_m)), float(np.std(error_m))) for error_m in groups]
    told = [len(error_m) >= FEWEST_IN_BIN and float(np.ptp(error_m)) >= 1e-9 for error_m in groups]
    cores = iter(fit_error_mixtures([error_m for error_m, so in zip(groups, told, strict=True) if so]))
    found = []
    for error_m, so in zip(groups, told, strict=True):
        core = next(cores) if so else None
        found.append(
            (core.location_m, float(core.sigma_m[0])) if core else (float(np.median(error_m)), float(np.std(error_m)))
        )
    return found


@dataclass(frozen=True, slots=True)
class OverPower:
    """Errors by lifted power, of each pair by name and of all ranges."""

    pairs: dict[str, Binned]
    everything: Binned


def over_power(ranges: Ranges, lifted: Floats, error_m: Floats, loss: str) -> OverPower:
    """Return what errors (n,) come to by lifted power (n,): pair by pair in a few bins, and all in more."""
    pairs = pair_rows(ranges)
    sets = [(lifted[rows], error_m[rows], BINS_OF_PAIR) for rows in pairs.values()]
    *each, everything = _all_binned([*sets, (lifted, error_m, BINS)], loss)
    return OverPower(dict(zip(pairs, each, strict=True)), everything)


def biases(ranges: Ranges, applied: CorrectedRanges, calibration: Calibration) -> OverPower:
    """Return the delay-corrected errors over power, which `bias_over_power` draws."""
    return over_power(ranges, applied.lifted, applied.delay_corrected_m - ranges.truth_m, calibration.loss)


def sigmas(ranges: Ranges, applied: CorrectedRanges, calibration: Calibration) -> OverPower:
    """Return the calibrated errors over power, which `sigma_over_power` draws."""
    return over_power(ranges, applied.lifted, applied.corrected_m - ranges.truth_m, calibration.loss)
