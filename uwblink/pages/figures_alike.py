"""Many small panels that are alike: one grid, one scale, ticks at the edges alone.

Panels that matplotlib makes and measures one by one, as axes, take several times as long as all that is drawn in them.
Here they are places on a figure, and all that is the same in each is drawn in one stroke.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, cast

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from matplotlib.ticker import MaxNLocator, ScalarFormatter
from matplotlib.transforms import ScaledTranslation, Transform

from uwblink.arrays import Floats
from uwblink.pages.colours import GRID, MUTED

TICK_PT: Final = 3.5
"""Length of a tick, and of the gap to its number, as matplotlib has them."""

TITLE_PT: Final = 2.0
"""Gap between a panel and its title."""

TICK_ROOM: Final = (3.0, 2.0)
"""What a number takes along the horizontal and the vertical axis, in sizes of its letters."""

ROUND_STEPS: Final = (1.0, 2.0, 2.5, 5.0, 10.0)
MOST_TICKS: Final = 9
LAYERS: Final = 8
"""Strokes that a cloud of dots is drawn in: where dots of several lie upon each other, it is darker."""

NEXT_TO_NOTHING_PT: Final = 0.01
"""Length of a line of which a round pen makes a dot."""

Reach = tuple[float, float]
Cap = Literal["butt", "projecting", "round"]


@dataclass(frozen=True, slots=True)
class Panel:
    """A place on a figure: from where to where, in shares of the figure's size, and what runs over it."""

    across: Reach
    up: Reach
    x: Reach
    y: Reach

    def on_figure(self, x: Floats, y: Floats) -> Floats:
        """Return where points of the panel are on the figure (n, 2); NaN for those outside."""
        across = self.across[0] + (x - self.x[0]) * ((self.across[1] - self.across[0]) / (self.x[1] - self.x[0]))
        up = self.up[0] + (y - self.y[0]) * ((self.up[1] - self.up[0]) / (self.y[1] - self.y[0]))
        outside = (x < self.x[0]) | (x > self.x[1]) | (y < self.y[0]) | (y > self.y[1])
        return np.where(outside[:, None], np.nan, np.column_stack([across, up]))


class ManyAlike(Figure):
    """A figure of `panels` that are none of matplotlib's axes."""

    panels: Sequence[Panel] = ()


def many_alike(
    width_in: float, titles: Sequence[str], columns: int, *, height_in: float, x: Reach, y: Reach
) -> ManyAlike:
    """Return a figure with a panel a title, so many beside each other, with room for labels at its edges.

    All run over the same `x` and `y`, with the same grid, and numbers at the left and below.
    """
    down = -(-len(titles) // columns)
    tall = height_in * down + 0.6
    figure = ManyAlike(figsize=(width_in, tall))
    # All panels are alike, so a layout that measures every label would find just this.
    edges = {"left": 0.62 / width_in, "right": 1 - 0.1 / width_in, "bottom": 0.42 / tall, "top": 1 - 0.2 / tall}
    bottoms, tops, lefts, rights = GridSpec(
        down, columns, figure, **edges, wspace=0.12, hspace=0.32
    ).get_grid_positions(figure)
    places = [divmod(k, columns) for k in range(len(titles))]
    figure.panels = [Panel((lefts[c], rights[c]), (bottoms[r], tops[r]), x, y) for r, c in places]
    above = _moved(figure, (0, TITLE_PT))
    for panel, title in zip(figure.panels, titles, strict=True):
        figure.text(panel.across[0], panel.up[1], title, transform=above, size=_size())
    _share_axes(figure, columns)
    return figure


def _share_axes(figure: ManyAlike, columns: int) -> None:
    """Draw the frames and grids of all panels, and their numbers at the left and below."""
    panels, first = figure.panels, figure.panels[0]
    upright, level = _ticks(figure, first, 0), _ticks(figure, first, 1)
    across, up = np.diag(TICK_PT / 72 / figure.get_size_inches())
    frames, grid, marks = [], [], []
    for k, panel in enumerate(panels):
        (left, right), (low, high) = panel.across, panel.up
        frames.append(np.array([(left, high), (left, low), (right, low)]))
        risen = [panel.on_figure(np.full(2, tick), np.array(panel.y)) for tick, _ in upright]
        lying = [panel.on_figure(np.array(panel.x), np.full(2, tick)) for tick, _ in level]
        grid += risen + lying
        marks += [line[0] - np.array([(0, 0), up]) for line in risen]
        marks += [line[0] - np.array([(0, 0), across]) for line in lying]
        if k + columns >= len(panels):
            _number(figure, risen, upright, (0, -2 * TICK_PT), ha="center", va="top")
        if k % columns == 0:
            _number(figure, lying, level, (-2 * TICK_PT, 0), ha="right", va="center_baseline")
    strokes(figure, grid, color=GRID, lw=0.5, zorder=-2)
    strokes(figure, marks, color=MUTED, lw=0.8, zorder=-1)
    strokes(figure, frames, cap="projecting", color=MUTED, lw=matplotlib.rcParams["axes.linewidth"], zorder=2.5)


def _ticks(figure: Figure, panel: Panel, side: int) -> list[tuple[float, str]]:
    """Return round numbers and how they are written: as many as matplotlib gives axes of a panel's size."""
    (begin, end), (low, high) = ((panel.across, panel.x), (panel.up, panel.y))[side]
    points = 72 * float(figure.get_size_inches()[side]) * (end - begin)
    most = int(np.clip(points // (TICK_ROOM[side] * _size()), 1, MOST_TICKS))
    found: list[float] = np.asarray(MaxNLocator(most, steps=ROUND_STEPS).tick_values(low, high)).tolist()
    ticks = [tick for tick in found if low <= tick <= high]
    written = ScalarFormatter(useOffset=False)
    written.set_scientific(False)
    written.create_dummy_axis()
    cast("Any", written.axis).set_view_interval(low, high)
    return list(zip(ticks, written.format_ticks(ticks), strict=True))


def _size() -> float:
    return float(matplotlib.rcParams["font.size"])


def _number(
    figure: Figure, lines: Iterable[Floats], ticks: Iterable[tuple[float, str]], moved_pt: Reach, **look: Any
) -> None:
    """Write numbers where lines begin, or so far beside it."""
    beside = _moved(figure, moved_pt)
    for line, (_, name) in zip(lines, ticks, strict=True):
        x, y = line[0].tolist()
        figure.text(x, y, name, transform=beside, size=_size(), **look)


def _moved(figure: Figure, points: Reach) -> Transform:
    return figure.transFigure + ScaledTranslation(points[0] / 72, points[1] / 72, figure.dpi_scale_trans)


def strokes(figure: Figure, lines: Sequence[Floats], *, cap: Cap = "butt", **look: Any) -> None:
    """Draw lines (n, 2) on a figure, in shares of its size, all as one."""
    if lines:
        gap = np.full((1, 2), np.nan)
        points = np.concatenate([part for line in lines for part in (line, gap)])
        figure.add_artist(Line2D(*points.T, transform=figure.transFigure, solid_capstyle=cap, **look))


def dots(figure: Figure, places: Floats, *, size_pt: float, **look: Any) -> None:
    """Draw dots at places on a figure (n, 2), in shares of its size; those of NaN are left out.

    They are strokes of a round pen, sharp at any size: pictures of clouds take longer to pack than all else to draw.
    """
    points = 72 * figure.get_size_inches() * places[np.isfinite(places).all(axis=1)]
    for layer in range(LAYERS):
        # Hundredths of a point: a file of longer numbers is half as large again.
        begin = np.round(points[layer::LAYERS], 2)
        if not len(begin):
            continue
        path = Path(
            np.stack([begin, begin + np.array([NEXT_TO_NOTHING_PT, 0])], axis=1).reshape(-1, 2) / 72,
            np.tile([Path.MOVETO, Path.LINETO], len(begin)).astype(Path.code_type),
        )
        # Lines as short as these would be left out.
        path.should_simplify = False
        figure.add_artist(
            PathPatch(
                # Where pixels are drawn, both ends would else be moved to the same one.
                path,
                fill=False,
                lw=size_pt,
                capstyle="round",
                snap=False,
                transform=figure.dpi_scale_trans,
                **look,
            )
        )
