"""Where the knots of curves and the bins of powers lie among the powers of a recording."""

from __future__ import annotations

from typing import Final

import numpy as np

from calib.calibration.power_curves import DEGREE, SIGMA_BINS, Bins, equal_bins
from calib.estimation.unknowns import Unknowns
from calib.long_columns import computed
from uwblink.arrays import Floats

SEGMENTS_A_FOLD: Final = 4.5

SEGMENTS: Final = (10, 28)
"""Pieces of a bias curve: so many where lifted power grows e-fold, and bounds of their number."""


def splines(ordered: Floats, span: tuple[float, float], unknowns: Unknowns) -> tuple[Floats, Floats]:
    """Return the knots of curves and each spline's average over their span; none where no curve is fitted."""
    if not unknowns.curve:
        return np.zeros(0), np.zeros(0)
    knots = _knots(ordered, *span)
    # The integral of a B-spline is its coefficients times a quarter of each one's span.
    return knots, (knots[DEGREE + 1 :] - knots[: -DEGREE - 1]) / (DEGREE + 1) / (span[1] - span[0])


def _knots(ordered: Floats, low: float, high: float) -> Floats:
    """Return clamped knots from `low` to `high`, halfway between equal counts and equal lengths, both of square roots.

    Curves are steep where lifted power is small: there the roots lie dense, and few ranges do not spread them.
    Powers over more decades take more knots.
    """
    segments = int(np.clip(round(SEGMENTS_A_FOLD * np.log(high / low)), *SEGMENTS))
    counts = np.interp(np.linspace(0, len(ordered) - 1, segments + 1), np.arange(len(ordered)), ordered)
    roots = np.sqrt(np.clip(counts, low, high)) + np.linspace(np.sqrt(low), np.sqrt(high), segments + 1)
    inner = roots**2 / 4
    inner[[0, -1]] = low, high
    return np.concatenate([[low] * DEGREE, inner, [high] * DEGREE])


def bins_of(lifted: Floats, ordered: Floats) -> Bins:
    """Return bins of equal counts of powers (n,) that stand sorted in `ordered` (n,), at least 20 each."""
    count, size = min(SIGMA_BINS, max(1, len(lifted) // 20)), len(lifted)
    edges = -(-np.arange(count + 1) * size // count)
    # Sorting values and looking them up is several times faster than sorting their places, which equal powers need.
    inner = ordered[edges[1:-1]]
    number = computed(size, lambda rows: np.searchsorted(inner, lifted[rows], side="right"), np.int32)
    counts = np.bincount(number, minlength=count)
    if 2 * int(counts.min()) < size // count:
        return equal_bins(lifted)
    return Bins(number, ordered[(edges[1:] + edges[:-1]) // 2], counts)
