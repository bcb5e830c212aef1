"""Many small panels that are alike: one grid, one scale, ticks at the edges alone.

Panels that matplotlib makes and measures one by one take longer than all that is drawn in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from uwblink.arrays import Floats
from uwblink.pages.colours import GRID, MUTED

TICK_IN: Final = 3.5 / 72
"""Length of a tick, as matplotlib has it."""


def many_alike(width_in: float, titles: Sequence[str], columns: int, *, height_in: float) -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel a title, so many beside each other, with room for labels at its edges."""
    down = -(-len(titles) // columns)
    tall = height_in * down + 0.6
    figure = Figure(figsize=(width_in, tall))
    # All panels are alike, so a layout that measures every label would find just this.
    edges = {"left": 0.62 / width_in, "right": 1 - 0.1 / width_in, "bottom": 0.42 / tall, "top": 1 - 0.2 / tall}
    grid = figure.add_gridspec(down, columns, **edges, wspace=0.12, hspace=0.32)
    panels = []
    for k, title in enumerate(titles):
        panel = figure.add_subplot(grid[divmod(k, columns)])
        # At a height that is given: else it is measured against everything above the panel.
        panel.set_title(title, loc="left", pad=2, y=1.0)
        panel.spines[["top", "right"]].set_visible(False)
        panels.append(panel)
    return figure, panels


def share_axes(
    figure: Figure, panels: Sequence[Axes], columns: int, x: tuple[float, float], y: tuple[float, float]
) -> None:
    """Let all panels run over the same `x` and `y`, with the same grid, and numbers at the left and below."""
    for panel in panels:
        panel.set(xlim=x, ylim=y)
    ticks_x = [float(t) for t in panels[0].get_xticks() if x[0] <= t <= x[1]]
    ticks_y = [float(t) for t in panels[0].get_yticks() if y[0] <= t <= y[1]]
    across, up = np.array([TICK_IN / figure.get_figwidth(), 0]), np.array([0, TICK_IN / figure.get_figheight()])
    grid: list[Floats] = []
    marks: list[Floats] = []
    for k, panel in enumerate(panels):
        below, left = k + columns >= len(panels), k % columns == 0
        panel.set_xticks(ticks_x if below else [])
        panel.set_yticks(ticks_y if left else [])
        upright = [on_figure(panel, np.array([tick, tick]), np.array(y)) for tick in ticks_x]
        level = [on_figure(panel, np.array(x), np.array([tick, tick])) for tick in ticks_y]
        grid += upright + level
        marks += [] if below else [np.array([line[0], line[0] - up]) for line in upright]
        marks += [] if left else [np.array([line[0], line[0] - across]) for line in level]
    for lines, colour, width, floor in ((grid, GRID, 0.5, -2), (marks, MUTED, 0.8, -1)):
        figure.add_artist(
            LineCollection(lines, colors=colour, linewidths=width, transform=figure.transFigure, zorder=floor)
        )


def on_figure(panel: Axes, x: Floats, y: Floats) -> Floats:
    """Return where points of a panel are on the figure (n, 2), in shares of its size; NaN for those outside."""
    box, view = panel.get_position(), (*panel.get_xlim(), *panel.get_ylim())
    across = box.x0 + (x - view[0]) * (box.width / (view[1] - view[0]))
    up = box.y0 + (y - view[2]) * (box.height / (view[3] - view[2]))
    outside = (x < view[0]) | (x > view[1]) | (y < view[2]) | (y > view[3])
    return np.where(outside[:, None], np.nan, np.column_stack([across, up]))
