"""Pictures of a scenario: the room with its flights, and the timing of one exchange."""

from __future__ import annotations

import io
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from uwblink.protocols.rows import RangingProtocol
from uwblink.protocols.table import PROTOCOLS
from uwblink.ticks import TICK_S
from uwbsim.random_streams import stream
from uwbsim.scenario.airtime import after_marker_s, before_marker_s, message_bytes
from uwbsim.scenario.model import Scenario
from uwbsim.simulation.timestamps import Begun, Draws, Stamped, draw_reply_s, stamp
from uwbsim.world.clocks import Clocks
from uwbsim.world.reception import Medium
from uwbsim.world.true_time import SUBTICKS_PER_SECOND
from uwbsim.world.world import World

# Okabe and Ito's palette, which colour-blind readers can tell apart.
PALETTE: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8A6D3B", "#000000")
LONGEST_DRAWN_S: Final = 120.0
PAPER_STAMPS: Final = {"tx1": "t1", "rx1": "t2", "tx2": "t3", "rx2": "t4", "tx3": "t5", "rx3": "t6"}
"""What ICRA 2023 (Fig. 2) calls the stamps."""


def png(figure: Figure) -> bytes:
    """Return a picture for a page."""
    return picture(figure, "png", 130)


def picture(figure: Figure, kind: str, dpi: int) -> bytes:
    """Return a figure as the bytes of a "png", "svg" or "pdf" file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=dpi)
    return buffer.getvalue()


def room(scenario: Scenario) -> Figure:
    """Draw bodies' paths, tags at the start, obstacles and walls, from above and from the side."""
    world = World.of(scenario)
    figure = Figure(figsize=(11, 5.4), layout="constrained")
    above, side = figure.subplots(1, 2)
    for axes, (x, y) in ((above, (0, 1)), (side, (0, 2))):
        _draw_view(axes, scenario, world, x, y)
    above.set_title("from above", loc="left", fontsize="medium")
    side.set_title("from the side", loc="left", fontsize="medium")
    handles, labels = above.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 8), frameon=False)
    return figure


def _draw_view(axes: Axes, scenario: Scenario, world: World, x: int, y: int) -> None:
    if scenario.room:
        low, high = np.array(scenario.room.min_m), np.array(scenario.room.max_m)
        axes.add_patch(Rectangle((low[x], low[y]), *(high - low)[[x, y]], fill=False, ec="0.3", lw=1.5))
    for box in scenario.obstacles:
        low, high = np.array(box.min_m), np.array(box.max_m)
        axes.add_patch(Rectangle((low[x], low[y]), *(high - low)[[x, y]], fc="0.8", ec="0.5"))
        axes.annotate(box.name, ((low + high) / 2)[[x, y]], fontsize=7, ha="center", va="center", color="0.25")
    time = np.linspace(0, min(scenario.run.duration_s, LONGEST_DRAWN_S), 1500)
    for k, body in enumerate(scenario.bodies):
        colour = PALETTE[k % len(PALETTE)]
        path = world.trajectories[body.name].position_m(time)
        axes.plot(path[:, x], path[:, y], color=colour, lw=0.8, alpha=0.6)
        for n, tag in enumerate(t for t in scenario.tags if t.body == body.name):
            spot = world.trajectories[body.name].point_m(np.zeros(1), tag.lever_arm_m)[0]
            axes.plot(spot[x], spot[y], "o", color=colour, ms=6, label=body.name if n == 0 else None)
            axes.annotate(f" {tag.id}", (spot[x], spot[y]), fontsize=9, color=colour, weight="bold")
    axes.set_aspect("equal", adjustable="datalim")
    axes.autoscale_view()
    axes.set_xlabel(f"{'xyz'[x]} (m)")
    axes.set_ylabel(f"{'xyz'[y]} (m)")
    axes.grid(alpha=0.25)


def timing(scenario: Scenario, name: str) -> Figure:
    """Draw one exchange of the first pair with its real delays: who sends what when, and each stamp."""
    protocol = PROTOCOLS[name]
    stamped, pair = _one_exchange(scenario, protocol)
    lanes = {"initiator": 1.0, "target": 0.0}
    lengths = message_bytes(protocol)
    symbols = scenario.radio.preamble_symbols
    start = stamped.frames[0].departure[0]
    figure = Figure(figsize=(11, 2.6), layout="constrained")
    axes = figure.subplots()
    for level in lanes.values():
        axes.axhline(level, color="0.6", lw=1)
    for k, message in enumerate(protocol.messages):
        at_us = (stamped.frames[k].departure[0] - start) / SUBTICKS_PER_SECOND * 1e6
        y = lanes[message.sender]
        other = 1.0 - y
        begin, length = at_us - before_marker_s(symbols) * 1e6, after_marker_s(lengths[k]) * 1e6
        before = before_marker_s(symbols) * 1e6
        axes.add_patch(Rectangle((begin, y - 0.09), before, 0.18, fc=PALETTE[k], alpha=0.35))
        axes.add_patch(Rectangle((at_us, y - 0.09), length, 0.18, fc=PALETTE[k], alpha=0.9))
        arrow: dict[str, Any] = {"arrowstyle": "->", "color": PALETTE[k], "lw": 1.4}
        axes.annotate("", (at_us, other), (at_us, y), arrowprops=arrow)
        for level, which in ((y, f"tx{k + 1}"), (other, f"rx{k + 1}")):
            axes.annotate(
                f"{which}\n({PAPER_STAMPS[which]})",
                (at_us, level + (0.2 if level else -0.2)),
                ha="center",
                va="bottom" if level else "top",
                fontsize=8,
            )
    for label, first, second, role in _spans(protocol):
        a, b = (int(stamped.stamps[s][0]) for s in (first, second))
        left, right = ((_marker(stamped, s) - start) / SUBTICKS_PER_SECOND * 1e6 for s in (first, second))
        axes.annotate(
            f"{label} = {(b - a) * TICK_S * 1e6:.1f} us",
            ((left + right) / 2, lanes[role] + (-0.16 if role == "initiator" else 0.12)),
            ha="center",
            va="top" if role == "initiator" else "bottom",
            fontsize=8,
            color="0.25",
        )
    axes.set_yticks([0, 1], [f"target {pair[1]}", f"initiator {pair[0]}"])
    axes.set_ylim(-0.75, 1.75)
    axes.set_xlabel("time since the poll's ranging marker (us); pale: preamble and SFD, full: header and data")
    axes.set_title(protocol.title, loc="left", fontsize="medium")
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.autoscale_view(scaley=False)
    return figure


def _spans(protocol: RangingProtocol) -> list[tuple[str, str, str, str]]:
    """The intervals that are worth naming: label, first and last stamp, and whose they are."""
    spans = [("dt41", "tx1", "rx2", "initiator"), ("dt32", "rx1", "tx2", "target")]
    if len(protocol.messages) == 3 and protocol.messages[2].sender == "target":
        spans += [("dt64", "rx2", "rx3", "initiator"), ("dt53", "tx2", "tx3", "target")]
    return spans


def _marker(stamped: Stamped, which: str) -> int:
    return int(stamped.frames[int(which[-1]) - 1].departure[0])


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
