"""Figures of calibrated errors: are they what their variance says, and do they depend on anything?"""

from __future__ import annotations

from typing import Final

import numpy as np
from matplotlib.figure import Figure

from calib.calibration.model import CorrectedRanges
from calib.evaluation.statistics import pair_rows
from calib.figures import COLOURS, label
from calib.ranges import Ranges

SIZE: Final = (8.0, 3.6)
REACH: Final = 6.0
POINTS: Final = 6000
"""A scatter of more points shows nothing more."""


def z_scores(ranges: Ranges, applied: CorrectedRanges) -> Figure:
    """Errors over their sigma: a histogram beside the normal density, and quantiles against normal quantiles."""
    from scipy.stats import norm

    z = (applied.corrected_m - ranges.truth_m) / applied.sigma_m
    figure = Figure(figsize=SIZE, layout="constrained")
    left, right = figure.subplots(1, 2)
    edges = np.linspace(-REACH, REACH, 61)
    weights = np.full(len(z), 1 / len(z) / np.diff(edges)[0])
    inside = np.clip(z, edges[0], edges[-1] - 1e-9)
    left.hist(inside, edges.tolist(), weights=weights, color=COLOURS["full"], alpha=0.6, label="ranges")
    grid = np.linspace(-REACH, REACH, 300)
    left.plot(grid, norm.pdf(grid), color="0.2", lw=1.4, label="standard normal")
    label(left, "error / sigma", "density")
    left.legend(frameon=False, fontsize="small")
    shares = (np.arange(400) + 0.5) / 400
    right.plot(norm.ppf(shares), np.clip(np.quantile(z, shares), -REACH, 2 * REACH), ".", ms=3.5, color=COLOURS["full"])
    right.plot([-3, 3], [-3, 3], color="0.2", lw=1)
    right.set_ylim(-REACH, 2 * REACH)
    label(right, "quantile of the standard normal", "quantile of error / sigma")
    return figure


def residuals(ranges: Ranges, applied: CorrectedRanges, alpha_dbm: float) -> Figure:
    """Calibrated errors over distance and over the mean first-path power, with medians and the middle 68 %."""
    figure = Figure(figsize=SIZE, layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    error = 100 * (applied.corrected_m - ranges.truth_m)
    power = 10 * np.log10(np.maximum(applied.lifted, 1e-9)) + alpha_dbm
    for panel, x, name in zip(
        panels, (ranges.truth_m, power), ("true distance (m)", "lifted power (dBm)"), strict=True
    ):
        every = slice(None, None, max(len(x) // POINTS, 1))
        panel.plot(x[every], error[every], ".", ms=1.2, color="0.7", rasterized=True, zorder=0)
        groups = np.array_split(np.argsort(x), max(1, min(16, len(x) // 40)))
        middle = [float(np.median(x[rows])) for rows in groups]
        low, median, high = np.array([np.quantile(error[rows], (0.16, 0.5, 0.84)) for rows in groups]).T
        panel.fill_between(middle, low, high, color=COLOURS["full"], alpha=0.25, lw=0, label="middle 68 %")
        panel.plot(middle, median, "o-", ms=3.5, lw=1.4, color=COLOURS["full"], label="median")
        panel.axhline(0, color="0.3", lw=0.8)
        panel.set_ylim(-40, 60)
        label(panel, name, "calibrated error (cm)" if panel is panels[0] else "")
    panels[0].legend(frameon=False, fontsize="small")
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
