"""Figures of plans: each arrangement with what will be known after it, flights, and what one thing more would bring."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calib.planning.flight_result import FlightPlan
from calib.planning.result import NextBest, Plan, PlannedArrangement
from uwblink.pages.colours import BLUE, INK, MUTED, VERMILION, look
from uwblink.pages.figures import label, legend, sheet

BOARD_PT = 12
AROUND = 0.14
LINE_IN = 1.5
AREA_IN = 2.7
BAR_IN = 0.34
TAPE_BOW = 0.25
UPRIGHT = 5
TAPE = "distance to tape"


def arrangement(width_in: float, plan: Plan, number: int) -> Figure:
    """Where boards stand in an arrangement, with tapes; and intervals when it has been made.

    Boards are seen from above, and in space from the side as well.
    """
    on_line, in_space = plan.on == "line", plan.on == ""
    figure, panels = sheet(width_in, 3 if in_space else 2, height_in=LINE_IN if on_line else AREA_IN)
    one = plan.arrangements[number]
    for axes, height in zip(panels[:-1], (1, 2), strict=False):
        _boards(axes, one, height)
        _tapes(axes, one, height, on_line=on_line)
        if on_line:
            _as_string(axes, one)
    panels[0].set_title(f"Step {number + 1}: arrangement {one.name}", loc="left")
    _intervals(panels[-1], plan.after_ns[number], plan.after_ns[number - 1] if number else {})
    legend(figure, _meant(panels))
    return figure


def _meant(panels: list[Axes]) -> Axes:
    """Return the panel of intervals, whose legend names the tapes as well."""
    if any(line.get_label() == TAPE for line in panels[0].lines):
        panels[-1].plot([], [], "--", color=VERMILION, label=TAPE)
    return panels[-1]


def _boards(axes: Axes, one: PlannedArrangement, height: int) -> None:
    """Draw boards by x and by their coordinate `height`: y from above, z from the side."""
    for tag, place in one.place_m.items():
        axes.plot(place[0], place[height], "o", ms=BOARD_PT, color="white", mec=BLUE, mew=1.2, zorder=3)
        axes.annotate(str(tag), (place[0], place[height]), ha="center", va="center", color=INK, zorder=4)
    label(axes, "x (m)", "y (m)" if height == 1 else "height (m)")
    axes.margins(AROUND)
    axes.set_aspect("equal", adjustable="datalim")


def _as_string(axes: Axes, one: PlannedArrangement) -> None:
    xs = [place[0] for place in one.place_m.values()]
    axes.set_aspect("auto")
    axes.plot([min(xs), max(xs)], [0, 0], color=MUTED, lw=1.0, zorder=1)
    axes.set_ylim(-0.6, 0.9)
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    axes.grid(visible=False)
    axes.set_xticks(sorted(xs))
    label(axes, "along the string (m)", "")
    axes.grid(visible=False)


def _tapes(axes: Axes, one: PlannedArrangement, height: int, *, on_line: bool) -> None:
    style = {"arrowstyle": "<->", "color": VERMILION, "ls": "--", "shrinkA": 7, "shrinkB": 7}
    style["connectionstyle"] = f"arc3,rad={-TAPE_BOW if on_line else 0}"
    for i, j in one.taped:
        # From left to right, so that all tapes bow upwards.
        first, second = sorted((one.place_m[tag][0], one.place_m[tag][height]) for tag in (i, j))
        axes.annotate("", second, xytext=first, arrowprops=style, zorder=2)
    if one.taped:
        axes.plot([], [], label=TAPE)


def _intervals(axes: Axes, after: Mapping[int, float], before: Mapping[int, float]) -> None:
    tags = list(after)
    rows = np.arange(len(tags))
    top, turned = _top([*after.values(), *before.values()]), 90 if len(tags) > UPRIGHT else 0
    if before:
        _bars(axes, rows, [before[tag] for tag in tags], top, 0.8, "before it", "none", MUTED)
    _bars(axes, rows, [after[tag] for tag in tags], top, 0.5, "after this arrangement", BLUE, BLUE)
    for row, tag in zip(rows.tolist(), tags, strict=True):
        if not math.isfinite(after[tag]):
            axes.annotate("open", (row, 0.02 * top), ha="center", va="bottom", color=VERMILION, rotation=turned)
    axes.set_xticks(rows, [str(tag) for tag in tags])
    axes.set_xlim(-0.6, len(tags) - 0.4)
    axes.set_ylim(0, 1.08 * top)
    label(axes, "board", "± ns (95 %)")
    axes.grid(visible=False, axis="x")


def _bars(
    axes: Axes, rows: np.ndarray, values: list[float], top: float, width: float, text: str, face: str, edge: str
) -> None:
    shown = [min(value, 1.2 * top) if math.isfinite(value) else math.nan for value in values]
    axes.bar(rows, shown, width, label=text, facecolor=face, edgecolor=edge, lw=0.8)


def _top(values: list[float]) -> float:
    finite = [value for value in values if math.isfinite(value)]
    return max(finite, default=1.0)


def more(width_in: float, next_best: tuple[NextBest, ...]) -> Figure:
    """The mean interval as planned, and with each thing more."""
    letters = 26 if width_in < 5 else 60
    texts = ["as planned", *("+ " + textwrap.shorten(best.what, 3 * letters) for best in next_best)]
    texts = [textwrap.fill(text, letters) for text in texts]
    values = [next_best[0].instead_of_ns, *(best.mean_ns for best in next_best)]
    lines = sum(text.count("\n") + 1 for text in texts)
    figure, (axes,) = sheet(width_in, height_in=0.7 + max(BAR_IN * len(texts), 0.16 * lines + 0.1 * len(texts)))
    rows = np.arange(len(texts))
    axes.barh(rows, values, 0.6, color=[MUTED, *[BLUE] * len(next_best)])
    for row, value in zip(rows.tolist(), values, strict=True):
        axes.annotate(f"{value:.3f}", (value, row), xytext=(4, 0), textcoords="offset points", va="center")
    axes.set_yticks(rows, texts)
    axes.invert_yaxis()
    axes.set_xlim(0, (1.18 if width_in > 5 else 1.35) * max(values))
    label(axes, "± ns (95 %), mean", "")
    axes.grid(visible=False, axis="y")
    return figure


def delays(width_in: float, plan: FlightPlan) -> Figure:
    """The interval of each delay; of those that stay open, how far they would be known."""
    figure, (axes,) = sheet(width_in, height_in=2.2)
    tags = list(plan.half_ns)
    rows = np.arange(len(tags))
    open_ones = [math.nan if math.isfinite(plan.half_ns[tag]) else plan.open_ns[tag] for tag in tags]
    known = [plan.half_ns[tag] if math.isfinite(plan.half_ns[tag]) else math.nan for tag in tags]
    if np.isfinite(known).any():
        axes.bar(rows, known, 0.6, color=BLUE, label="determined")
    if np.isfinite(open_ones).any():
        axes.bar(rows, open_ones, 0.6, facecolor="none", edgecolor=VERMILION, lw=0.9, label="stays open")
    axes.set_xticks(rows, [str(tag) for tag in tags])
    label(axes, "tag", "± ns (95 %)")
    axes.grid(visible=False, axis="x")
    legend(figure)
    return figure


def flight(width_in: float, plan: FlightPlan) -> Figure:
    """Where bodies fly, seen from above and in height over time; thick while their positions are known."""
    figure, (above, height) = sheet(width_in, 2, height_in=2.9)
    time = np.linspace(0, plan.seconds, len(plan.path_m))
    early = time <= (plan.seconds if plan.usable.poses_until_s is None else plan.usable.poses_until_s)
    for k, body in enumerate(plan.bodies):
        colour = look(k).colour
        x, y, z = plan.path_m[:, k].T
        above.plot(x, y, color=colour, lw=0.8, label=body, ls=look(k).dashes)
        above.plot(x[early], y[early], color=colour, lw=2.6)
        height.plot(time, z, color=colour, lw=0.8, ls=look(k).dashes)
        height.plot(time[early], z[early], color=colour, lw=2.6)
    for name, (x, y, _) in plan.stands.items():
        above.plot(x, y, "s", ms=5, color=INK)
        above.annotate(name, (x, y), xytext=(0, 6), textcoords="offset points", ha="center", color=MUTED)
    above.set_aspect("equal", adjustable="datalim")
    above.margins(0.08)
    label(above, "x (m)", "y (m)")
    label(height, "time (s)", "height (m)")
    legend(figure, above)
    return figure
