"""Figures of localization: error over time, trajectories from above, and RMSE as bars."""

from __future__ import annotations

from typing import Final

import numpy as np
from matplotlib.figure import Figure

from calib.evaluation.consistency import summarize
from calib.evaluation.tracking import Localization
from calib.figures import COLOURS, label

COLOUR_OF: Final = {
    "raw": COLOURS["raw"],
    "calibrated": COLOURS["delays"],
    "variance": COLOURS["full"],
    "robust": "0.45",
}
NAMES: Final = {
    "raw": "raw",
    "calibrated": "calibrated",
    "variance": "calibrated, with variance",
    "robust": "reckoning with reflections",
}


def rmse_bars(found: list[Localization]) -> Figure:
    """RMSE of each body in each recording over seeds, and their mean."""
    figure = Figure(figsize=(8.0, 3.4), layout="constrained")
    axes = figure.subplots()
    names = [f"{one.source.removesuffix('.uwb')}\n{one.body}" for one in found] + ["mean"]
    mean = summarize(found).rmse_m
    for k, stage in enumerate(mean):
        heights = [float(one.rmse_m[stage].mean()) for one in found] + [mean[stage]]
        axes.bar(np.arange(len(names)) + 0.21 * (k - 1.5), heights, 0.2, color=COLOUR_OF[stage], label=NAMES[stage])
    axes.set_xticks(np.arange(len(names)), names, fontsize="small")
    label(axes, "", "RMSE of the position (m)")
    figure.legend(*axes.get_legend_handles_labels(), frameon=False, fontsize="small", loc="outside upper left", ncols=4)
    return figure


def error_over_time(one: Localization) -> Figure:
    """Norm of the position error over time by filter, with three sigmas of the variance filter's own opinion."""
    figure = Figure(figsize=(8.0, 3.2), layout="constrained")
    axes = figure.subplots()
    for stage, track in one.tracks.items():
        time = (track.time_ns - track.time_ns[0]) * 1e-9
        wrong = np.linalg.norm(track.estimate_m - track.truth_m, axis=1)
        axes.plot(time, wrong, lw=0.9, color=COLOUR_OF[stage], label=NAMES[stage])
    last = one.tracks["variance"]
    time = (last.time_ns - last.time_ns[0]) * 1e-9
    axes.plot(time, 3 * last.std_m, color="0.35", lw=0.9, ls="--", label="its three sigmas")
    axes.set_ylim(bottom=0)
    label(axes, "time (s)", "position error (m)")
    axes.legend(frameon=False, fontsize="small", ncols=2)
    return figure


def trajectories(one: Localization) -> Figure:
    """True and estimated paths from above, and their heights over time."""
    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    above, height = figure.subplots(1, 2)
    truth = one.tracks["variance"].truth_m
    time = (one.tracks["variance"].time_ns - one.tracks["variance"].time_ns[0]) * 1e-9
    for stage in ("raw", "variance"):
        estimate = one.tracks[stage].estimate_m
        above.plot(estimate[:, 0], estimate[:, 1], lw=0.7, color=COLOUR_OF[stage], label=NAMES[stage])
        height.plot(time, estimate[:, 2], lw=0.7, color=COLOUR_OF[stage])
    above.plot(truth[:, 0], truth[:, 1], lw=1.2, color="0.15", label="true")
    height.plot(time, truth[:, 2], lw=1.2, color="0.15")
    above.set_aspect("equal", adjustable="datalim")
    label(above, "east (m)", "north (m)")
    label(height, "time (s)", "up (m)")
    # Below the panels: a path may run anywhere inside them.
    figure.legend(*above.get_legend_handles_labels(), frameon=False, loc="outside lower center", ncols=3)
    return figure
