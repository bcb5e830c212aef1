"""The figures of a calibration: histogram, curves over power, errors over time, delays."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
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


def histogram(ranges: Ranges, applied: CorrectedRanges) -> Figure:
    """Range errors in the three stages; the outermost bins hold everything beyond them."""
    figure = Figure(figsize=WIDE, layout="constrained")
    axes = figure.subplots()
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
    return figure


def bias_over_power(ranges: Ranges, applied: CorrectedRanges, calibration: Calibration) -> Figure:
    """Median error after delay correction over lifted power: every pair, all, fitted, planted."""
    error = 100 * (applied.delay_corrected_m - ranges.truth_m)
    figure = _over_power(ranges, applied, error, np.median)
    axes = figure.axes[0]
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
    return figure


def sigma_over_power(ranges: Ranges, applied: CorrectedRanges, calibration: Calibration) -> Figure:
    """Robust standard deviation of calibrated errors over lifted power, likewise."""
    error = 100 * (applied.corrected_m - ranges.truth_m)
    figure = _over_power(ranges, applied, error, robust_spread)
    axes = figure.axes[0]
    grid = np.linspace(*calibration.sigma_curve.range, 300)
    _band(axes, grid, 100 * calibration.sigma_curve(grid), calibration.band(grid, "sigma"))
    axes.plot(grid, 100 * calibration.sigma_curve(grid), color=COLOURS["full"], lw=2.2, label="fitted")
    planted = planted_curve(ranges, "sigma_curve", grid)
    if planted is not None:
        axes.plot(grid, 100 * planted, "--", color=COLOURS["planted"], lw=2.2, label="planted")
    axes.set_ylim(bottom=0)
    label(axes, "lifted first-path power", "standard deviation (cm)")
    axes.legend(frameon=False)
    return figure


def over_time(ranges: Ranges, applied: CorrectedRanges) -> Figure:
    """Calibrated error of each pair over time, with the band in which 95 % should lie."""
    pairs = pair_rows(ranges)
    rows_of_panels = int(np.ceil(len(pairs) / 3))
    figure = Figure(figsize=(10, 1.9 * rows_of_panels + 0.4), layout="constrained")
    panels = figure.subplots(rows_of_panels, 3, sharex=True, sharey=True, squeeze=False).flat
    start = ranges.time_ns.min()
    for panel, (name, rows) in zip(panels, pairs.items(), strict=False):
        time = (ranges.time_ns[rows] - start) * 1e-9
        order = np.argsort(time)
        error = 100 * (applied.corrected_m - ranges.truth_m)[rows]
        panel.plot(time, error, ".", ms=1.5, color=COLOURS["full"], alpha=0.5, rasterized=True)
        band = 196 * applied.sigma_m[rows][order]
        panel.fill_between(time[order], -band, band, color="0.6", alpha=0.45, lw=0, rasterized=True)
        panel.set_title(f"tags {name}", fontsize="small", loc="left")
        panel.set_ylim(-60, 60)
        panel.grid(alpha=0.25)
    for panel in list(panels)[len(pairs) :]:
        panel.set_visible(False)
    figure.supxlabel("time (s)")
    figure.supylabel("calibrated error (cm)")
    return figure


def _over_power(ranges: Ranges, applied: CorrectedRanges, values: Floats, summary: Any) -> Figure:
    figure = Figure(figsize=WIDE, layout="constrained")
    axes = figure.subplots()
    for rows in pair_rows(ranges).values():
        axes.plot(*_binned(applied.lifted[rows], values[rows], summary), color="0.75", lw=0.9)
    axes.plot([], [], color="0.75", lw=0.9, label="each pair")
    everything = _binned(applied.lifted, values, summary)
    axes.plot(*everything, "o", color="0.2", ms=4, label="all pairs")
    return figure


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


def label(axes: Axes, x: str, y: str) -> None:
    """Name the axes, and take away what carries nothing."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
