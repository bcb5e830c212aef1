"""Figures of a sweep: what came out over what was varied, with bands over seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from uwblink.arrays import Floats
from uwblink.pages.colours import look
from uwblink.pages.figures import NARROW_IN, label, legend, mark, sheet

COLOURS: Final = "cividis"
"""Of heat maps: it grows lighter evenly, and alike for all eyes."""

MOST_GROUPS: Final = 12
"""Values of a key that are averaged apart; more are put into so many groups."""

MOST_MAPS: Final = 4


@dataclass(frozen=True, slots=True)
class Swept:
    """Rows of a sweep as columns: `values` (rows,) by key, `protocol` (rows,), and one figure (rows,), NaN if none."""

    values: dict[str, Sequence[Any]]
    protocol: Sequence[str]
    figure: Floats

    def protocols(self) -> list[str]:
        """Return the protocols, in the order of the rows."""
        return list(dict.fromkeys(self.protocol))

    def rows_of(self, protocol: str) -> Any:
        """Return which rows are of a protocol and have the figure (rows,)."""
        return np.array([name == protocol for name in self.protocol]) & np.isfinite(self.figure)


def figure_over_keys(width_in: float, swept: Swept, name: str) -> Figure:
    """Draw a figure: as heat map over two keys of numbers, else over each key apart, as medians in bands.

    A band holds all seeds and all values of the other keys.
    """
    keys = list(swept.values)
    if len(keys) == 2 and all(_numbers(swept.values[key]) is not None for key in keys) and _is_grid(swept):
        return _heat_maps(width_in, swept, keys, name)
    figure, panels = sheet(width_in, max(len(keys), 1), height_in=2.6)
    for axes, key in zip(panels, keys, strict=False):
        _lines(axes, swept, key)
        label(axes, key.replace(".", ".\N{ZERO WIDTH SPACE}"), name)
    legend(figure, panels[0])
    return figure


def _lines(axes: Axes, swept: Swept, key: str) -> None:
    """Draw medians over a key, a line a protocol, in bands from the least to the largest."""
    numbers = _numbers(swept.values[key])
    words = [str(value) for value in swept.values[key]]
    places = numbers if numbers is not None else np.unique(words, return_inverse=True)[1].astype(np.float64)
    for k, protocol in enumerate(swept.protocols()):
        rows = swept.rows_of(protocol)
        if not rows.any():
            continue
        x, group = _grouped(places[rows])
        y = swept.figure[rows]
        low, middle, high = np.array([np.quantile(y[group == g], (0, 0.5, 1)) for g in range(len(x))]).T
        own = look(k)
        if np.any(high > low):
            axes.fill_between(x, low, high, color=own.colour, alpha=0.18, lw=0)
        mark(axes.plot(x, middle, label=protocol, **own.line())[0], protocol)
    if numbers is None:
        names = np.unique(words)
        axes.set_xticks(np.arange(len(names)), list(names))
    elif numbers.min() > 0 and numbers.max() > 30 * numbers.min():
        axes.set_xscale("log")


def _heat_maps(width_in: float, swept: Swept, keys: list[str], name: str) -> Figure:
    """Draw medians over seeds as colours over two keys, a panel a protocol."""
    protocols = swept.protocols()[:MOST_MAPS]
    across = 1 if width_in < NARROW_IN else min(2, len(protocols))
    down = -(-len(protocols) // across)
    figure = Figure(figsize=(width_in, 2.6 * down), layout="constrained")
    panels = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True).ravel()
    x, y = (np.asarray(_numbers(swept.values[key])) for key in keys)
    ticks = [np.unique(x), np.unique(y)]
    shown = [_medians(swept, protocol, x, y, ticks) for protocol in protocols]
    low, high = (
        float(f([f(one[np.isfinite(one)]) for one in shown if np.isfinite(one).any()])) for f in (np.min, np.max)
    )
    for axes, protocol, values in zip(panels, protocols, shown, strict=False):
        image = axes.pcolormesh(
            np.arange(len(ticks[0]) + 1), np.arange(len(ticks[1]) + 1), values, cmap=COLOURS, vmin=low, vmax=high
        )
        for set_ticks, own in ((axes.set_xticks, ticks[0]), (axes.set_yticks, ticks[1])):
            kept = np.arange(len(own))[:: max(1, len(own) // 6)]
            set_ticks(kept + 0.5, [f"{own[k]:g}" for k in kept])
        axes.set_title(protocol, loc="left")
    for axes in panels[len(protocols) :]:
        axes.set_visible(False)
    figure.colorbar(image, ax=list(panels), label=name)
    figure.supxlabel(keys[0], fontsize="medium")
    figure.supylabel(keys[1], fontsize="medium")
    return figure


def _medians(swept: Swept, protocol: str, x: Floats, y: Floats, ticks: list[Floats]) -> Floats:
    rows = swept.rows_of(protocol)
    found = np.full((len(ticks[1]), len(ticks[0])), np.nan)
    column, row = np.searchsorted(ticks[0], x[rows]), np.searchsorted(ticks[1], y[rows])
    for place in set(zip(row.tolist(), column.tolist(), strict=True)):
        found[place] = np.median(swept.figure[rows][(row == place[0]) & (column == place[1])])
    return found


def _is_grid(swept: Swept) -> bool:
    """Return whether two keys of numbers meet in every combination: else a map would be mostly holes."""
    first, second = (np.asarray(_numbers(values)) for values in swept.values.values())
    met = len(set(zip(first.tolist(), second.tolist(), strict=True)))
    return met == len(np.unique(first)) * len(np.unique(second)) and len(np.unique(first)) > 1


def _numbers(values: Sequence[Any]) -> Floats | None:
    """Return values as numbers (rows,), or None where one is none."""
    if not all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        return None
    return np.array(values, dtype=np.float64)


def _grouped(places: Floats) -> tuple[Floats, Any]:
    """Return where values (rows,) are drawn, and each one's group: single values if few, else groups of equal size."""
    alone, group = np.unique(places, return_inverse=True)
    if len(alone) <= MOST_GROUPS:
        return alone, group
    edges = np.quantile(places, np.linspace(0, 1, MOST_GROUPS + 1))
    group = np.clip(np.searchsorted(edges, places, side="right") - 1, 0, MOST_GROUPS - 1)
    kept, group = np.unique(group, return_inverse=True)
    return np.array([np.median(places[group == g]) for g in range(len(kept))]), group
