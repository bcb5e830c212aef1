"""Figures of localization: error over time, trajectories from above, and RMSE as bars."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from calib.evaluation.consistency import summarize
from calib.evaluation.tracking import Localization
from uwblink.arrays import Floats
from uwblink.pages.colours import BLUE, GREY, INK, MUTED, VERMILION, WINE
from uwblink.pages.figures import NARROW_IN, label, legend, mark

COLOUR_OF: Final = {"raw": VERMILION, "calibrated": WINE, "variance": BLUE, "robust": GREY}
DASHES_OF: Final[dict[str, Any]] = {
    "raw": (0, (1.5, 1.2)),
    "calibrated": (0, (5, 1.5)),
    "variance": "-",
    "robust": (0, (6, 1.5, 1.5, 1.5)),
}
HATCHES: Final = {"raw": "", "calibrated": "////", "variance": "", "robust": "xxxx"}
NAMES: Final = {
    "raw": "raw",
    "calibrated": "calibrated",
    "variance": "calibrated, with variance",
    "robust": "reckoning with reflections",
}
MOST_BARS: Final = 9
"""Bodies with bars of their own in a page's width; of more only the mean is drawn beside the largest."""

SAMPLES: Final = 700
"""Instants of a track that are drawn."""


def rmse_bars(width_in: float, found: list[Localization]) -> Figure:
    """RMSE of each body in each recording over seeds, and their mean."""
    most = 5 if width_in < NARROW_IN else MOST_BARS
    shown = sorted(found, key=lambda one: -float(one.rmse_m["raw"].mean()))[:most] if len(found) > most else found
    figure = Figure(figsize=(width_in, 2.7), layout="constrained")
    axes = figure.subplots()
    names = [f"{one.source.removesuffix('.uwb')}\n{one.body}" for one in shown] + ["mean"]
    mean = summarize(found).rmse_m
    for k, stage in enumerate(mean):
        heights = [float(one.rmse_m[stage].mean()) for one in shown] + [mean[stage]]
        place = np.arange(len(names)) + 0.21 * (k - (len(mean) - 1) / 2)
        axes.bar(
            place, heights, 0.19, color=COLOUR_OF[stage], hatch=HATCHES[stage], ec="white", lw=0, label=NAMES[stage]
        )
    highest = np.sort([float(one.rmse_m[stage].mean()) for one in shown for stage in mean])
    usual = float(np.quantile(highest, 0.9))
    if highest[-1] > 4 * usual:
        axes.set_ylim(0, 2.5 * usual)
        axes.text(0.99, 0.97, f"highest bar: {highest[-1]:.2f} m", transform=axes.transAxes, ha="right", va="top")
    axes.set_xticks(np.arange(len(names)), names)
    left = f"{len(shown)} of {len(found)} bodies, those with the largest errors"
    label(axes, left if len(shown) < len(found) else "", "RMSE of the position (m)")
    axes.grid(False, axis="x")
    legend(figure)
    return figure


def track(width_in: float, one: Localization) -> Figure:
    """True and estimated paths from above, their heights and the size of the error over time, by filter."""
    last = one.tracks["variance"]
    every = slice(None, None, max(1, len(last.time_ns) // SAMPLES))
    time, truth = (last.time_ns - last.time_ns[0])[every] * 1e-9, last.truth_m[every]
    figure = Figure(figsize=(width_in, 6.0 if width_in < NARROW_IN else 3.8), layout="constrained")
    places: Any = (
        [["path"], ["height"], ["error"]] if width_in < NARROW_IN else [["path", "height"], ["error", "error"]]
    )
    ratios = [2.2, 1, 1.2] if width_in < NARROW_IN else [1.4, 1]
    panels = figure.subplot_mosaic(places, height_ratios=ratios)
    for stage, of_stage in one.tracks.items():
        line = {"color": COLOUR_OF[stage], "ls": DASHES_OF[stage], "lw": 0.9}
        estimate = of_stage.estimate_m[every]
        (wrong,) = panels["error"].plot(
            time, np.linalg.norm(estimate - of_stage.truth_m[every], axis=1), label=NAMES[stage], **line
        )
        mark(wrong, NAMES[stage])
        if stage in ("raw", "variance"):
            panels["path"].plot(estimate[:, 0], estimate[:, 1], **line)
            panels["height"].plot(time, estimate[:, 2], **line)
    panels["path"].plot(truth[:, 0], truth[:, 1], lw=0.9, color=INK)
    panels["height"].plot(time, truth[:, 2], lw=0.9, color=INK)
    panels["error"].plot([], [], color=INK, lw=0.9, label="true")
    panels["error"].plot(time, 3 * last.std_m[every], color=MUTED, lw=0.8, ls="--", label="3 σ, by the filter itself")
    panels["error"].set_ylim(0, _highest(one, 3 * last.std_m))
    panels["path"].set_aspect("equal", adjustable="datalim")
    label(panels["path"], "east (m)", "north (m)")
    label(panels["height"], "time (s)", "up (m)")
    label(panels["error"], "time (s)", "position error (m)")
    legend(figure, panels["error"])
    return figure


def _highest(one: Localization, sigmas: Floats) -> float:
    """Return up to where errors are drawn: beyond all but the few at the start or of a filter gone astray."""
    usual = [np.quantile(np.linalg.norm(t.estimate_m - t.truth_m, axis=1), 0.995) for t in one.tracks.values()]
    return 1.15 * float(max(np.median(usual) * 1.5, *(u for u in usual if u < 5 * np.median(usual)),
                            np.quantile(sigmas, 0.9)))  # fmt: skip
