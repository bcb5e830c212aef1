"""Figures of localization and of plans; each function returns a figure of a width in inches."""

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
from uwblink.arrays import Floats
from uwblink.pages.colours import BLUE, GREY, INK, MUTED, VERMILION, WINE, look
from uwblink.pages.figures import NARROW_IN, label, legend, mark, series, sheet

FILTER_STYLES: Final[dict[str, tuple[str, str, Any, str]]] = {
    "raw": ("raw", VERMILION, (0, (1.5, 1.2)), ""),
    "calibrated": ("calibrated", WINE, (0, (5, 1.5)), "////"),
    "variance": ("calibrated, with variance", BLUE, "-", ""),
    "robust": ("calibrated, with reflections", GREY, (0, (6, 1.5, 1.5, 1.5)), "xxxx"),
    "online": ("delays as states", MUTED, (0, (3, 1.0)), "...."),
}
"""Name, colour, dashes and hatches of each filter."""

SAMPLES: Final = 700
"""Largest number of points of a track that are drawn, about one per pixel of a page's width."""


def rmse_bars(width_in: float, found: list[Localization]) -> Figure:
    """Draw the RMSE of each body in each recording as the mean over seeds, and the mean over all bodies."""
    most, mean = 5 if width_in < NARROW_IN else 9, summarize(found).rmse_m
    shown = sorted(found, key=lambda one: -float(one.rmse_m["raw"].mean()))[:most] if len(found) > most else found
    figure, (axes,) = sheet(width_in, height_in=2.7)
    names = [f"{one.source.removesuffix('.uwb')}\n{one.body}" for one in shown] + ["mean"]
    heights = {stage: [float(one.rmse_m[stage].mean()) for one in shown] + [mean[stage]] for stage in mean}
    for k, (stage, own) in enumerate(heights.items()):
        name, colour, _, hatch = FILTER_STYLES[stage]
        place = np.arange(len(names)) + 0.84 * ((k + 0.5) / len(mean) - 0.5)
        axes.bar(place, own, 0.76 / len(mean), color=colour, hatch=hatch, ec="white", lw=0, label=name)
    every = np.concatenate(list(heights.values()))
    # Cut off the bar of a filter that diverged.
    if every.max() > 4 * np.quantile(every, 0.9):
        axes.set_ylim(0, 2.5 * np.quantile(every, 0.9))
        axes.text(0.99, 0.97, f"highest bar: {every.max():.2f} m", transform=axes.transAxes, ha="right", va="top")
    axes.set_xticks(np.arange(len(names)), names)
    left = f"{len(shown)} of {len(found)} bodies, those with the largest errors"
    label(axes, left if len(shown) < len(found) else "", "RMSE of the position (m)")
    axes.grid(False, axis="x")
    legend(figure)
    return figure


def _draw_path(above: Axes, height: Axes, time: Floats, path_m: Floats, **line: Any) -> None:
    """Draw a path (n, 3) from above, and its height over time."""
    (path,) = above.plot(path_m[:, 0], path_m[:, 1], **line)
    height.plot(time, path_m[:, 2], **line)
    if "label" in line:
        mark(path, line["label"])


def _label_paths(above: Axes, height: Axes) -> None:
    above.set_aspect("equal", adjustable="datalim")
    label(above, "east (m)", "north (m)")
    label(height, "time (s)", "up (m)")


def track(width_in: float, one: Localization) -> Figure:
    """Draw true and estimated paths from above, their heights, and the position error over time.

    The estimates are those with raw ranges, and with calibrated ranges and their variance.
    """
    last, narrow = one.tracks["variance"], width_in < NARROW_IN
    every = slice(None, None, max(1, len(last.time_ns) // SAMPLES))
    time = (last.time_ns - last.time_ns[0])[every] * 1e-9
    figure = Figure(figsize=(width_in, 6.0 if narrow else 3.8), layout="constrained")
    places: Any = [["path"], ["height"], ["error"]] if narrow else [["path", "height"], ["error", "error"]]
    panels = figure.subplot_mosaic(places, height_ratios=[2.2, 1, 1.2] if narrow else [1.4, 1])
    above, height, error = panels["path"], panels["height"], panels["error"]
    usual = []
    for stage in ("raw", "variance"):
        if (own := one.tracks.get(stage)) is None:
            continue
        name, colour, dashes, _ = FILTER_STYLES[stage]
        line: dict[str, Any] = {"color": colour, "ls": dashes, "lw": 0.9, "label": name}
        off = np.linalg.norm(own.estimate_m - own.truth_m, axis=1)
        usual.append(float(np.quantile(off, 0.995)))
        series(error, time, off[every], **line)
        _draw_path(above, height, time, own.estimate_m[every], **line)
    _draw_path(above, height, time, last.truth_m[every], color=INK, lw=0.9)
    error.plot([], [], color=INK, lw=0.9, label="true")
    error.plot(time, 3 * last.std_m[every], color=MUTED, lw=0.8, ls="--", label="3 σ, by the filter itself")
    # Leave out the large errors at the start and those of a diverged filter.
    error.set_ylim(0, 1.15 * max(3 * np.quantile(last.std_m, 0.9), min(max(usual), 3 * np.median(usual))))
    _label_paths(above, height)
    label(error, "time (s)", "position error (m)")
    legend(figure, error)
    return figure


def onboard(width_in: float, one: OnboardTrack) -> Figure:
    """Draw the path from above and the height over time, with the truth if poses give it."""
    figure, (above, height) = sheet(width_in, 2, height_in=2.8)
    every = slice(None, None, max(1, len(one.time_ns) // SAMPLES))
    time = (one.time_ns - one.time_ns[0])[every] * 1e-9
    if np.isfinite(one.truth_m).any():
        _draw_path(above, height, time, one.truth_m[every], color=INK, lw=1, label="true")
    _draw_path(above, height, time, one.estimate_m[every], color=BLUE, ls=(0, (5, 1.5)), lw=1, label=one.used)
    _label_paths(above, height)
    legend(figure, above)
    return figure


def arrangement(width_in: float, plan: Plan, number: int) -> Figure:
    """Draw the boards of an arrangement with the distances to measure, and the intervals of the delays after it.

    Boards are drawn from above; those of a plan in space also from the side.
    """
    on_line, one = plan.on == "line", plan.arrangements[number]
    figure, panels = sheet(width_in, 3 if plan.on == "" else 2, height_in=1.5 if on_line else 2.7)
    for axes, height in zip(panels[:-1], (1, 2), strict=False):
        _boards(axes, one, height, on_line=on_line)
    panels[0].set_title(f"Step {number + 1}: arrangement {one.name}")
    _intervals(panels[-1], plan.after_ns[number], plan.after_ns[number - 1] if number else {})
    if one.taped:
        panels[-1].plot([], [], "--", color=VERMILION, label="distance to tape")
    legend(figure, panels[-1])
    return figure


def _boards(axes: Axes, one: PlannedArrangement, height: int, *, on_line: bool) -> None:
    """Draw boards by their coordinates x and `height` (1: y, from above; 2: z, from the side), and tapes."""
    spots = {tag: (place[0], place[height]) for tag, place in one.place_m.items()}
    for tag, spot in spots.items():
        axes.plot(*spot, "o", ms=12, color="white", mec=BLUE, mew=1.2, zorder=3)
        axes.annotate(str(tag), spot, ha="center", va="center", color=INK, zorder=4)
    for i, j in one.taped:
        # Ends in order of x, so that all arcs bend upwards.
        first, second = sorted((spots[i], spots[j]))
        bow = f"arc3,rad={-0.25 if on_line else 0}"
        style: dict[str, Any] = {"arrowstyle": "<->", "color": VERMILION, "ls": "--", "shrinkA": 7, "shrinkB": 7}
        axes.annotate("", second, xytext=first, arrowprops=style | {"connectionstyle": bow}, zorder=2)
    axes.margins(0.14)
    if on_line:
        axes.axhline(0, color=MUTED, lw=1.0, zorder=1)
        axes.set(ylim=(-0.6, 0.9), yticks=[], xticks=sorted(x for x, _ in spots.values()))
        label(axes, "along the string (m)", "")
    else:
        axes.set_aspect("equal", adjustable="datalim")
        label(axes, "x (m)", "y (m)" if height == 1 else "height (m)")


def _intervals(
    axes: Axes,
    after: Mapping[int, float],
    before: Mapping[int, float],
    names: tuple[str, str] = ("after this arrangement", "before it"),
) -> None:
    """Draw half intervals by tag as bars, and those `before` as outlines; undetermined delays are marked "open"."""
    rows = np.arange(len(after))
    bars: Any = ((before, names[1], 0.8, "none", MUTED), (after, names[0], 0.5, BLUE, BLUE))
    for values, text, width, face, edge in bars:
        shown = np.array([values.get(tag, math.inf) for tag in after])
        known = np.isfinite(shown)
        if known.any():
            axes.bar(rows[known], shown[known], width, label=text, facecolor=face, edgecolor=edge, lw=0.8)
    for row, value in zip(rows.tolist(), after.values(), strict=True):
        if not math.isfinite(value):
            axes.annotate("open", (row, 0), ha="center", va="bottom", color=VERMILION, rotation=90)
    axes.set_xticks(rows, [str(tag) for tag in after])
    axes.set_xlim(-0.6, len(after) - 0.4)
    label(axes, "tag", "± ns (95 %)")
    axes.grid(visible=False, axis="x")


def next_measurements(width_in: float, next_best: tuple[NextBest, ...]) -> Figure:
    """Draw the mean interval of the delays as planned, and with each further measurement."""
    letters = 26 if width_in < NARROW_IN else 60
    texts = ["as planned", *(textwrap.fill("+ " + best.what, letters) for best in next_best)]
    values = [next_best[0].instead_of_ns, *(best.mean_ns for best in next_best)]
    lines = sum(text.count("\n") + 1 for text in texts)
    figure, (axes,) = sheet(width_in, height_in=0.7 + 0.2 * lines + 0.1 * len(texts))
    bars = axes.barh(texts, values, 0.6, color=[MUTED, *[BLUE] * len(next_best)])
    axes.bar_label(bars, fmt="%.3f", padding=4)
    axes.invert_yaxis()
    axes.margins(x=0.35 if width_in < NARROW_IN else 0.18)
    label(axes, "± ns (95 %), mean", "")
    axes.grid(visible=False, axis="y")
    return figure


def planned_delays(width_in: float, plan: FlightPlan) -> Figure:
    """Draw the interval of each delay; for undetermined delays, outlines of the intervals in `FlightPlan.open_ns`."""
    figure, (axes,) = sheet(width_in, height_in=2.2)
    undetermined_delays = {tag: plan.open_ns[tag] for tag, half in plan.half_ns.items() if not math.isfinite(half)}
    _intervals(axes, plan.half_ns, undetermined_delays, ("determined", "stays open"))
    legend(figure)
    return figure


def flight(width_in: float, plan: FlightPlan) -> Figure:
    """Draw the paths of bodies from above and their heights over time; lines are thick while positions are known."""
    figure, (above, height) = sheet(width_in, 2, height_in=2.9)
    time = np.linspace(0, plan.seconds, len(plan.path_m))
    early = time <= (plan.seconds if plan.settings.poses_until_s is None else plan.settings.poses_until_s)
    for k, body in enumerate(plan.bodies):
        path, line = plan.path_m[:, k], {"color": look(k).colour, "ls": look(k).dashes}
        _draw_path(above, height, time, path, lw=0.8, label=body, **line)
        _draw_path(above, height, time[early], path[early], lw=2.6, **line)
    for name, (x, y, _) in plan.stands.items():
        above.plot(x, y, "s", ms=5, color=INK)
        above.annotate(name, (x, y), xytext=(0, 6), textcoords="offset points", ha="center", color=MUTED)
    above.margins(0.08)
    _label_paths(above, height)
    legend(figure, above)
    return figure
