"""The figures of a calibration, drawn into axes: histogram of errors, curves over power, delays.

Each takes matplotlib axes, or makes new ones where there are none, and returns them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes as Axes
from matplotlib.figure import Figure

from calib.calibration.model import Calibration, CorrectedRanges
from calib.evaluation.statistics import CORRECTION_STAGES, beside_planted, pair_rows, planted_curve
from calib.ranges import Ranges
from calib.spread import robust_spread
from uwblink.arrays import Floats
from uwblink.ticks import SPEED_OF_LIGHT

# Okabe and Ito's palette, which colour-blind readers can tell apart.
COLOURS: Final = {"raw": "#D55E00", "delays": "#E69F00", "full": "#0072B2", "planted": "#009E73"}
LABELS: Final = {"raw": "raw", "delays": "delays corrected", "full": "fully corrected"}
HISTOGRAM_CM: Final = (-40.0, 80.0)
BINS: Final = 20
WIDE: Final = (8.0, 3.6)
LOW: Final = (8.0, 3.4)
TWO_SIDED_95: Final = 1.959963984540054


def histogram(ranges: Ranges, applied: CorrectedRanges, axes: Axes | None = None) -> Axes:
    """Range errors in the three stages, in cm; the outermost bins hold everything beyond them."""
    axes = axes or new_axes()
    edges = np.arange(HISTOGRAM_CM[0], HISTOGRAM_CM[1] + 1, 4.0)
    for stage, field in CORRECTION_STAGES.items():
        error = 100 * (getattr(applied, field) - ranges.truth_m)
        inside = np.clip(error, edges[0] + 0.1, edges[-1] - 0.1)
        axes.hist(inside, edges.tolist(), histtype="step", lw=1.8, color=COLOURS[stage], label=LABELS[stage])
    ticks = np.arange(HISTOGRAM_CM[0], HISTOGRAM_CM[1] + 1, 20)
    names = [f"{t:.0f}" for t in ticks]
    names[0], names[-1] = f"≤ {names[0]}", f"≥ {names[-1]}"
    axes.set_xticks(ticks, names)
    label(axes, "range error (cm)", "exchanges")
    axes.legend(frameon=False)
    return axes


def bias_over_power(
    ranges: Ranges, applied: CorrectedRanges, calibration: Calibration, axes: Axes | None = None
) -> Axes:
    """Median error after delay correction over lifted power: every pair, all, fitted, planted."""
    error = 100 * (applied.delay_corrected_m - ranges.truth_m)
    axes = _over_power(axes or new_axes(), ranges, applied, error, np.median)
    grid = np.linspace(*calibration.bias_curve.range, 300)
    _band(axes, grid, 100 * calibration.bias_curve(grid), calibration.band(grid, "bias"))
    axes.plot(grid, 100 * calibration.bias_curve(grid), color=COLOURS["full"], lw=2.2, label="fitted")
    planted = planted_curve(ranges, "bias_curve", grid)
    if planted is not None:
        beside = beside_planted(ranges, applied, calibration)
        shift = beside.shift_ns * 1e-9 * SPEED_OF_LIGHT if beside else 0.0
        axes.plot(grid, 100 * (planted + shift), "--", color=COLOURS["planted"], lw=2.2, label="planted")
    label(axes, "lifted first-path power", "bias (cm)")
    axes.legend(frameon=False)
    return axes


def sigma_over_power(
    ranges: Ranges, applied: CorrectedRanges, calibration: Calibration, axes: Axes | None = None
) -> Axes:
    """Robust standard deviation of calibrated errors over lifted power, likewise."""
    error = 100 * (applied.corrected_m - ranges.truth_m)
    axes = _over_power(axes or new_axes(), ranges, applied, error, robust_spread)
    grid = np.linspace(*calibration.sigma_curve.range, 300)
    _band(axes, grid, 100 * calibration.sigma_curve(grid), calibration.band(grid, "sigma"))
    axes.plot(grid, 100 * calibration.sigma_curve(grid), color=COLOURS["full"], lw=2.2, label="fitted")
    planted = planted_curve(ranges, "sigma_curve", grid)
    if planted is not None:
        axes.plot(grid, 100 * planted, "--", color=COLOURS["planted"], lw=2.2, label="planted")
    axes.set_ylim(bottom=0)
    label(axes, "lifted first-path power", "standard deviation (cm)")
    axes.legend(frameon=False)
    return axes


def _over_power(axes: Axes, ranges: Ranges, applied: CorrectedRanges, values: Floats, summary: Any) -> Axes:
    for rows in pair_rows(ranges).values():
        axes.plot(*_binned(applied.lifted[rows], values[rows], summary), color="0.75", lw=0.9)
    axes.plot([], [], color="0.75", lw=0.9, label="each pair")
    everything = _binned(applied.lifted, values, summary)
    axes.plot(*everything, "o", color="0.2", ms=4, label="all pairs")
    return axes


def _band(axes: Axes, grid: Floats, middle: Floats, std_m: Floats | None) -> None:
    if std_m is not None:
        axes.fill_between(
            grid, middle - 196 * std_m, middle + 196 * std_m, color=COLOURS["full"], alpha=0.25, lw=0, label="95 % band"
        )


def _binned(x: Floats, y: Floats, summary: Any) -> tuple[Floats, Floats]:
    groups = np.array_split(np.argsort(x), max(1, min(BINS, len(x) // 20)))
    return (
        np.array([np.median(x[rows]) for rows in groups]),
        np.array([summary(y[rows]) for rows in groups]),
    )


def delays(
    calibration: Calibration,
    planted_ns: Mapping[int, float] | None = None,
    shift_ns: float = 0.0,
    axes: Axes | None = None,
) -> Axes:
    """Delays in ns with 95 % intervals; planted ones, if known, beside them, moved by the common shift."""
    axes = axes or new_axes()
    tags = sorted(calibration.delays_ns)
    place = np.arange(len(tags))
    values = np.array([calibration.delays_ns[tag] for tag in tags])
    std = np.array([calibration.delays_std_ns.get(tag, np.nan) for tag in tags])
    bars = np.where(np.isfinite(std), TWO_SIDED_95 * std, 0.0)
    axes.errorbar(place, values, bars, fmt="o", ms=5, capsize=4, color=COLOURS["full"], label="fitted, 95 % interval")
    if planted_ns:
        known = [planted_ns.get(tag, np.nan) + shift_ns for tag in tags]
        axes.plot(place, known, "x", ms=8, mew=2, color=COLOURS["planted"], label="planted, moved by the common shift")
    axes.axhline(0, color="0.7", lw=0.8, zorder=0)
    axes.set_xticks(place, [str(tag) for tag in tags])
    axes.margins(x=0.08)
    label(axes, "tag", "antenna delay (ns)")
    axes.legend(frameon=False)
    return axes


def new_axes() -> Axes:
    """Return the axes of a new figure, which pyplot shows and closes."""
    from matplotlib import pyplot

    return pyplot.subplots(figsize=WIDE, layout="constrained")[1]


def alone(draw: Callable[[Axes], Axes], size: tuple[float, float] = WIDE) -> Figure:
    """Return a figure of its own, for a page, with what is drawn into its axes."""
    figure = Figure(figsize=size, layout="constrained")
    draw(figure.subplots())
    return figure


def label(axes: Axes, x: str, y: str) -> None:
    """Name the axes, and take away what carries nothing."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
