"""The boards of a survey, seen from above, with the ellipses in which they stand with 95 %."""

from __future__ import annotations

import math
from collections.abc import Sequence
from io import BytesIO
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from calib.surveys.result import SurveyedArrangement
from uwblink.arrays import Floats

ACROSS: Final = 3
PANEL_IN: Final = 3.0
LINE_IN: Final = 1.1
NARROWEST_IN: Final = 2.2
CHI_SQUARE_95: Final = 5.991
"""95 % quantile of chi-square with two degrees of freedom."""

SMALLEST: Final = 0.01
"""Share of the picture's width below which an ellipse would not be seen: it is then drawn larger, and dashed."""

INK: Final = "#0072B2"
LOOSE: Final = "#D55E00"


def board_picture(arrangements: tuple[SurveyedArrangement, ...], form: str) -> bytes:
    """Return a picture of arrangements, a panel each, as bytes of a form that matplotlib writes ("svg", "png", "pdf").

    Ellipses too small to be seen are drawn ten times as large and dashed.
    """
    figure = board_figure(arrangements, PANEL_IN * min(ACROSS, len(arrangements)))
    out = BytesIO()
    figure.savefig(out, format=form, dpi=150, metadata={"Date": None} if form == "svg" else None)
    return out.getvalue()


def board_figure(arrangements: Sequence[SurveyedArrangement], width_in: float) -> Figure:
    """Return the same as a figure of a width in inches: as many panels beside each other as are 2.2 inch wide."""
    across = max(1, min(ACROSS, len(arrangements), int(width_in / NARROWEST_IN)))
    down = -(-len(arrangements) // across)
    tall = LINE_IN if all(one.known == "line" for one in arrangements) else min(PANEL_IN, width_in / across)
    figure = Figure(figsize=(width_in, (tall + 0.4) * down), layout="constrained")
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for axes, one in zip(panels, arrangements, strict=False):
        draw_boards(axes, one)
    for axes in panels[len(arrangements) :]:
        axes.set_visible(False)
    return figure


def draw_boards(axes: Axes, one: SurveyedArrangement) -> Axes:
    """Draw the boards of an arrangement from above, each with its ellipse, into axes."""
    place = np.array([board.position_m for board in one.boards])
    width = float(np.ptp(place[:, :2], axis=0).max()) or 1.0
    for board, (x, y, z) in zip(one.boards, place.tolist(), strict=True):
        colour = INK if board.determined else LOOSE
        axes.plot(x, y, "o", ms=3, color=colour)
        high = f" ({z:+.2f})" if one.known == "" else ""
        axes.annotate(f"{board.tag}{high}", (x, y), xytext=(0, 7), textcoords="offset points", ha="center", fontsize=8)
        axes.add_patch(_ellipse((x, y), board.covariance_m2[:2, :2], width, colour))
    margin = 0.12 * width
    if one.known == "line":
        axes.set_xlim(place[:, 0].min() - margin, place[:, 0].max() + margin)
        axes.set_ylim(-0.5, 0.8)
        axes.set_yticks([])
    else:
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.15)
    axes.set_title(one.name, loc="left", fontsize="medium")
    axes.set_xlabel("m", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def _ellipse(centre: tuple[float, float], covariance: Floats, width: float, colour: str) -> Ellipse:
    values, vectors = np.linalg.eigh(covariance)
    long, short = (2 * math.sqrt(CHI_SQUARE_95 * max(float(v), 0.0)) for v in values[::-1])
    factor = 10.0 if long < SMALLEST * width else 1.0
    turn = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
    style = "--" if factor > 1 else "-"
    return Ellipse(centre, factor * long, factor * short, angle=turn, fill=False, ec=colour, lw=1.0, ls=style)
