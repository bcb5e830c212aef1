"""Figures of scenarios, protocols, sweeps and twins, each drawn at a width in inches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import LogLocator, NullLocator
from numpy.typing import NDArray
from scipy.stats import binned_statistic_2d

from uwblink.arrays import Bools, Floats
from uwblink.pages.colours import BLUE, GRID, INK, MUTED, PALE, SERIES, VERMILION, Look, look
from uwblink.pages.figures import NARROW_IN, label, legend, mark, outlines, series, sheet
from uwblink.protocols.table import PROTOCOLS, RangingProtocol
from uwblink.ticks import ANTENNA_DELAY_TICKS, METRES_PER_TICK, TICK_S
from uwbsim.protocols.comparison import BestDelay, ErrorCurve
from uwbsim.protocols.conditions import Conditions, exchange, interval_stamps
from uwbsim.scenario.bodies import Obstacle, Room
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.ranging import after_marker_s, before_marker_s, message_bytes
from uwbsim.twins import Compared
from uwbsim.world.world import World


def three_digits(value: Any) -> str:
    """Return a number with three digits, or all before the point: 0.123, 17.9, 1012."""
    return f"{value:#.3g}".rstrip(".") if abs(value) < 999.5 else f"{value:.0f}"


def _plain_ticks(axis: Axis) -> None:
    """Label a logarithmic axis with plain numbers: 1, 2 and 5 of each decade, or decades where it crosses zero."""
    if axis.get_scale() == "log":
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_locator(NullLocator())


def histograms(width_in: float, samples: Mapping[str, Floats]) -> Figure:
    """Draw errors of raw ranges, one outline a protocol; the outermost bins hold everything beyond them.

    Errors about medians farther apart than the narrowest distribution is wide are drawn less their medians.
    """
    figure, (axes,) = sheet(width_in, height_in=2.9)
    medians = {name: float(np.median(errors)) for name, errors in samples.items()}
    best = min((np.quantile(e, (0.005, 0.995)) for e in samples.values()), key=np.ptp)
    apart = np.ptp([*medians.values()]) > np.ptp(best) > 0
    if apart:
        samples = {name: errors - medians[name] for name, errors in samples.items()}
        best = min((np.quantile(e, (0.005, 0.995)) for e in samples.values()), key=np.ptp)
    margin = 0.25 * np.ptp(best) + 1e-4
    # Single-sided ranges at one distance are whole half ticks: bins of as many of these each show no spikes.
    width = METRES_PER_TICK / 2 * np.ceil((np.ptp(best) + 2 * margin) / 40 / METRES_PER_TICK)
    edges = 100 * np.arange(best[0] - margin, best[1] + margin + width, width)
    titles = {name: f"{name}, median {100 * medians[name]:+.1f} cm" if apart else name for name in samples}
    looks = {name: look(k).line(marker=False) | {"label": titles[name]} for k, name in enumerate(samples)}
    outlines(axes, {name: 100 * errors for name, errors in samples.items()}, edges, looks)
    hills: list[Any] = list(axes.patches)
    heights = [hill.get_data().values for hill in hills]
    top = 1.15 * max(inside[1:-1].max() for inside in heights)
    for edge, side, at in ((0, "left", edges[1]), (-1, "right", edges[-2])):
        if (share := max(inside[edge] for inside in heights)) > top > 0:
            # A distribution that is far wider than the others would flatten them.
            axes.set_ylim(0, top)
            axes.annotate(
                f"{share:.0f} %", (at, top), xytext=(4 if side == "left" else -4, -2), textcoords="offset points",
                ha=side, va="top", fontsize="small",
            )  # fmt: skip
    label(axes, "range error less its median (cm)" if apart else "range error (cm)", "ranges (%)")
    legend(figure)
    return figure


def error_over(width_in: float, curves: Mapping[str, ErrorCurve], x: str, *, logarithmic: bool = False) -> Figure:
    """Draw bias and standard deviation over something: simulated as points, predicted as lines."""
    figure, (left, right) = sheet(width_in, 2)
    for k, (name, c) in enumerate(curves.items()):
        line = look(k).line()
        for axes, simulated, predicted in ((left, c.bias_m, c.predicted_bias_m), (right, c.std_m, c.predicted_std_m)):
            axes.plot(c.x, 100 * predicted, **line | {"marker": ""})
            mark(axes.plot(c.x, 100 * simulated, **line | {"ls": ""})[0], name)
        left.plot([], [], label=name, **line)
    biases = 100 * np.concatenate([bias for c in curves.values() for bias in (c.bias_m, c.predicted_bias_m)])
    spreads = 100 * np.concatenate([c.std_m for c in curves.values()])
    wide, steep = np.abs(biases).max() > 20, spreads.max() > 10 * spreads.min()
    label(left, x, "bias (cm), log axis" if wide else "bias (cm)")
    label(right, x, "std (cm), log axis" if steep else "standard deviation (cm)")
    if wide:
        # Biases have a sign: to scale about zero, logarithmic beyond a centimetre.
        left.set_yscale("symlog", linthresh=1.0)
        _plain_ticks(left.yaxis)
    if steep:
        right.set_yscale("log")
        _plain_ticks(right.yaxis)
    else:
        right.set_ylim(0, 1.1 * spreads.max())
    for axes in (left, right):
        if logarithmic:
            axes.set_xscale("log")
            _plain_ticks(axes.xaxis)
        else:
            axes.locator_params(axis="x", nbins=6)  # nine of powers cover each other
    legend(figure, left)
    return figure


def optimum_curve(width_in: float, found: BestDelay) -> Figure:
    """Draw the root mean squared error of one range, and of the mean of a second full of them, over the delay."""
    figure, panels = sheet(width_in, 2)
    delays, best = 1e6 * found.delays_s, 1e6 * found.delay_s
    range_cm, second_mm = 100 * np.sqrt(found.range_m2), 1000 * np.sqrt(found.second_m2)
    curves = (
        (range_cm, 100 * found.rms_m, "error of one range (cm)"),
        (second_mm, 1000 * found.second_rms_m, "error of the mean of one second (mm)"),
    )
    for axes, (curve, y, name) in zip(panels, curves, strict=True):
        axes.plot(delays, curve, color=BLUE)
        axes.plot([best], [y], "o", color=VERMILION)
        axes.annotate(f"{best:.0f} µs", (best, y), (6, 8), textcoords="offset points")
        axes.set_xscale("log")
        _plain_ticks(axes.xaxis)
        label(axes, "delay of the scheduled message (µs)", name)
    return figure


def room(width_in: float, scenario: Scenario) -> Figure:
    """Draw bodies' paths, tags at the start, obstacles and the room's walls, from above and from the side, to scale."""
    world = World(scenario)
    time = np.linspace(0, min(scenario.run.duration_s, 120.0), 1200)
    paths = {body.name: world.trajectories[body.name].position_m(time) for body in scenario.bodies}
    spots, _ = world.antennas(np.arange(len(scenario.tags)), np.zeros(len(scenario.tags)))
    tags = {tag.id: spot for tag, spot in zip(scenario.tags, spots, strict=True)}
    boxes: list[tuple[Obstacle | Room, str, dict[str, Any]]] = [
        *((box, box.name, {"fc": GRID, "ec": MUTED, "lw": 0.6}) for box in scenario.obstacles),
        *((box, "", {"fill": False, "ec": INK, "lw": 1.2, "zorder": 1}) for box in [scenario.room] if box),
    ]
    corners = [np.array([box.min_m, box.max_m]) for box, _, _ in boxes]
    points = np.concatenate([*paths.values(), spots, *corners])
    # What is drawn is at least a metre large, with a margin.
    middle, half = (points.max(axis=0) + points.min(axis=0)) / 2, np.maximum(np.ptp(points, axis=0) / 2, 0.5)
    half = half + (0.04 if scenario.room else 0.12) * float(half.max())
    low, high = middle - half, middle + half
    # Panels are as high as their views at the scale that the width allows, above each other in a column.
    narrow, heights = width_in < NARROW_IN, half[1:] / half[0] * (width_in - 0.7)
    height_in = min(float(heights.mean() if narrow else heights.max() / 2), 4.2) + 0.6
    figure, panels = sheet(width_in, 2, height_in=height_in, height_ratios=heights if narrow else None)
    for axes, (x, y), name in zip(panels, ((0, 1), (0, 2)), ("from above", "from the side"), strict=True):
        for (_, text, line), ends in zip(boxes, corners, strict=True):
            (left, bottom), (wide, tall) = ends[0, [x, y]], np.ptp(ends, axis=0)[[x, y]]
            axes.add_patch(Rectangle((left, bottom), wide, tall, **line))
            if min(wide, tall) > 0.1 * half[0]:
                middle_x, middle_y, turned = left + wide / 2, bottom + tall / 2, 90 if tall > wide else 0
                axes.text(middle_x, middle_y, text, ha="center", va="center", rotation=turned, color=INK)
        for k, body in enumerate(scenario.bodies):
            own = {tag.id: tags[tag.id][[x, y]] for tag in scenario.tags if tag.body == body.name}
            _draw_body(axes, body.name, paths[body.name][:, [x, y]], own, look(k))
            if axes is panels[0] and own:
                _number_tags(axes, own, middle[[x, y]])
        limits: dict[str, Any] = {"xlim": (low[x], high[x]), "ylim": (low[y], high[y]), "aspect": "equal"}
        axes.set(title=name, xlabel=f"{'xyz'[x]} (m)", ylabel=f"{'xyz'[y]} (m)", axisbelow=True, **limits)
        axes.grid(True)
    legend(figure, panels[0])
    figure.draw_without_rendering()  # only a second layout knows the sizes that equal scales leave
    return figure


def _draw_body(axes: Axes, name: str, path: Floats, tags: Mapping[int, Floats], own: Look) -> None:
    """Draw a path (n, 2), and tags."""
    axes.plot(*path.T, color=own.colour, lw=0.6, alpha=0.6)
    spots = np.array(list(tags.values())).reshape(-1, 2)
    mark(axes.plot(*spots.T, own.marker, color=own.colour, ms=4, label=name, zorder=10)[0], name)


def _number_tags(axes: Axes, tags: Mapping[int, Floats], middle: Floats) -> None:
    """Write the numbers of a body's tags at the first, towards `middle` (2,), above all paths."""
    first = next(iter(tags.values()))
    left, down = (first > middle).tolist()
    place: dict[str, Any] = {"ha": "right" if left else "left", "va": "top" if down else "bottom", "color": INK}
    ground = {"boxstyle": "round,pad=0.15", "fc": GRID, "ec": "none", "alpha": 0.85}
    away = (-6 if left else 6, -6 if down else 6)
    text = ", ".join(map(str, tags))
    axes.annotate(text, tuple(first), away, textcoords="offset points", bbox=ground, zorder=9, **place)


def timing(width_in: float, scenario: Scenario, name: str) -> Figure:
    """Draw one exchange with the scenario's delays: who sends what when, each stamp, and all intervals.

    Stamps have the names of ICRA 2023 (Fig. 2) beside them. Clocks are exact, and flights too short to be seen.
    """
    protocol, narrow, ranging = PROTOCOLS[name], width_in < NARROW_IN, scenario.ranging
    # A delayed frame leaves later than scheduled by the antenna delay of its board.
    scheduled_s = ranging.scheduled_s + ANTENNA_DELAY_TICKS * TICK_S
    found = exchange(protocol, Conditions.single(at_once=ranging.reply.median_s, scheduled=scheduled_s))
    stamps_us = {stamp: float(ticks[0]) * TICK_S * 1e6 for stamp, ticks in found.stamps.items()}
    figure, (axes,) = sheet(width_in, height_in=2.3)
    for level in (0, 1):
        axes.axhline(level, color=MUTED, lw=0.8)
    _draw_messages(axes, scenario, protocol, stamps_us)
    _draw_spans(axes, protocol, stamps_us, width_in)
    names = [f"{side} {tag}" for side, tag in zip(("initiator", "target"), scenario.pairs()[0], strict=True)]
    axes.set_yticks([1, 0], names, rotation=90 if narrow else 0, va="center")
    marker = "marker" if narrow else "ranging marker"
    axes.set(ylim=(-0.8, 1.8), xlabel=f"time since the poll's {marker} (µs)", title=protocol.title)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    axes.autoscale_view(scaley=False)
    return figure


def _draw_messages(axes: Axes, scenario: Scenario, protocol: RangingProtocol, stamps_us: Mapping[str, float]) -> None:
    """Draw each message on the lane of its sender (initiator 1, target 0), and its stamps on both lanes."""
    before = before_marker_s(scenario.radio.preamble_symbols) * 1e6
    for k, (message, size) in enumerate(zip(protocol.messages, message_bytes(protocol), strict=True)):
        y, at_us = 1.0 if message.sender == "initiator" else 0.0, stamps_us[f"tx{k + 1}"]
        parts = [(at_us - before, before), (at_us, after_marker_s(size) * 1e6)]
        axes.broken_barh(parts, (y - 0.09, 0.18), facecolors=[(SERIES[k], 0.35), (SERIES[k], 0.9)])
        arrow: dict[str, Any] = {"arrowstyle": "->", "color": SERIES[k], "lw": 1.2}
        axes.annotate("", (at_us, 1.0 - y), (at_us, y), arrowprops=arrow)
        for level, text in ((y, f"tx{k + 1} (t{2 * k + 1})"), (1.0 - y, f"rx{k + 1} (t{2 * k + 2})")):
            # In two lines by turns: neighbours may be closer than their names are long.
            away = (22 if k % 2 else 9) * (1 if level else -1)
            upright: dict[str, Any] = {"ha": "center", "va": "bottom" if level else "top"}
            axes.annotate(text, (at_us, level), (0, away), textcoords="offset points", **upright)


def _draw_spans(axes: Axes, protocol: RangingProtocol, stamps_us: Mapping[str, float], width_in: float) -> None:
    """Draw the intervals a time of flight is made of between the lanes, with name and length.

    dt53 is the third leg as its sender has it, dt64 as its receiver.
    """
    for name, (second, first) in interval_stamps(protocol).items():
        # The initiator's intervals stand above.
        sends = protocol.messages[int(first[2]) - 1].sender == "initiator"
        above, left, right = sends == first.startswith("tx"), stamps_us[first], stamps_us[second]
        level = 0.62 if above else 0.38
        axes.annotate("", (right, level), (left, level), arrowprops={"arrowstyle": "<->", "color": MUTED, "lw": 0.7})
        text = f"{name} = {right - left:.1f} µs"
        if (right - left) / max(stamps_us.values()) * (width_in - 1.2) < 0.074 * len(text):
            text = name
        place, away = ((left + right) / 2, level), (0, 1.5 if above else -1.5)
        upright: dict[str, Any] = {"ha": "center", "va": "bottom" if above else "top", "color": INK}
        axes.annotate(text, place, away, textcoords="offset points", **upright)


def result_over_keys(
    width_in: float, keys: Mapping[str, Sequence[Any]], protocol: Sequence[str], result: Floats, name: str
) -> Figure:
    """Draw a result (rows,), NaN where there is none, over the values of keys (rows,) and for each protocol.

    Over two keys of numbers that form a grid it is a map, else a line over each key: medians in bands that hold all
    seeds and all values of the other keys.
    """
    found = np.isfinite(result)
    rows = {one: found & (np.array(protocol) == one) for one in dict.fromkeys(protocol)}
    columns = {key: np.array(values) for key, values in keys.items()}
    if len(columns) == 2 and all(column.dtype.kind in "iuf" for column in columns.values()):
        (x, across), (y, up) = (np.unique(column, return_inverse=True) for column in columns.values())
        # Unless all combinations are there, a map would be mostly holes.
        if len(np.unique([across, up], axis=1).T) == len(x) * len(y) and len(x) > 1:
            return _maps(width_in, columns, rows, result, name)
    figure, panels = sheet(width_in, max(len(columns), 1), height_in=2.6)
    for axes, (key, column) in zip(panels, columns.items(), strict=False):
        _lines(axes, column, rows, result)
        label(axes, key, name)
    legend(figure, panels[0])
    return figure


def _lines(axes: Axes, column: NDArray[Any], rows: Mapping[str, Bools], result: Floats) -> None:
    """Draw medians over the values of a key (rows,), a line a protocol, in bands from the least to the largest."""
    numeric = column.dtype.kind in "iuf"
    names, places = np.unique(column, return_inverse=True)
    at = np.asarray(column if numeric else places, dtype=np.float64)
    for k, (protocol, own) in enumerate(rows.items()):
        values = np.unique(at[own])
        # Many values are drawn in groups of equal size.
        groups = [np.flatnonzero(own & (at == value)) for value in values]
        if len(groups) > 12:
            groups = np.array_split(np.flatnonzero(own)[np.argsort(at[own], kind="stable")], 12)
        if groups:
            x = np.array([np.median(at[group]) for group in groups])
            low, middle, high = np.array([np.quantile(result[group], (0, 0.5, 1)) for group in groups]).T
            series(axes, x, middle, (low, high), label=protocol, **look(k).line())
    if not numeric:
        axes.set_xticks(np.arange(len(names)), list(names))
    elif at.min() > 0 and at.max() > 30 * at.min():
        axes.set_xscale("log")


def _maps(
    width_in: float, keys: Mapping[str, NDArray[Any]], rows: Mapping[str, Bools], result: Floats, name: str
) -> Figure:
    """Draw medians over seeds as numbers and colours over two keys, a panel a protocol, four at most.

    Each panel has colours of its own, from its least to its largest value.
    """
    protocols = list(rows)[:4]
    across = 1 if width_in < NARROW_IN else min(2, len(protocols))
    figure, panels = sheet(width_in, len(protocols), height_in=2.6, across=across, sharex=True, sharey=True)
    (x, column), (y, row) = (np.unique(values, return_inverse=True) for values in keys.values())
    cells = [np.arange(len(y) + 1) - 0.5, np.arange(len(x) + 1) - 0.5]
    shown = [
        binned_statistic_2d(row[rows[one]], column[rows[one]], result[rows[one]], "median", cells).statistic
        for one in protocols
    ]
    # With up to eight columns, numbers of three digits fit beside each other.
    most_columns = 8
    for axes, protocol, values in zip(panels, protocols, shown, strict=True):
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
        # "cividis" grows lighter evenly, and alike for all eyes; values alike within a tenth do not span all of it.
        high = max(high, low + 0.1 * abs(low))
        axes.pcolormesh(cells[1], cells[0], values, cmap="cividis", vmin=low, vmax=high)
        for (up, right), value in np.ndenumerate(values if values.shape[1] <= most_columns else values[:0]):
            colour = "white" if value < (low + high) / 2 else "black"
            axes.text(right, up, three_digits(value).replace("-", "−"), ha="center", va="center", color=colour)
        for axis, own in ((axes.xaxis, x), (axes.yaxis, y)):
            kept = np.arange(len(own))[:: max(1, len(own) // 6)]
            axis.set_ticks(kept, labels=[f"{value:g}" for value in own[kept]])
        axes.set(title=f"{protocol}: {name}" if protocol else name)
    first, second = keys
    figure.supxlabel(first, fontsize="medium")
    figure.supylabel(second, fontsize="medium")
    return figure


def marginals(width_in: float, found: Sequence[Compared]) -> Figure:
    """Draw the distributions of both sides, one panel a quantity; the outermost bins hold what lies beyond them."""
    figure, panels = sheet(width_in, len(found), height_in=1.7, across=1 if width_in < NARROW_IN else 3)
    colours = {"measured": BLUE, "simulated": VERMILION}
    lines = {name: {"lw": 1.2, "color": colour, "label": name} for name, colour in colours.items()}
    for axes, one in zip(panels, found, strict=True):
        low, high = np.quantile(np.concatenate(one.drawn), [0.005, 0.995])
        edges = np.linspace(low, high if high > low else low + 1, 41)
        outlines(axes, dict(zip(colours, one.drawn, strict=True)), edges, lines, ends=False)
        axes.set(title=one.name, xlabel=one.unit, yticks=[])
    legend(figure, panels[0])
    return figure


def by_pair(width_in: float, found: Sequence[Compared]) -> Figure:
    """Draw medians, 90 % quantiles and autocorrelations of pairs, simulated over measured, one row a quantity."""
    figure, panels = sheet(width_in, 3 * len(found), across=1 if width_in < NARROW_IN else 3)
    columns = (("median", "median"), ("high", "90 %"), ("lag1", "to the next"))
    drawn = [(one, what, name) for one in found for what, name in columns]
    for axes, (one, what, name) in zip(panels, drawn, strict=True):
        pairs = [pair for pair in one.pairs.values() if pair[0].count >= 5]
        points = np.array([[getattr(side, what) for side in pair] for pair in pairs]).reshape(-1, 2)
        if np.isfinite(points).all(axis=1).any():
            ends = [np.nanmin(points), np.nanmax(points)]
            axes.plot(ends, ends, color=PALE, linewidth=1)
            axes.plot(*points.T, "o", color=BLUE, markersize=3.5, alpha=0.7)
        else:
            axes.text(0.5, 0.5, "too few exchanges a pair", ha="center", va="center", transform=axes.transAxes)
        unit = "autocorrelation" if what == "lag1" else one.unit
        axes.set(title=f"{one.name}:\n{name}", xlabel=f"measured ({unit})", ylabel="simulated")
    return figure
