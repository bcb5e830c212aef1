"""The exact instants and stamps of many exchanges at once, with the firmware's arithmetic.

Works through the messages of a protocol's row, whichever it is: when does each leave, when does it
arrive, and which integers do the two boards write down.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from uwblink.arrays import Floats, Ints
from uwblink.protocols.table import ProtocolMessage, RangingProtocol
from uwblink.ticks import (
    ANTENNA_DELAY_TICKS,
    DELAYED_TX_GRID,
    TICK_S,
    UUS_TICKS,
)
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.world.clocks import SUBTICKS
from uwbsim.world.reception import Frames, Medium

Ticks = TypeVar("Ticks", Ints, int)


@dataclass(slots=True)
class Draws:
    """Random numbers of planned slots, one row per slot, so that a lost exchange shifts no others.

    `transmit` and `receive` are standard normal, shape (messages, n); `reply_s` is the latency of a
    reply sent at once; `excess_m` the detour by multipath.
    """

    transmit: Floats
    receive: Floats
    reply_s: Floats
    excess_m: Floats

    def __getitem__(self, rows: Ints) -> Draws:
        """Return the draws of the chosen slots."""
        return Draws(self.transmit[:, rows], self.receive[:, rows], self.reply_s[rows], self.excess_m[rows])


@dataclass(frozen=True, slots=True, kw_only=True)
class Begun:
    """Exchanges that begin: true times in sub-ticks, and the places of the tags, (n,) each."""

    start: Ints
    initiator: Ints
    target: Ints


@dataclass(slots=True)
class Stamped:
    """Stamps in whole ticks, not wrapped, and links of the messages, (n,) each; one list item per message.

    `frames` are the messages with their senders, receivers and departures; `detour_m` (n,) the random detour of all
    messages.
    """

    stamps: dict[str, Ints]
    frames: list[Frames]
    distance_m: list[Floats]
    power_dbm: list[Floats]
    detour_m: Floats


def draw(scenario: Scenario, count: int, messages: int) -> Draws:
    """Draw for `count` planned slots from the scenario's named streams."""
    seed = scenario.run.seed
    numbers = range(messages)
    excess = np.zeros(count)
    share, mean_m = scenario.radio.independent_multipath
    if share:
        rng = stream(seed, "multipath")
        hit = rng.random(count) < share
        excess = np.where(hit, rng.exponential(mean_m, count), 0.0)
    return Draws(
        transmit=np.array([stream(seed, "transmit noise", k).normal(size=count) for k in numbers]),
        receive=np.array([stream(seed, "receive noise", k).normal(size=count) for k in numbers]),
        reply_s=draw_reply_s(scenario, stream(seed, "reply latency"), count),
        excess_m=excess,
    )


def draw_reply_s(scenario: Scenario, rng: np.random.Generator, count: int) -> Floats:
    """Draw reply latencies (count,) whose quantiles are those measured on boards (firmware wire format, 3.4).

    Two modes near 304.1 and 305.9 us, a shoulder, and a tenth delayed by the board's reading of its USB buffer.
    """
    reply = scenario.ranging.reply
    if reply.model == "fixed":
        return np.full(count, reply.delay_s)
    if reply.model == "quantiles":
        return reply.at_s(rng.random(count))
    kind = rng.random(count)
    microseconds = np.select(
        [kind < 0.41, kind < 0.86, kind < 0.91],
        [rng.normal(0.6, 0.3, count), rng.normal(2.4, 0.7, count), rng.normal(4.8, 0.7, count)],
        rng.uniform(6.5, 83.0, count),
    )
    return np.asarray((303.5 + np.maximum(microseconds, -0.1)) * 1e-6)


def stamp(
    medium: Medium, protocol: RangingProtocol, begun: Begun, draws: Draws, response_delay_uus: int | None = None
) -> Stamped:
    """Execute exchanges (n,), message after message; `response_delay_uus` replaces the scenario's."""
    scenario, clocks = medium.scenario, medium.clocks
    delay_uus = scenario.ranging.response_delay_uus if response_delay_uus is None else response_delay_uus
    result = Stamped({}, [], [], [], draws.excess_m)
    ready = clocks.read(begun.initiator, begun.start)
    for k, message in enumerate(protocol.messages):
        ends = (begun.initiator, begun.target)
        sender, receiver = ends if message.sender == "initiator" else ends[::-1]
        if message.after:
            reference = result.stamps[message.after]
            counter = _transmission(message, reference, draws.reply_s, delay_uus)
        else:
            counter = next_grid(-(-ready // SUBTICKS))
        left = medium.leave(sender, counter + medium.tx_register[sender], draws.transmit[k])
        frames = Frames(sender=sender, receiver=receiver, departure=left)
        received = medium.receive(frames, draws.receive[k], draws.excess_m)
        added = medium.reply_constant if message.timing == "scheduled" else medium.tx_register
        result.stamps[f"tx{k + 1}"] = counter + added[sender]
        result.stamps[f"rx{k + 1}"] = received.stamp
        result.frames.append(frames)
        result.distance_m.append(received.link.distance_m)
        result.power_dbm.append(received.link.power_dbm)
    return result


def _transmission(message: ProtocolMessage, reference: Ints, reply_s: Floats, delay_uus: int) -> Ints:
    """Return the sender's counter, without antenna delay, when a message leaves that replies to `reference`."""
    if message.timing == "scheduled":
        due = reference + delay_uus * UUS_TICKS
        # The chip ignores the low nine bits of the time at which it is told to send.
        return due // DELAYED_TX_GRID * DELAYED_TX_GRID
    latency = np.rint(reply_s / TICK_S).astype(np.int64)
    return next_grid(reference + latency - ANTENNA_DELAY_TICKS)


def next_grid(ticks: Ticks) -> Ticks:
    """Return the first instants of the grid of transmissions at or after `ticks`."""
    return -(-ticks // DELAYED_TX_GRID) * DELAYED_TX_GRID
