"""Where panels are on a figure: as large as their labels and legends let them be, each measured once."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from uwblink.arrays import Floats

PAD_IN: Final = 0.0417
"""Distance from what panels are labelled with to the edge, and half of that to what another is."""

USUAL_IN: Final = (0.55, 0.12, 0.42, 0.12)
"""Room left, right, below and above a panel before its labels are measured: near what most take."""

PASSES: Final = 3


@cache
def measuring(dpi: float) -> RendererAgg:
    """Return what tells how much room text takes, and remembers it: most words are in several figures.

    It need not have a pixel to draw on for that.
    """
    make: Any = RendererAgg
    found: RendererAgg = make(1, 1, dpi)
    return found


class Placed(ConstrainedLayoutEngine):
    """Places the panels of one grid, as matplotlib's constrained layout does, which measures everything twice.

    Here it is measured once where ticks stay what they are when panels have the size that labels leave them. Figures
    with more than one grid, or bars of colours, are left to matplotlib.
    """

    _adjust_compatible = True

    def execute(self, fig: Figure) -> None:
        """Place the panels of a figure."""
        panels = fig.axes
        grid = panels[0].get_gridspec() if panels else None
        if grid is None or any(axes.get_gridspec() is not grid for axes in panels):
            super().execute(fig)
            return
        renderer = measuring(fig.dpi)
        legends = sum(2 * PAD_IN + legend.get_window_extent(renderer).height / fig.dpi for legend in fig.legends)
        rows, columns = grid.get_geometry()
        usual = [np.full(count, side) for count, side in zip((columns, columns, rows, rows), USUAL_IN, strict=True)]
        _adjust(fig, usual, legends)
        ticks = _ticks(panels)
        for _ in range(PASSES):
            _adjust(fig, _room(panels, (rows, columns), renderer), legends)
            before, ticks = ticks, _ticks(panels)
            if ticks == before:
                break


def _ticks(panels: Sequence[Axes]) -> list[list[float]]:
    """Return where the ticks of panels are."""
    return [axis.get_majorticklocs().tolist() for axes in panels for axis in (axes.xaxis, axes.yaxis)]


def _room(panels: Sequence[Axes], shape: tuple[int, int], renderer: RendererAgg) -> list[Floats]:
    """Return the room in inches that labels take left and right of each column, below and above each row."""
    rows, columns = shape
    left, right, below, above = (np.full(count, PAD_IN) for count in (columns, columns, rows, rows))
    for axes in panels:
        whole, own, place = axes.get_tightbbox(renderer, for_layout_only=True), axes.bbox, axes.get_subplotspec()
        if whole is None or place is None:
            continue
        for side, at, takes in (
            (left, place.colspan.start, own.x0 - whole.x0),
            (right, place.colspan.stop - 1, whole.x1 - own.x1),
            (below, place.rowspan.stop - 1, own.y0 - whole.y0),
            (above, place.rowspan.start, whole.y1 - own.y1),
        ):
            side[at] = max(side[at], PAD_IN + takes / renderer.dpi)
    return [left, right, below, above]


def _adjust(figure: Figure, room: Sequence[Floats], legends: float) -> None:
    """Give panels their room, and above all of them that of `legends`, in inches."""
    left, right, below, above = room
    across, up = figure.get_size_inches()
    beside, under = (float(np.max(gaps, initial=0)) for gaps in (right[:-1] + left[1:], below[:-1] + above[1:]))
    width = (across - left[0] - right[-1] - (len(left) - 1) * beside) / len(left)
    height = (up - legends - above[0] - below[-1] - (len(below) - 1) * under) / len(below)
    figure.subplots_adjust(
        left=left[0] / across,
        right=1 - right[-1] / across,
        bottom=below[-1] / up,
        top=1 - (above[0] + legends) / up,
        wspace=beside / width,
        hspace=under / height,
    )
