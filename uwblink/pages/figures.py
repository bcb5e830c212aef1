"""Figures at paper size: style, figures with panels, common elements, and files."""

from __future__ import annotations

import base64
import io
import json
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from html import escape
from typing import Any, Final

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from uwblink.arrays import Floats, Ints
from uwblink.pages.colours import BLUE, GRID, INK, MUTED

WIDTHS: Final = {"column": 3.5, "page": 7.16}
"""Widths of printed figures in inches: one column, and both columns, of an IEEE page."""

NARROW_IN: Final = 5.0
"""Figures below this width have their panels above each other."""

STYLE: Final[Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.0,
    "axes.labelsize": "medium",
    "axes.titlesize": "medium",
    "axes.titlelocation": "left",
    "xtick.labelsize": "medium",
    "ytick.labelsize": "medium",
    "legend.fontsize": "medium",
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
"""Settings of Matplotlib: text of 8 pt, as journals require; embedded TrueType fonts; text in SVG remains text."""

Draw = Callable[[float], Figure]
"""A function that draws a figure of a width in inches."""


def style(**more: Any) -> AbstractContextManager[None]:
    """Return a context manager with the settings of figures at paper size, `STYLE` and `more`."""
    return matplotlib.rc_context(STYLE | more)


def sheet(
    width_in: float,
    count: int = 1,
    *,
    height_in: float = 2.3,
    across: int | None = None,
    down: int | None = None,
    **kwargs: Any,
) -> tuple[Figure, list[Axes]]:
    """Return a figure with `count` panels, beside each other at the width of a page, above each other in a column.

    `height_in` is the height of a panel. `across` and `down` set the numbers of columns and rows; panels beyond `count`
    are hidden. `kwargs` are arguments of matplotlib's `subplots`.
    """
    across = across or (1 if width_in < NARROW_IN else count)
    down = down or -(-count // across)
    figure = Figure(figsize=(width_in, height_in * down), layout="constrained")
    panels = list(figure.subplots(down, across, squeeze=False, **kwargs).ravel())
    for axes in panels[count:]:
        axes.set_visible(False)
    return figure, panels[:count]


def label(axes: Axes, x: str, y: str) -> None:
    """Label the axes, draw a grid, and hide the upper and right edges."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(True, color=GRID, linewidth=STYLE["grid.linewidth"])  # also in axes with another style
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def legend(figure: Figure, axes: Axes | None = None, *, texts: Sequence[str] = ()) -> None:
    """Draw the legend of some axes (by default the first) above the panels; `texts` selects entries."""
    handles, labels = (axes or figure.axes[0]).get_legend_handles_labels()
    kept = [k for k, text in enumerate(labels) if not texts or text in texts]
    if not kept:
        return
    # Widths in inches of a handle with its gaps, and of a letter of 8 pt.
    width = 0.55 + 0.066 * max(len(labels[k]) for k in kept)
    columns = max(1, min(len(kept), int((figure.get_figwidth() - 0.2) / width)))
    # If the legend has more than two lines, enlarge the figure, so that its panels keep their height. A line: 0.165 in.
    lines = -(-len(kept) // columns)
    figure.set_figheight(figure.get_figheight() + 0.165 * max(0, lines - 2))
    figure.legend(
        [handles[k] for k in kept],
        [labels[k] for k in kept],
        loc="outside upper left",
        ncols=columns,
        columnspacing=1.2,
    )


def outlines(
    axes: Axes,
    samples: Mapping[str, Floats],
    edges: Floats,
    lines: Mapping[str, Mapping[str, Any]],
    *,
    ends: bool = True,
) -> None:
    """Draw histograms of samples (n,) in bins between `edges`, in per cent; `lines` are the styles of the samples.

    The outermost bins include all values beyond them; with `ends`, labels of the axis state that.
    """
    low, high = float(edges[0]), float(edges[-1])
    for name, values in samples.items():
        share = np.histogram(np.clip(values, low, np.nextafter(high, low)), edges)[0] * (100 / len(values))
        mark(axes.stairs(share, edges, **lines[name]), name)
    if ends:
        axes.set_xlim(low, high)
        reach = 0.12 * (high - low)
        inner = [t for t in axes.get_xticks() if low + reach < t < high - reach]
        names = [f"≤ {low:.0f}", *(f"{t:g}" for t in inner), f"≥ {high:.0f}"]
        axes.set_xticks([low, *inner, high], [name.replace("-", "−") for name in names])


def series(
    axes: Axes, x: Floats, y: Floats, between: tuple[Floats, Floats] | None = None, *, band: str = "", **line: Any
) -> None:
    """Draw a line, and a band between two other lines if given; `band` is the label of the band."""
    if between is not None and np.any(between[1] > between[0]):
        axes.fill_between(x, *between, color=line["color"], alpha=0.25, lw=0, label=band)
    mark(axes.plot(x, y, **line)[0], line["label"])


def dots(axes: Axes, x: Floats, y: Floats, **line: Any) -> None:
    """Draw points (n,), at most about 3000 of them; the more points, the smaller they are."""
    every = slice(None, None, max(len(x) // 3000, 1))
    size = float(np.clip(66 / np.sqrt(max(len(x), 1)), 1.2, 4.0))
    axes.plot(x[every], y[every], ".", ms=size, rasterized=True, **line)


def bulk(values: Floats) -> tuple[float, float]:
    """Return limits of an axis for values (n,) without outliers, with more room above, where reflections are."""
    low, high = np.quantile(values, (0.003, 0.985))
    margin = 0.1 * float(high - low) + 0.1
    return float(low) - margin, float(high) + margin


def values_over_time(width_in: float, time_ns: Ints, values: Floats, name: str) -> Figure:
    """Draw values (n,) over times in ns (n,), or over their numbers if all times are equal; NaN is left out."""
    figure, (axes,) = sheet(width_in, height_in=1.9)
    rows = np.flatnonzero(np.isfinite(values))
    timed = len(rows) > 0 and np.ptp(time_ns[rows]) > 0
    dots(
        axes,
        (time_ns[rows] - time_ns[rows].min()) * 1e-9 if timed else rows.astype(np.float64),
        values[rows],
        color=BLUE,
    )
    if len(rows):
        axes.set_ylim(*bulk(values[rows]))
    label(axes, "time (s)" if timed else "number of the range", name)
    return figure


def mark(artist: Any, text: str) -> None:
    """Give a line or points a name that an HTML page shows at the pointer."""
    artist.set_gid(f"series-{text}")


def drawn(draw: Draw, width_in: float, kinds: Iterable[str], salt: str = "") -> dict[str, bytes]:
    """Draw a figure once and return its files by kind: "svg", "pdf" and "png".

    `salt` makes the ids in drawings of one page different. The metadata of an SVG contain position, scales and labels
    of each panel as JSON, so that a page can show the values at the pointer.
    """
    with style(**{"svg.hashsalt": salt or "uwbcal"}), warnings.catch_warnings():
        # Names of bodies may be in any script; letters that the font lacks are drawn as boxes.
        warnings.filterwarnings("ignore", "Glyph .* missing")
        figure = draw(width_in)
        engine = figure.get_layout_engine()
        if engine is not None:
            # Compute the layout once for all files.
            engine.execute(figure)
            figure.set_layout_engine("none")
        return {kind: _file(figure, kind) for kind in kinds}


def picture(draw: Draw, kind: str, width_in: float = WIDTHS["page"]) -> bytes:
    """Return a figure as the bytes of a "png", "svg" or "pdf" file."""
    return drawn(draw, width_in, [kind])[kind]


def notebook_image(draw: Draw, text: str) -> str:
    """Return a figure as an image in HTML, for notebooks; `text` is its alternative text."""
    data = base64.b64encode(picture(draw, "png")).decode()
    return f'<img alt="{escape(text)}" style="width: 100%; max-width: 44em" src="data:image/png;base64,{data}">'


def _file(figure: Figure, kind: str) -> bytes:
    data = io.BytesIO()
    # Without dates, the same data give the same bytes.
    metadata: dict[str, Any] = {"CreationDate": None} if kind == "pdf" else {}
    if kind == "svg":
        panels = json.dumps(_panels(figure), separators=(",", ":"))
        metadata = {"Date": None, "Creator": None, "Description": panels}
    # A PNG has a white background; SVG and PDF are transparent. 220 dpi is also that of rasterised points in these.
    ground = "white" if kind == "png" else "none"
    figure.savefig(data, format=kind, dpi=220, metadata=metadata, facecolor=ground)
    return data.getvalue()


def _panels(figure: Figure) -> list[dict[str, Any]]:
    """Return box (left, top, right, bottom, in points), limits, scales and labels of each panel."""
    width, height = 72 * figure.get_figwidth(), 72 * figure.get_figheight()
    found = []
    for axes in figure.axes:
        place, scales = axes.get_position(), [axes.get_xscale(), axes.get_yscale()]
        if not axes.get_visible() or not set(scales) <= {"linear", "log"} or axes.name == "polar":
            continue
        box = (place.x0 * width, (1 - place.y1) * height, place.x1 * width, (1 - place.y0) * height)
        names = [axes.get_xlabel() or figure.get_supxlabel(), axes.get_ylabel() or figure.get_supylabel()]
        found.append(
            {
                "box": [round(float(v), 1) for v in box],
                "x": [float(f"{v:.5g}") for v in axes.get_xlim()],
                "y": [float(f"{v:.5g}") for v in axes.get_ylim()],
                "scale": scales,
                "names": list(map(str, names)),
            }
        )
    return found
