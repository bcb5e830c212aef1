"""Figures of a fit: delays with their intervals, and how they depend on the scale of the loss."""

from __future__ import annotations

from typing import Final

import numpy as np
from matplotlib.figure import Figure

from calib.calibration.model import Calibration
from calib.report.figures import COLOURS, label

TWO_SIDED_95: Final = 1.959963984540054
SIZE: Final = (8.0, 3.4)


def delays(calibration: Calibration, planted_ns: dict[int, float], shift_ns: float) -> Figure:
    """Delays with 95 % intervals; planted ones beside them, moved by the common shift."""
    figure = Figure(figsize=SIZE, layout="constrained")
    axes = figure.subplots()
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
    return figure


def scale_sensitivity(scales_ns: list[float], fits: list[Calibration], chosen_ns: float) -> Figure:
    """How far each delay moves, about the mean of all, as the scale of the loss changes."""
    figure = Figure(figsize=SIZE, layout="constrained")
    axes = figure.subplots()
    tags = sorted(fits[0].delays_ns)
    table = np.array([[fit.delays_ns[tag] for tag in tags] for fit in fits])
    table -= table.mean(axis=1, keepdims=True)
    reference = table[int(np.argmin(np.abs(np.log(np.array(scales_ns) / chosen_ns))))]
    for k, tag in enumerate(tags):
        axes.plot(scales_ns, 1e3 * (table[:, k] - reference[k]), "o-", ms=3.5, lw=1.3, label=f"tag {tag}")
    axes.axvline(chosen_ns, color="0.5", ls="--", lw=1)
    axes.text(
        chosen_ns, 0.98, " chosen", transform=axes.get_xaxis_transform(), va="top", fontsize="small", color="0.35"
    )
    axes.set_xscale("log")
    axes.set_xticks(scales_ns, [f"{scale:.3g}" for scale in scales_ns])
    axes.set_xticks([], minor=True)
    label(axes, "scale of the loss (ns of flight)", "change of the delay (ps)")
    axes.legend(frameon=False, fontsize="small", ncols=2)
    return figure
