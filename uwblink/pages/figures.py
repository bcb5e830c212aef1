"""Drawing at paper size: style, sheets of panels, and files of a drawing that is made once."""

from __future__ import annotations

import io
import json
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from typing import Any, Final

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from uwblink.pages.colours import GRID, INK, MUTED

COLUMN_IN: Final = 3.5
"""Width of a column of a two-column page, inches."""

PAGE_IN: Final = 7.16
"""Width of both columns."""

WIDTHS: Final = {"column": COLUMN_IN, "page": PAGE_IN}
TEXT_PT: Final = 8.0
NARROW_IN: Final = 5.0
"""Below this width panels stand above each other."""

LINE_IN: Final = 0.165
"""Height of a line of a legend."""

RASTER_DPI: Final = 220
"""Of clouds of points, which are pictures inside a drawing."""

STYLE: Final[Any] = {
    "font.family": "DejaVu Sans",
    "font.size": TEXT_PT,
    "axes.labelsize": TEXT_PT,
    "axes.titlesize": TEXT_PT,
    "xtick.labelsize": TEXT_PT,
    "ytick.labelsize": TEXT_PT,
    "legend.fontsize": TEXT_PT,
    "text.color": INK,
    "axes.labelcolor": INK,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
    "axes.linewidth": 0.7,
    "grid.color": GRID,
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.1,
    "legend.frameon": False,
    "legend.handlelength": 2.2,
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
}

Draw = Callable[[float], Figure]
"""Draws a figure of a width in inches."""

METADATA: Final[dict[str, dict[str, Any]]] = {
    # No date in a file: the same data give the same bytes.
    "pdf": {"CreationDate": None},
    "svg": {"Date": None, "Creator": None},
}


def style(**more: Any) -> AbstractContextManager[None]:
    """Return a context in which figures are drawn and written at paper size."""
    return matplotlib.rc_context(STYLE | more)


def sheet(width_in: float, count: int = 1, *, height_in: float = 2.3, **kwargs: Any) -> tuple[Figure, list[Axes]]:
    """Return a figure with panels: beside each other on a page's width, above each other in a column.

    `height_in` is that of a panel; `kwargs` go to matplotlib's `subplots`.
    """
    across = 1 if width_in < NARROW_IN else count
    down = -(-count // across)
    figure = Figure(figsize=(width_in, height_in * down), layout="constrained")
    panels = figure.subplots(down, across, squeeze=False, **kwargs)
    return figure, list(panels.ravel())


def label(axes: Axes, x: str, y: str) -> None:
    """Name the axes, and take away what carries nothing."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(True, color=GRID, linewidth=STYLE["grid.linewidth"])  # also in axes of somebody who has another style
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def legend(figure: Figure, axes: Axes | None = None, *, texts: Sequence[str] = ()) -> None:
    """Put what the lines of some axes mean above the panels, in as many columns as fit; `texts` names only these."""
    handles, labels = (axes or figure.axes[0]).get_legend_handles_labels()
    kept = [k for k, text in enumerate(labels) if not texts or text in texts]
    if not kept:
        return
    width = 0.55 + 0.066 * max(len(labels[k]) for k in kept)
    columns = max(1, min(len(kept), int((figure.get_figwidth() - 0.2) / width)))
    # Lines of a legend beyond two do not take from the panels.
    lines = -(-len(kept) // columns)
    figure.set_figheight(figure.get_figheight() + LINE_IN * max(0, lines - 2))
    figure.legend(
        [handles[k] for k in kept],
        [labels[k] for k in kept],
        loc="outside upper left",
        ncols=columns,
        columnspacing=1.2,
    )


def drawn(draw: Draw, width_in: float, kinds: Iterable[str], salt: str = "") -> dict[str, bytes]:
    """Draw once and return the files of it: "svg", "pdf" and "png".

    `salt` tells apart what drawings on one page call their parts. What each panel shows, and where, is in the
    drawing's metadata as JSON, for pages that read off values under a pointer.
    """
    with style(**{"svg.hashsalt": salt or "uwbcal"}), warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", "Glyph .* missing"
        )  # names of bodies may be in any script: they show as boxes
        figure = draw(width_in)
        engine = figure.get_layout_engine()
        if engine is not None:
            # Place the panels once, not once for each file.
            engine.execute(figure)
            figure.set_layout_engine("none")
        return {kind: _file(figure, kind) for kind in kinds}


def picture(draw: Draw, kind: str, width_in: float = PAGE_IN) -> bytes:
    """Return a figure as the bytes of a "png", "svg" or "pdf" file."""
    return drawn(draw, width_in, [kind])[kind]


def _file(figure: Figure, kind: str) -> bytes:
    data = io.BytesIO()
    metadata = dict(METADATA.get(kind, {}))
    if kind == "svg":
        metadata["Description"] = json.dumps(_panels(figure), separators=(",", ":"))
    # A picture stands alone, on white; drawings take the ground of what they are put on.
    ground = "white" if kind == "png" else "none"
    figure.savefig(data, format=kind, dpi=RASTER_DPI, metadata=metadata, facecolor=ground)
    return data.getvalue()


def _panels(figure: Figure) -> list[dict[str, Any]]:
    """Say of each panel where it is (left, top, right, bottom in points) and what its axes run over."""
    width, height = 72 * figure.get_figwidth(), 72 * figure.get_figheight()
    found = []
    for axes in figure.axes:
        place, scales = axes.get_position(), [axes.get_xscale(), axes.get_yscale()]
        if not axes.get_visible() or not set(scales) <= {"linear", "log"}:
            continue
        box = (place.x0 * width, (1 - place.y1) * height, place.x1 * width, (1 - place.y0) * height)
        found.append(
            {
                "box": [round(float(v), 1) for v in box],
                "x": [float(f"{v:.5g}") for v in axes.get_xlim()],
                "y": [float(f"{v:.5g}") for v in axes.get_ylim()],
                "scale": scales,
                "names": [axes.get_xlabel() or _shared(figure, "x"), axes.get_ylabel() or _shared(figure, "y")],
            }
        )
    return found


def _shared(figure: Figure, which: str) -> str:
    return str(figure.get_supxlabel() if which == "x" else figure.get_supylabel())


def mark(artist: Any, text: str) -> None:
    """Give a line or points a name that a page shows when the pointer is on it."""
    artist.set_gid(f"series-{text}")
