"""Pictures of a recording beside its twin."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from uwblink.arrays import Floats
from uwblink.pages.colours import BLUE, PALE, VERMILION
from uwblink.pages.figures import NARROW_IN, legend, mark
from uwbsim.twins import Compared

BINS: Final = 40
MEASURED, SIMULATED = BLUE, VERMILION


def marginals(width_in: float, found: Sequence[Compared]) -> Figure:
    """Draw the distributions of both sides, one panel a quantity; the outermost bins hold what lies beyond them."""
    columns = 1 if width_in < NARROW_IN else 3
    rows = -(-len(found) // columns)
    figure = Figure(figsize=(width_in, 1.7 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, one in zip(panels, found, strict=False):
        _marginal(axes, one)
    for axes in panels[len(found) :]:
        axes.axis("off")
    legend(figure, panels[0])
    return figure


def _marginal(axes: Axes, one: Compared) -> None:
    both = np.concatenate([one.measured, one.simulated])
    low, high = np.quantile(both, [0.005, 0.995])
    edges = np.linspace(low, high if high > low else low + 1, BINS + 1)
    _step(axes, one.measured, edges, MEASURED, "measured")
    _step(axes, one.simulated, edges, SIMULATED, "simulated")
    axes.set_title(one.name, loc="left")
    axes.set_xlabel(one.unit)
    axes.set_yticks([])


def _step(axes: Axes, values: Floats, edges: Floats, colour: str, label: str) -> None:
    share = np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0] / len(values)
    mark(axes.stairs(share, edges, color=colour, label=label, linewidth=1.2), label)


def by_pair(width_in: float, found: Sequence[Compared], fewest: int = 5) -> Figure:
    """Draw medians, 90 % quantiles and autocorrelations of pairs, simulated over measured, one row a quantity."""
    narrow = width_in < NARROW_IN
    shape = (3 * len(found), 1) if narrow else (len(found), 3)
    figure = Figure(figsize=(width_in, 2.3 * shape[0]), layout="constrained")
    panels = figure.subplots(*shape, squeeze=False).reshape(len(found), 3)
    for row, one in zip(panels, found, strict=True):
        pairs = [pair for pair in one.pairs.values() if pair["count"] >= fewest]
        for axes, what, name in zip(row, ("median", "high", "lag1"), ("median", "90 %", "to the next"), strict=True):
            points = np.array([[pair[f"{what}_measured"], pair[f"{what}_simulated"]] for pair in pairs]).reshape(-1, 2)
            _diagonal(axes, points[np.isfinite(points).all(axis=1)])
            unit = "autocorrelation" if what == "lag1" else one.unit
            axes.set_title(f"{one.name}:\n{name}", loc="left")
            axes.set_xlabel(f"measured ({unit})")
            axes.set_ylabel("simulated")
    return figure


def _diagonal(axes: Axes, points: Floats) -> None:
    if not len(points):
        axes.text(0.5, 0.5, "too few exchanges a pair", ha="center", va="center", transform=axes.transAxes)
        return
    low, high = float(points.min()), float(points.max())
    axes.plot([low, high], [low, high], color=PALE, linewidth=1)
    axes.plot(points[:, 0], points[:, 1], "o", color=MEASURED, markersize=3.5, alpha=0.7)
