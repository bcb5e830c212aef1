"""Pictures of a scenario: the room with its flights, and the timing of one exchange."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from uwblink.arrays import Floats
from uwblink.pages.colours import GRID, INK, MUTED, SERIES, look
from uwblink.pages.figures import NARROW_IN, legend, mark
from uwblink.protocols.rows import RangingProtocol
from uwblink.protocols.table import PROTOCOLS
from uwblink.ticks import TICK_S
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.ranging import after_marker_s, before_marker_s, message_bytes
from uwbsim.simulation.timestamps import Begun, Draws, Stamped, draw_reply_s, stamp
from uwbsim.world.clocks import SUBTICKS_PER_SECOND, Clocks
from uwbsim.world.reception import Medium
from uwbsim.world.world import World

LONGEST_DRAWN_S: Final = 120.0
INSTANTS: Final = 1200
LEAST_M: Final = 1.0
"""What is drawn is at least so large."""

LETTER_IN: Final = 0.062
"""Width of a letter of 8 pt, about."""

NEAR_IN: Final = 0.3
"""Tags that are nearer to each other on paper share a label."""

PAPER_STAMPS: Final = {"tx1": "t1", "rx1": "t2", "tx2": "t3", "rx2": "t4", "tx3": "t5", "rx3": "t6"}
"""What ICRA 2023 (Fig. 2) calls the stamps."""


def room(width_in: float, scenario: Scenario) -> Figure:
    """Draw bodies' paths, tags at the start, obstacles and the room's walls, from above and from the side, to scale."""
    world = World.of(scenario)
    time = np.linspace(0, min(scenario.run.duration_s, LONGEST_DRAWN_S), INSTANTS)
    paths = {body.name: world.trajectories[body.name].position_m(time) for body in scenario.bodies}
    tags = {tag.id: world.trajectories[tag.body].point_m(np.zeros(1), tag.lever_arm_m)[0] for tag in scenario.tags}
    low, high = _bounds(scenario, [*paths.values(), np.array(list(tags.values()))])
    figure, panels, scale = _to_scale(width_in, high - low)
    views = ((panels[0], (0, 1), "from above"), (panels[1], (0, 2), "from the side"))
    for axes, (x, y), name in views:
        _draw_walls(axes, scenario, x, y, scale)
        for k, body in enumerate(scenario.bodies):
            own = np.array([tags[tag.id] for tag in scenario.tags if tag.body == body.name]).reshape(-1, 3)
            path = paths[body.name]
            kind = look(k)
            axes.plot(path[:, x], path[:, y], color=kind.colour, lw=0.6, alpha=0.6)
            (dots,) = axes.plot(own[:, x], own[:, y], kind.marker, color=kind.colour, ms=4, label=body.name)
            mark(dots, body.name)
        _name_tags(axes, {tag: spot[[x, y]] for tag, spot in tags.items()}, scale, high[x])
        axes.set_xlim(low[x], high[x])
        axes.set_ylim(low[y], high[y])
        axes.set_aspect("equal", adjustable="box")
        axes.set_xlabel(f"{'xyz'[x]} (m)")
        axes.set_ylabel(f"{'xyz'[y]} (m)")
        axes.grid(True)
        axes.set_axisbelow(True)
        axes.set_title(name, loc="left")
    legend(figure, panels[0])
    return figure


def _bounds(scenario: Scenario, points: list[Floats]) -> tuple[Floats, Floats]:
    """Return the corners of what is drawn: the room where there is one, else all that moves and stands; a margin."""
    corners = [np.array(box.min_m) for box in scenario.obstacles] + [np.array(box.max_m) for box in scenario.obstacles]
    if scenario.room:
        corners += [np.array(scenario.room.min_m), np.array(scenario.room.max_m)]
    everything = np.concatenate([np.concatenate(points), np.array(corners).reshape(-1, 3)])
    low, high = everything.min(axis=0), everything.max(axis=0)
    middle = (low + high) / 2
    half = np.maximum((high - low) / 2, LEAST_M / 2)
    margin = 0.04 * float(half.max()) if scenario.room else 0.12 * float(half.max())
    return middle - half - margin, middle + half + margin


def _to_scale(width_in: float, size_m: Floats) -> tuple[Figure, list[Axes], float]:
    """Return a figure whose two panels have the same scale, and inches of a metre; on a phone above each other."""
    narrow = width_in < NARROW_IN
    across = size_m[0] if narrow else 2 * size_m[0]
    scale = min((width_in - (0.7 if narrow else 1.4)) / across, (3.6 if narrow else 4.2) / max(size_m[1], size_m[2]))
    heights = [size_m[1] * scale, size_m[2] * scale]
    tall = sum(heights) + 1.9 if narrow else max(heights) + 1.2
    figure = Figure(figsize=(width_in, tall), layout="constrained")
    panels = figure.subplots(2, 1, height_ratios=heights) if narrow else figure.subplots(1, 2)
    return figure, list(panels), float(scale)


def _draw_walls(axes: Axes, scenario: Scenario, x: int, y: int, scale: float) -> None:
    if scenario.room:
        low, high = np.array(scenario.room.min_m), np.array(scenario.room.max_m)
        axes.add_patch(Rectangle((low[x], low[y]), *(high - low)[[x, y]], fill=False, ec=INK, lw=1.2, zorder=1))
    for box in scenario.obstacles:
        low, high = np.array(box.min_m), np.array(box.max_m)
        width, height = (high - low)[[x, y]]
        axes.add_patch(Rectangle((low[x], low[y]), width, height, fc=GRID, ec=MUTED, lw=0.6))
        # A name is written into what it names, along or up, or not at all.
        length = LETTER_IN * len(box.name) + 0.05
        fits = {
            0: width * scale > length and height * scale > 0.13,
            90: height * scale > length and width * scale > 0.13,
        }
        turned = next((angle for angle, so in fits.items() if so), None)
        if turned is not None:
            middle = (low + high) / 2
            axes.text(
                float(middle[x]),
                float(middle[y]),
                box.name,
                ha="center",
                va="center",
                rotation=turned,
                color=INK,
                clip_on=True,
            )


def _name_tags(axes: Axes, spots: dict[int, Floats], scale: float, right: float) -> None:
    """Write numbers beside tags; those that would cover each other are written together, at the first of them."""
    groups: list[tuple[Floats, list[int]]] = []
    for tag, spot in spots.items():
        near = next((names for place, names in groups if np.abs(place - spot).max() * scale < NEAR_IN), None)
        if near is None:
            groups.append((spot, [tag]))
        else:
            near.append(tag)
    for spot, names in groups:
        text = ", ".join(map(str, names)) if len(names) < 5 else f"{names[0]} … {names[-1]}"
        # Beside the edge to the left, so that no name runs out of the picture.
        left = (right - spot[0]) * scale < LETTER_IN * len(text) + 0.1
        axes.annotate(
            text,
            (float(spot[0]), float(spot[1])),
            (-4 if left else 4, 4),
            textcoords="offset points",
            color=INK,
            ha="right" if left else "left",
        )


def timing(width_in: float, scenario: Scenario, name: str) -> Figure:
    """Draw one exchange of the first pair with its real delays: who sends what when, each stamp, and all intervals."""
    protocol = PROTOCOLS[name]
    stamped, pair = _one_exchange(scenario, protocol)
    figure = Figure(figsize=(width_in, 2.3), layout="constrained")
    axes = figure.subplots()
    for level in LANES.values():
        axes.axhline(level, color=MUTED, lw=0.8)
    _draw_messages(axes, scenario, protocol, stamped, width_in)
    _draw_spans(axes, protocol, stamped, width_in)
    narrow = width_in < NARROW_IN
    axes.set_yticks([0, 1], [f"target {pair[1]}", f"initiator {pair[0]}"], rotation=90 if narrow else 0, va="center")
    axes.set_ylim(-0.8, 1.8)
    axes.set_xlabel("time since the poll's marker (µs)" if narrow else "time since the poll's ranging marker (µs)")
    axes.set_title(protocol.title, loc="left")
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    axes.autoscale_view(scaley=False)
    return figure


LANES: Final = {"initiator": 1.0, "target": 0.0}


def _draw_messages(
    axes: Axes, scenario: Scenario, protocol: RangingProtocol, stamped: Stamped, width_in: float
) -> None:
    lengths = message_bytes(protocol)
    before = before_marker_s(scenario.radio.preamble_symbols) * 1e6
    times = [_us(stamped, k) for k in range(len(protocol.messages))]
    whole = max(times) - min(times) + 2 * before
    placed: dict[float, float] = {}
    for k, message in enumerate(protocol.messages):
        at_us, y = times[k], LANES[message.sender]
        other, colour = 1.0 - y, SERIES[k]
        axes.add_patch(Rectangle((at_us - before, y - 0.09), before, 0.18, fc=colour, alpha=0.35))
        axes.add_patch(Rectangle((at_us, y - 0.09), after_marker_s(lengths[k]) * 1e6, 0.18, fc=colour, alpha=0.9))
        arrow: dict[str, Any] = {"arrowstyle": "->", "color": colour, "lw": 1.2}
        axes.annotate("", (at_us, other), (at_us, y), arrowprops=arrow)
        for level, which in ((y, f"tx{k + 1}"), (other, f"rx{k + 1}")):
            # Stamps that are closer than their names are written in the next line.
            close = level in placed and (at_us - placed[level]) / whole * (width_in - 1.2) < 0.62
            placed[level] = at_us
            up = 1 if level else -1
            axes.annotate(
                f"{which} ({PAPER_STAMPS[which]})",
                (at_us, level),
                (0, up * (22 if close else 9)),
                textcoords="offset points",
                ha="center",
                va="bottom" if level else "top",
            )


def _draw_spans(axes: Axes, protocol: RangingProtocol, stamped: Stamped, width_in: float) -> None:
    """Draw the intervals between the lanes, as arrows from stamp to stamp with name and length."""
    spans = _spans(protocol)
    ends = {stamp_name: _us(stamped, int(stamp_name[-1]) - 1) for _, *names, _ in spans for stamp_name in names}
    whole = max(ends.values()) - min(ends.values())
    for name, first, second, role in spans:
        length_us = (int(stamped.stamps[second][0]) - int(stamped.stamps[first][0])) * TICK_S * 1e6
        level = 0.62 if role == "initiator" else 0.38
        left, right = ends[first], ends[second]
        axes.annotate("", (right, level), (left, level), arrowprops={"arrowstyle": "<->", "color": MUTED, "lw": 0.7})
        text = f"{name} = {length_us:.1f} µs"
        if (right - left) / whole * (width_in - 1.2) < 1.2 * LETTER_IN * len(text):
            text = name
        axes.annotate(
            text, ((left + right) / 2, level), (0, 1.5 if role == "initiator" else -1.5), textcoords="offset points",
            ha="center", va="bottom" if role == "initiator" else "top", color=INK,
        )  # fmt: skip


def _us(stamped: Stamped, message: int) -> float:
    """Return when a message left, in microseconds after the first."""
    frames = stamped.frames
    return float((int(frames[message].departure[0]) - int(frames[0].departure[0])) / SUBTICKS_PER_SECOND * 1e6)


def _spans(protocol: RangingProtocol) -> list[tuple[str, str, str, str]]:
    """Return the intervals a time of flight is made of: name, first and last stamp, and whose they are.

    dt53 is the third leg as its sender has it, dt64 as its receiver.
    """
    spans = [("dt41", "tx1", "rx2", "initiator"), ("dt32", "rx1", "tx2", "target")]
    if len(protocol.messages) == 3:
        if protocol.messages[2].sender == "target":
            spans += [("dt64", "rx2", "rx3", "initiator"), ("dt53", "tx2", "tx3", "target")]
        else:
            spans += [("dt53", "rx2", "tx3", "initiator"), ("dt64", "tx2", "rx3", "target")]
    return spans


def _one_exchange(scenario: Scenario, protocol: RangingProtocol) -> tuple[Stamped, tuple[int, int]]:
    first, second = scenario.pairs()[0]
    place = {tag.id: k for k, tag in enumerate(scenario.tags)}
    count = len(protocol.messages)
    zeros = np.zeros((count, 1))
    reply = stream(scenario.run.seed, "timing diagram")
    draws = Draws(zeros, zeros, draw_reply_s(scenario, reply, 1), np.zeros(1))
    begun = Begun(
        start=np.array([SUBTICKS_PER_SECOND // 100]),
        initiator=np.array([place[first]]),
        target=np.array([place[second]]),
    )
    medium = Medium(scenario, World.of(scenario), Clocks.of(scenario))
    return stamp(medium, protocol, begun, draws), (first, second)
