"""Figures of calibrated errors: are they what their variance says, and do they depend on anything?"""

from __future__ import annotations

from statistics import NormalDist
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from calib.calibration.parts import CorrectedRanges
from calib.data.ranges import Ranges
from calib.evaluation.statistics import pair_rows
from calib.figures import cumulative, histogram
from uwblink.arrays import Floats, Ints
from uwblink.pages.colours import BLUE, INK, MUTED, PALE
from uwblink.pages.figures import NARROW_IN, label, legend, sheet

REACH: Final = 6.0
POINTS: Final = 3000
"""A scatter of more points shows nothing more."""

MOST_PAIRS: Final = 24
"""Pairs whose errors are drawn over time, those with the largest spread; more would be too small to see."""

POINTS_OF_PAIR: Final = 800
PANEL_IN: Final = 1.05


def distribution(width_in: float, ranges: Ranges, applied: CorrectedRanges) -> Figure:
    """Errors in the three stages: shares by size and sign, and how many are smaller than so much."""
    figure, (left, right) = sheet(width_in, 2)
    histogram(ranges, applied, left)
    cumulative(ranges, applied, right)
    _one_legend(figure)
    return figure


def z_scores(width_in: float, ranges: Ranges, applied: CorrectedRanges) -> Figure:
    """Errors over their sigma: a histogram beside the normal density, and quantiles against normal quantiles."""
    z = (applied.corrected_m - ranges.truth_m) / applied.sigma_m
    figure, (left, right) = sheet(width_in, 2)
    edges = np.linspace(-REACH, REACH, 61)
    inside = np.clip(z, edges[0], edges[-1] - 1e-9)
    density = np.histogram(inside, edges)[0] / len(z) / (edges[1] - edges[0])
    left.stairs(density, edges, fill=True, color=BLUE, alpha=0.55, label="ranges")
    grid = np.linspace(-REACH, REACH, 200)
    left.plot(grid, np.exp(-0.5 * grid**2) / np.sqrt(2 * np.pi), color=INK, lw=1.2, label="standard normal")
    label(left, "error over its σ; all beyond ±6 in the last bins", "density")
    shares = (np.arange(300) + 0.5) / 300
    normal = [NormalDist().inv_cdf(share) for share in shares.tolist()]
    right.plot(normal, np.clip(np.quantile(z, shares), -REACH, 2 * REACH), ".", ms=3, color=BLUE)
    right.plot([-3, 3], [-3, 3], color=INK, lw=1.2)
    right.set_ylim(-REACH, 2 * REACH)
    label(right, "quantile of the standard normal", "quantile of error over σ")
    legend(figure, left)
    return figure


def residuals(width_in: float, ranges: Ranges, applied: CorrectedRanges, alpha_dbm: float) -> Figure:
    """Calibrated errors over distance and over the mean first-path power, with medians and the middle 68 %."""
    figure, panels = sheet(width_in, 2, sharey=True)
    error = 100 * (applied.corrected_m - ranges.truth_m)
    power = 10 * np.log10(np.maximum(applied.lifted, 1e-9)) + alpha_dbm
    for panel, x, name in zip(
        panels, (ranges.truth_m, power), ("true distance (m)", "lifted power, in dBm"), strict=True
    ):
        every = slice(None, None, max(len(x) // POINTS, 1))
        panel.plot(x[every], error[every], ".", ms=1.2, color=PALE, rasterized=True, zorder=0)
        groups = np.array_split(np.argsort(x), max(1, min(16, len(x) // 40)))
        middle = [float(np.median(x[rows])) for rows in groups]
        low, median, high = np.array([np.quantile(error[rows], (0.16, 0.5, 0.84)) for rows in groups]).T
        panel.fill_between(middle, low, high, color=BLUE, alpha=0.25, lw=0, label="middle 68 %")
        panel.plot(middle, median, "o-", ms=2.8, color=BLUE, label="median")
        panel.axhline(0, color=MUTED, lw=0.7)
        low_x, high_x = np.quantile(x, (0.001, 0.999))
        panel.set_xlim(low_x - 0.03 * (high_x - low_x) - 1e-6, high_x + 0.03 * (high_x - low_x) + 1e-6)
        panel.locator_params(
            axis="x", nbins=7, steps=[1, 2, 5, 10]
        )  # of -97.5 dBm there is room for fewer than by default
        label(panel, name, "calibrated error (cm)" if panel is panels[0] or width_in < NARROW_IN else "")
    panels[0].set_ylim(*_reach_cm(error))
    legend(figure, panels[0])
    return figure


def over_time(width_in: float, ranges: Ranges, applied: CorrectedRanges) -> Figure:
    """Calibrated error of each pair over time, with the band in which 95 % should lie."""
    error = 100 * (applied.corrected_m - ranges.truth_m)
    pairs = most_spread(ranges, error)
    columns = 2 if width_in < NARROW_IN else 4
    time = (ranges.time_ns - ranges.time_ns.min()) * 1e-9
    rows = -(-len(pairs) // columns)
    figure = Figure(figsize=(width_in, PANEL_IN * rows + 0.6), layout="constrained")
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for panel, (name, own) in zip(panels, pairs.items(), strict=False):
        order = own[np.argsort(time[own])]
        shown, some = order[:: max(1, len(order) // POINTS_OF_PAIR)], order[:: max(1, len(order) // 120)]
        panel.plot(time[shown], error[shown], ".", ms=1.3, color=BLUE, alpha=0.6, rasterized=True)
        for side in (-196, 196):
            panel.plot(time[some], side * applied.sigma_m[some], color=INK, lw=0.6)
        panel.set_title(f"tags {name}", loc="left", pad=2)
        label(panel, "", "")
    for panel in panels[len(pairs) :]:
        panel.set_axis_off()
    panels[0].set_ylim(*_reach_cm(error))
    figure.supxlabel("time (s)", fontsize="medium")
    figure.supylabel("calibrated error (cm)", fontsize="medium")
    return figure


def most_spread(ranges: Ranges, error: Floats) -> dict[str, Ints]:
    """Return the rows of the pairs that are drawn over time: all, or of many those whose errors spread most."""
    pairs = {name: np.flatnonzero(rows) for name, rows in pair_rows(ranges).items()}
    if len(pairs) <= MOST_PAIRS:
        return pairs
    spread = {name: float(np.ptp(np.quantile(error[rows], (0.05, 0.95)))) for name, rows in pairs.items()}
    kept = set(sorted(pairs, key=lambda name: -spread[name])[:MOST_PAIRS])
    return {name: rows for name, rows in pairs.items() if name in kept}


def _reach_cm(error: Floats) -> tuple[float, float]:
    """Return from where to where errors in cm are drawn: all but the outermost hundredth."""
    low, high = np.quantile(error, (0.003, 0.985))
    margin = 0.1 * float(high - low) + 0.1
    return float(low) - margin, float(high) + margin


def _one_legend(figure: Figure) -> None:
    for axes in figure.axes:
        if own := axes.get_legend():
            own.remove()
    legend(figure)
