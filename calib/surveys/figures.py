"""The boards of a survey, seen from above, with their 95 % ellipses."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from calib.surveys.result import SurveyedArrangement
from uwblink.pages.colours import BLUE, VERMILION
from uwblink.pages.figures import label, sheet


def board_figure(arrangements: Sequence[SurveyedArrangement], width_in: float | None = None) -> Figure:
    """Return a figure of arrangements, one panel each; panels beside each other are at least 2.2 inch wide.

    `width_in` is its width in inches, by default up to three panels of 3 inch. Ellipses too small to be seen are drawn
    ten times as large and dashed.
    """
    width = 3.0 * min(3, len(arrangements)) if width_in is None else width_in
    across = max(1, min(3, len(arrangements), int(width / 2.2)))
    tall = 1.1 if all(one.known == "line" for one in arrangements) else min(3.0, width / across)
    figure, panels = sheet(width, len(arrangements), height_in=tall + 0.4, across=across)
    for axes, one in zip(panels, arrangements, strict=True):
        _draw_boards(axes, one)
    return figure


def _draw_boards(axes: Axes, one: SurveyedArrangement) -> None:
    """Draw the boards of an arrangement from above, each with its ellipse, into axes."""
    place = np.array([board.position_m for board in one.boards])
    width = float(np.ptp(place[:, :2], axis=0).max()) or 1.0
    for board in one.boards:
        x, y, z = board.position_m
        colour = BLUE if board.determined else VERMILION
        axes.plot(x, y, "o", ms=3, color=colour)
        high = f" ({z:+.2f})" if one.known == "" else ""
        axes.annotate(f"{board.tag}{high}", (x, y), xytext=(0, 7), textcoords="offset points", ha="center")
        values, vectors = np.linalg.eigh(board.covariance_m2[:2, :2])
        # 5.991 is the 95 % quantile of chi-square with two degrees of freedom.
        long, short = 2 * np.sqrt(5.991 * np.maximum(values[::-1], 0.0))
        factor, style = (10.0, "--") if long < 0.01 * width else (1.0, "-")
        turn = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
        axes.add_patch(
            Ellipse((x, y), factor * long, factor * short, angle=turn, fill=False, ec=colour, lw=1.0, ls=style)
        )
    axes.set(title=one.name)
    axes.margins(0.15)
    label(axes, "m", "")
    if one.known == "line":
        axes.set(ylim=(-0.5, 0.8), yticks=[])
    else:
        axes.set_aspect("equal", adjustable="datalim")
