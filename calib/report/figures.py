"""Figures of localization and of plans, at a width in inches."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calib.evaluation.localization import Localization, summarize
from calib.evaluation.onboard import OnboardTrack
from calib.planning.result import FlightPlan, NextBest, Plan, PlannedArrangement
from uwblink.pages.colours import BLUE, GREY, INK, MUTED, VERMILION, WINE, look
from uwblink.pages.figures import NARROW_IN, label, legend, mark, sheet

FILTER_NAMES: Final = {
    "raw": "raw",
    "calibrated": "calibrated",
    "variance": "calibrated, with variance",
    "robust": "reckoning with reflections",
}
FILTER_LINES: Final[dict[str, tuple[str, Any, str]]] = {
    "raw": (VERMILION, (0, (1.5, 1.2)), ""),
    "calibrated": (WINE, (0, (5, 1.5)), "////"),
    "variance": (BLUE, "-", ""),
    "robust": (GREY, (0, (6, 1.5, 1.5, 1.5)), "xxxx"),
}
"""Colour, dashes and hatches of each filter."""

SAMPLES: Final = 700
"""Points of a track that are drawn: more than the width of a page shows."""


def rmse_bars(width_in: float, found: list[Localization]) -> Figure:
    """Draw the RMSE of each body in each recording over seeds, and their mean."""
    most = 5 if width_in < NARROW_IN else 9
    shown = sorted(found, key=lambda one: -float(one.rmse_m["raw"].mean()))[:most] if len(found) > most else found
    figure, (axes,) = sheet(width_in, height_in=2.7)
    names = [f"{one.source.removesuffix('.uwb')}\n{one.body}" for one in shown] + ["mean"]
    mean = summarize(found).rmse_m
    for k, stage in enumerate(mean):
        colour, _, hatch = FILTER_LINES[stage]
        heights = [float(one.rmse_m[stage].mean()) for one in shown] + [mean[stage]]
        place = np.arange(len(names)) + 0.21 * (k - (len(mean) - 1) / 2)
        axes.bar(place, heights, 0.19, color=colour, hatch=hatch, ec="white", lw=0, label=FILTER_NAMES[stage])
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
    """Draw true and estimated paths from above, their heights, and the size of the error over time, by filter."""
    last, narrow = one.tracks["variance"], width_in < NARROW_IN
    every = slice(None, None, max(1, len(last.time_ns) // SAMPLES))
    time, truth = (last.time_ns - last.time_ns[0])[every] * 1e-9, last.truth_m[every]
    figure = Figure(figsize=(width_in, 6.0 if narrow else 3.8), layout="constrained")
    places: Any = [["path"], ["height"], ["error"]] if narrow else [["path", "height"], ["error", "error"]]
    panels = figure.subplot_mosaic(places, height_ratios=[2.2, 1, 1.2] if narrow else [1.4, 1])
    for stage, of_stage in one.tracks.items():
        colour, dashes, _ = FILTER_LINES[stage]
        line: dict[str, Any] = {"color": colour, "ls": dashes, "lw": 0.9}
        estimate = of_stage.estimate_m[every]
        off = np.linalg.norm(estimate - of_stage.truth_m[every], axis=1)
        mark(panels["error"].plot(time, off, label=FILTER_NAMES[stage], **line)[0], FILTER_NAMES[stage])
        if stage in ("raw", "variance"):
            panels["path"].plot(estimate[:, 0], estimate[:, 1], **line)
            panels["height"].plot(time, estimate[:, 2], **line)
    panels["path"].plot(truth[:, 0], truth[:, 1], lw=0.9, color=INK)
    panels["height"].plot(time, truth[:, 2], lw=0.9, color=INK)
    panels["error"].plot([], [], color=INK, lw=0.9, label="true")
    panels["error"].plot(time, 3 * last.std_m[every], color=MUTED, lw=0.8, ls="--", label="3 σ, by the filter itself")
    # The axis leaves out the few errors at the start and those of a diverged filter.
    usual = [np.quantile(np.linalg.norm(t.estimate_m - t.truth_m, axis=1), 0.995) for t in one.tracks.values()]
    middle, sigmas = float(np.median(usual)), float(np.quantile(3 * last.std_m, 0.9))
    panels["error"].set_ylim(0, 1.15 * max(1.5 * middle, *(float(u) for u in usual if u < 5 * middle), sigmas))
    panels["path"].set_aspect("equal", adjustable="datalim")
    label(panels["path"], "east (m)", "north (m)")
    label(panels["height"], "time (s)", "up (m)")
    label(panels["error"], "time (s)", "position error (m)")
    legend(figure, panels["error"])
    return figure


def onboard(width_in: float, one: OnboardTrack) -> Figure:
    """Draw the path from above and the height over time, with the truth if poses give it."""
    figure, (path, height) = sheet(width_in, 2, height_in=2.8)
    every = slice(None, None, max(1, len(one.time_ns) // SAMPLES))
    time = (one.time_ns - one.time_ns[0])[every] * 1e-9
    for place, colour, dashes, name in (
        (one.truth_m, INK, "-", "true"),
        (one.estimate_m, BLUE, (0, (5, 1.5)), one.used),
    ):
        if np.isfinite(place).any():
            mark(path.plot(place[every, 0], place[every, 1], color=colour, ls=dashes, lw=1, label=name)[0], name)
            height.plot(time, place[every, 2], color=colour, ls=dashes, lw=1)
    path.set_aspect("equal", adjustable="datalim")
    label(path, "east (m)", "north (m)")
    label(height, "time (s)", "up (m)")
    legend(figure, path)
    return figure


def arrangement(width_in: float, plan: Plan, number: int) -> Figure:
    """Draw the boards of an arrangement, with tapes and the intervals after it.

    Boards are seen from above, and in space from the side as well.
    """
    on_line, one = plan.on == "line", plan.arrangements[number]
    figure, panels = sheet(width_in, 3 if plan.on == "" else 2, height_in=1.5 if on_line else 2.7)
    for axes, height in zip(panels[:-1], (1, 2), strict=False):
        _boards(axes, one, height, on_line=on_line)
    panels[0].set_title(f"Step {number + 1}: arrangement {one.name}", loc="left")
    _intervals(panels[-1], plan.after_ns[number], plan.after_ns[number - 1] if number else {})
    if one.taped:
        panels[-1].plot([], [], "--", color=VERMILION, label="distance to tape")
    legend(figure, panels[-1])
    return figure


def _boards(axes: Axes, one: PlannedArrangement, height: int, *, on_line: bool) -> None:
    """Draw boards by x and by their coordinate `height` (y from above, z from the side), and tapes between them."""
    for tag, place in one.place_m.items():
        axes.plot(place[0], place[height], "o", ms=12, color="white", mec=BLUE, mew=1.2, zorder=3)
        axes.annotate(str(tag), (place[0], place[height]), ha="center", va="center", color=INK, zorder=4)
    label(axes, "x (m)", "y (m)" if height == 1 else "height (m)")
    axes.margins(0.14)
    axes.set_aspect("equal", adjustable="datalim")
    for i, j in one.taped:
        # From left to right, so that all tapes bow upwards.
        first, second = sorted((one.place_m[tag][0], one.place_m[tag][height]) for tag in (i, j))
        bow = f"arc3,rad={-0.25 if on_line else 0}"
        style: dict[str, Any] = {"arrowstyle": "<->", "color": VERMILION, "ls": "--", "shrinkA": 7, "shrinkB": 7}
        axes.annotate("", second, xytext=first, arrowprops=style | {"connectionstyle": bow}, zorder=2)
    if on_line:
        xs = sorted(place[0] for place in one.place_m.values())
        axes.set_aspect("auto")
        axes.plot([xs[0], xs[-1]], [0, 0], color=MUTED, lw=1.0, zorder=1)
        axes.set_ylim(-0.6, 0.9)
        axes.set_yticks([])
        axes.set_xticks(xs)
        axes.spines["left"].set_visible(False)
        label(axes, "along the string (m)", "")
        axes.grid(visible=False)


def _intervals(
    axes: Axes,
    after: Mapping[int, float],
    before: Mapping[int, float],
    names: tuple[str, str] = ("after this arrangement", "before it"),
) -> None:
    """Draw half intervals by tag as bars, and others as outlines; undetermined ones are marked as open."""
    tags = list(after)
    rows = np.arange(len(tags))
    top = max((value for value in [*after.values(), *before.values()] if math.isfinite(value)), default=1.0)
    bars: Any = ((before, names[1], 0.8, "none", MUTED), (after, names[0], 0.5, BLUE, BLUE))
    for values, text, width, face, edge in bars:
        shown = np.array([values.get(tag, math.nan) for tag in tags])
        shown[~np.isfinite(shown)] = np.nan
        if not np.isnan(shown).all():
            axes.bar(rows, shown, width, label=text, facecolor=face, edgecolor=edge, lw=0.8)
    for row, tag in zip(rows.tolist(), tags, strict=True):
        if not math.isfinite(after[tag]):
            turned = 90 if len(tags) > 5 else 0
            axes.annotate("open", (row, 0.02 * top), ha="center", va="bottom", color=VERMILION, rotation=turned)
    axes.set_xticks(rows, [str(tag) for tag in tags])
    axes.set_xlim(-0.6, len(tags) - 0.4)
    axes.set_ylim(0, 1.08 * top)
    label(axes, "tag", "± ns (95 %)")
    axes.grid(visible=False, axis="x")


def more(width_in: float, next_best: tuple[NextBest, ...]) -> Figure:
    """Draw the mean interval of the plan, and with each further measurement."""
    letters = 26 if width_in < NARROW_IN else 60
    texts = ["as planned", *("+ " + textwrap.shorten(best.what, 3 * letters) for best in next_best)]
    texts = [textwrap.fill(text, letters) for text in texts]
    values = [next_best[0].instead_of_ns, *(best.mean_ns for best in next_best)]
    lines = sum(text.count("\n") + 1 for text in texts)
    figure, (axes,) = sheet(width_in, height_in=0.7 + max(0.34 * len(texts), 0.16 * lines + 0.1 * len(texts)))
    rows = np.arange(len(texts))
    axes.barh(rows, values, 0.6, color=[MUTED, *[BLUE] * len(next_best)])
    for row, value in zip(rows.tolist(), values, strict=True):
        axes.annotate(f"{value:.3f}", (value, row), xytext=(4, 0), textcoords="offset points", va="center")
    axes.set_yticks(rows, texts)
    axes.invert_yaxis()
    axes.set_xlim(0, (1.18 if width_in > NARROW_IN else 1.35) * max(values))
    label(axes, "± ns (95 %), mean", "")
    axes.grid(visible=False, axis="y")
    return figure


def planned_delays(width_in: float, plan: FlightPlan) -> Figure:
    """Draw the interval of each delay, and the prior interval of undetermined ones."""
    figure, (axes,) = sheet(width_in, height_in=2.2)
    left_open = {tag: math.nan if math.isfinite(half) else plan.open_ns[tag] for tag, half in plan.half_ns.items()}
    _intervals(axes, plan.half_ns, left_open, ("determined", "stays open"))
    legend(figure)
    return figure


def flight(width_in: float, plan: FlightPlan) -> Figure:
    """Draw the paths of bodies from above and in height over time; thick while their positions are known."""
    figure, (above, height) = sheet(width_in, 2, height_in=2.9)
    time = np.linspace(0, plan.seconds, len(plan.path_m))
    early = time <= (plan.seconds if plan.settings.poses_until_s is None else plan.settings.poses_until_s)
    for k, body in enumerate(plan.bodies):
        own = look(k)
        x, y, z = plan.path_m[:, k].T
        above.plot(x, y, color=own.colour, lw=0.8, label=body, ls=own.dashes)
        above.plot(x[early], y[early], color=own.colour, lw=2.6)
        height.plot(time, z, color=own.colour, lw=0.8, ls=own.dashes)
        height.plot(time[early], z[early], color=own.colour, lw=2.6)
    for name, (x, y, _) in plan.stands.items():
        above.plot(x, y, "s", ms=5, color=INK)
        above.annotate(name, (x, y), xytext=(0, 6), textcoords="offset points", ha="center", color=MUTED)
    above.set_aspect("equal", adjustable="datalim")
    above.margins(0.08)
    label(above, "x (m)", "y (m)")
    label(height, "time (s)", "height (m)")
    legend(figure, above)
    return figure
