"""Stamps of many exchanges at once, with the firmware's arithmetic, and what boards and a recording report of them.

`stamp` computes for each message of a protocol's row when it leaves, when it arrives, and the two stamps. The reports
are exchanges, failures, overheard exchanges, impulse responses, and the provenance of the recording.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import ArrayRows, Floats, Ints, in_time_order
from uwblink.protocols.table import RangingProtocol
from uwblink.receptions import Receptions, exchanges_in
from uwblink.recording.antenna_delays import AntennaDelay, AntennaDelays, meta_of_delays
from uwblink.recording.schema import CirRow, Fault
from uwblink.ticks import (
    ANTENNA_DELAY_TICKS,
    COUNTER_BITS,
    DELAYED_TX_GRID,
    REPORT_BITS,
    TICK_S,
    UUS_TICKS,
)
from uwblink.twr import STAMPS, Exchanges, board_range, raw_range
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.simulation.air import WEAK, Outcomes, Schedule
from uwbsim.world.channel import CHANNEL_EFFECTS, Link
from uwbsim.world.clocks import NS_PER_S, SUBTICKS, SUBTICKS_PER_SECOND
from uwbsim.world.impulse_response import INDEX_STEPS, impulse_response
from uwbsim.world.reception import Frames, Medium
from uwbsim.world.world import World

MASK: Final = (1 << REPORT_BITS) - 1
"""Bits of a stamp that boards report."""

Ticks = TypeVar("Ticks", Ints, int)


@dataclass(frozen=True, slots=True)
class Draws(ArrayRows):
    """Random numbers of planned slots, one row per slot, so that a lost exchange shifts no others.

    `slot` are their numbers. Noise is standard normal: `transmit` and `receive` of stamps, (n, messages), `power` and
    `skew` of the readings of the first two messages, (n, 2). `reply_s` is the latency of a reply sent at once,
    `excess_m` the detour by multipath of all messages.
    """

    slot: Ints

    transmit: Floats
    receive: Floats
    power: Floats
    skew: Floats
    reply_s: Floats
    excess_m: Floats


@dataclass(slots=True)
class Stamped:
    """Stamps in whole ticks, not wrapped, and frames and links of the messages, (n,) each; one list item per message.

    `draws` are the random numbers that they were made with.
    """

    stamps: dict[str, Ints]
    frames: list[Frames]
    links: list[Link]
    draws: Draws


def draw(scenario: Scenario, count: int, messages: int) -> Draws:
    """Draw for `count` planned slots from the scenario's named streams."""
    seed, numbers, excess = scenario.run.seed, range(messages), np.zeros(count)

    def noise(purpose: str, numbers: Iterable[int]) -> Floats:
        return np.column_stack([stream(seed, purpose, k).normal(size=count) for k in numbers])

    share, mean_m = scenario.radio.independent_multipath
    if share:
        rng = stream(seed, "multipath")
        hit = rng.random(count) < share
        excess = np.where(hit, rng.exponential(mean_m, count), 0.0)
    return Draws(
        slot=np.arange(count),
        transmit=noise("transmit noise", numbers),
        receive=noise("receive noise", numbers),
        power=noise("power reading", (1, 2)),
        skew=noise("skew reading", (1, 2)),
        reply_s=scenario.ranging.reply.draw_s(stream(seed, "reply latency"), count),
        excess_m=excess,
    )


def stamp(medium: Medium, protocol: RangingProtocol, begun: Schedule, draws: Draws) -> Stamped:
    """Return the stamps of exchanges that begin at known instants, message after message."""
    result = Stamped({}, [], [], draws)
    ends = (begun.initiator, begun.target)
    for k, message in enumerate(protocol.messages):
        sender, receiver = ends if message.sender == "initiator" else ends[::-1]
        if not message.after:
            counter = next_grid(-(-medium.clocks.read(begun.initiator, begun.start) // SUBTICKS))
        elif message.timing == "scheduled":
            counter = scheduled_counter(result.stamps[message.after], medium.scenario.ranging.response_delay_uus)
        else:
            counter = reply_counter(result.stamps[message.after], draws.reply_s)
        left = medium.leave(sender, counter + medium.tx_register[sender], draws.transmit[:, k])
        frames = Frames(sender=sender, receiver=receiver, departure=left)
        received, link = medium.receive(frames, draws.receive[:, k], draws.excess_m)
        added = medium.reply_constant if message.timing == "scheduled" else medium.tx_register
        result.stamps[f"tx{k + 1}"] = counter + added[sender]
        result.stamps[f"rx{k + 1}"] = received
        result.frames.append(frames)
        result.links.append(link)
    return result


def scheduled_counter(reference: Ticks, delay_uus: int) -> Ticks:
    """Return the sender's counter, without antenna delay, when a message leaves a delay after the stamp `reference`.

    The chip ignores the low nine bits of the time at which it is told to send.
    """
    return (reference + delay_uus * UUS_TICKS) // DELAYED_TX_GRID * DELAYED_TX_GRID


def reply_counter(reference: Ints | int, reply_s: Floats) -> Ints:
    """Return the sender's counter, without antenna delay, when replies leave that are sent at once, (n,)."""
    return next_grid(reference + np.rint(reply_s / TICK_S).astype(np.int64) - ANTENNA_DELAY_TICKS)


def next_grid(ticks: Ticks) -> Ticks:
    """Return the first instants of the grid of transmissions at or after `ticks`."""
    return -(-ticks // DELAYED_TX_GRID) * DELAYED_TX_GRID


def reported_exchanges(medium: Medium, stamped: Stamped) -> dict[str, Any]:
    """Return what boards report of n exchanges: stamps wrapped, ranges as printed; and their true distances."""
    ids, poll = np.array([tag.id for tag in medium.scenario.tags], dtype=np.int64), stamped.frames[0]
    count = len(poll.sender)
    none, nan = np.zeros(count, dtype=np.int64), np.full(count, np.nan)
    stamps: dict[str, Ints] = {name: stamped.stamps.get(name, none) & MASK for name in STAMPS}
    (fpp1, skew1), (fpp2, skew2) = (printed_readings(medium, message, stamped) for message in (0, 1))
    found = Exchanges(
        time_ns=time_ns(poll.departure),
        initiator=ids[poll.sender],
        target=ids[poll.receiver],
        protocol=np.full(count, medium.scenario.ranging.protocol),
        reporter=ids[poll.sender],
        range_m=nan,
        fpp1_dbm=fpp1,
        fpp2_dbm=fpp2,
        skew1_ppm=skew1,
        skew2_ppm=skew2,
        truth_m=nan,
        bits=REPORT_BITS,
        **stamps,
    )
    printed = board_range if medium.scenario.radio.quantize else raw_range
    exchanges = replace(found, range_m=printed(found))
    truth_m = (stamped.links[0].distance_m + stamped.links[1].distance_m) / 2
    return {"exchanges": exchanges, "overheard": overhear(medium, stamped, exchanges), "truth_m": truth_m}


def reported_broadcasts(medium: Medium, stamped: Stamped) -> dict[str, Any]:
    """Return what tags report of n frames, each at one listener: receptions, and the exchanges that they make.

    Stamps are the chip's whole ones. `truth_m` are the distances at the polls, which ranges measure (`range_ns`).
    """
    ids, frame = np.array([tag.id for tag in medium.scenario.tags], dtype=np.int64), stamped.frames[0]
    fpp, skew = printed_readings(medium, 0, stamped)
    tx, rx = (stamped.stamps[name] & ((1 << COUNTER_BITS) - 1) for name in ("tx1", "rx1"))
    receptions = Receptions(
        time_ns=time_ns(frame.departure),
        frame=stamped.draws.slot // (len(ids) - 1),
        sender=ids[frame.sender],
        listener=ids[frame.receiver],
        tx=tx,
        rx=rx,
        fpp_dbm=fpp,
        rxp_dbm=np.full(len(fpp), np.nan),
        skew_ppm=skew,
    )
    exchanges, overheard = exchanges_in(receptions)
    i, j = (np.argmax(ends[:, None] == ids, axis=1) for ends in (exchanges.initiator, exchanges.target))
    poll = np.rint(exchanges.time_ns * (SUBTICKS_PER_SECOND / NS_PER_S)).astype(np.int64)
    truth_m = medium.links.link(i, j, poll).distance_m
    return {"exchanges": exchanges, "overheard": overheard, "receptions": receptions.to_dict(), "truth_m": truth_m}


def time_ns(departure: Ints) -> Ints:
    """Return true times (n,) in nanoseconds."""
    return np.asarray(np.rint(departure * (NS_PER_S / SUBTICKS_PER_SECOND)).astype(np.int64))


def printed_readings(medium: Medium, message: int, stamped: Stamped) -> tuple[Floats, Floats]:
    """Return what receivers print of a message, by its index: first-path power and relative skew, (n,) each."""
    power, skew = stamped.draws.power[:, message], stamped.draws.skew[:, message]
    return medium.readings(stamped.frames[message], stamped.links[message].power_dbm, power, skew)


def reported_faults(scenario: Scenario, plan: Schedule, outcomes: Outcomes) -> list[Fault]:
    """Return the failed exchanges, with their reasons and initiators."""
    ids, failed = np.array([tag.id for tag in scenario.tags]), np.flatnonzero(np.array(outcomes.lost) >= 0)
    tags = zip(ids[plan.initiator[failed]].tolist(), ids[plan.target[failed]].tolist(), strict=True)
    what = "{} broadcast to {}: frame" if scenario.ranging.plan == "broadcast" else "{} ranged with {}: message {}"
    return [
        Fault(
            round(outcomes.start[k] * (NS_PER_S / SUBTICKS_PER_SECOND)),
            str(a),
            "lost frame" if outcomes.reason[k] == WEAK else outcomes.reason[k],
            f"{what.format(a, b, outcomes.lost[k] + 1)} {outcomes.reason[k]}",
            a,
            b,
        )
        for k, (a, b) in zip(failed.tolist(), tags, strict=True)
    ]


def provenance(scenario: Scenario) -> dict[str, Any]:
    """Return a recording's `meta` of a simulated flight: the scenario whole, its seed, and what it planted."""
    # Channel effects of plug-ins are not part of the scenario, but the flight cannot be repeated without them.
    added = [effect.name for effect in CHANNEL_EFFECTS.added()]
    # Antenna delays programmed into tags: the default under None, others by the ids of their tags.
    by_tag = {tag.id: AntennaDelay(**tag.antenna_delay.model_dump()) for tag in scenario.tags}
    delays: AntennaDelays = {None: AntennaDelay(), **{k: one for k, one in by_tag.items() if one != AntennaDelay()}}
    return {
        "source": "simulation",
        "scenario": scenario.model_dump(mode="json"),
        "scenario_name": scenario.run.name,
        "seed": scenario.run.seed,
        "planted": scenario.planted(),
        **meta_of_delays(delays),
    } | ({"channel_effects": added} if added else {})


def overhear(medium: Medium, stamped: Stamped, exchanges: Exchanges) -> dict[str, NDArray[Any]]:
    """Return the table `overheard` as columns, in order of time: every exchange at every passive tag that hears it.

    A listener that misses a message reports nothing.
    """
    poll = stamped.frames[0]
    listeners = np.array([k for k, tag in enumerate(medium.scenario.tags) if tag.passive], dtype=np.int64)
    rows = {k: np.flatnonzero((poll.sender != k) & (poll.receiver != k)) for k in listeners.tolist()}
    return in_time_order([_heard_by(medium, k, r, stamped, exchanges) for k, r in rows.items() if len(r)])


def _heard_by(medium: Medium, me: int, rows: Ints, stamped: Stamped, exchanges: Exchanges) -> dict[str, NDArray[Any]]:
    """Return what one listener reports of exchanges with indices `rows`."""
    tag, count, planned = medium.scenario.tags[me], len(rows), len(exchanges)
    heard, nothing = np.ones(count, dtype=bool), np.full(count, np.nan)
    columns: dict[str, NDArray[Any]] = {"rx3": np.zeros(count, np.int64), "fpp3_dbm": nothing, "skew3_ppm": nothing}
    for k, sent in enumerate(stamped.frames):
        name = str(k + 1)
        frames = Frames(sender=sent.sender[rows], receiver=np.full(count, me), departure=sent.departure[rows])
        # One stream a listener and message: another listener, or another noise, changes nothing else.
        noise = stream(medium.scenario.run.seed, "overheard", tag.id, k).normal(size=(4, planned))[:, rows]
        received, link = medium.receive(frames, noise[1])
        heard &= medium.heard(link.power_dbm, noise[0])
        columns[f"rx{name}"] = received & MASK
        columns[f"fpp{name}_dbm"], columns[f"skew{name}_ppm"] = medium.readings(
            frames, link.power_dbm, noise[2], noise[3]
        )
    columns |= {"time_ns": exchanges.time_ns[rows], "listener": np.full(count, tag.id)}
    columns |= {name: getattr(exchanges, name)[rows] for name in ("initiator", "target")}
    columns |= {f"{name}_n": getattr(exchanges, name)[rows] for name in STAMPS}
    readings = ("fpp1_dbm", "fpp2_dbm", "skew1_ppm", "skew2_ppm")
    columns |= {name.replace("_", "_n_"): getattr(exchanges, name)[rows] for name in readings}
    return {name: column[heard] for name, column in columns.items()}


def responses(
    scenario: Scenario, world: World, protocol: RangingProtocol, exchanges: Exchanges, stamped: Stamped
) -> list[CirRow]:
    """Return the initiators' impulse responses: of the last frame each received, as the boards print them.

    The fraction of the first path's index is that of the stamp: 64 ticks are a tap (the chip interpolates both).
    """
    last = max(k for k, message in enumerate(protocol.messages) if message.sender == "target")
    sent = stamped.frames[last]
    heard = world.paths(sent.sender, sent.receiver, sent.departure, stamped.draws.excess_m)
    columns = (exchanges.initiator, exchanges.target, getattr(exchanges, f"rx{last + 1}"), exchanges.time_ns)
    rng, rows = stream(scenario.run.seed, "impulse responses"), []
    for initiator, target, rx, time_ns, paths in zip(*(c.tolist() for c in columns), heard, strict=True):
        index, taps = impulse_response(rng, rx, paths)
        rows.append(CirRow(time_ns, initiator, initiator, target, index / INDEX_STEPS, taps))
    return rows
