"""Reports of boards: exchanges, failures, overheard exchanges, impulse responses; and the recording's provenance."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Floats, Ints
from uwblink.protocols.table import RangingProtocol
from uwblink.recording.antenna_delays import AntennaDelay, AntennaDelays, meta_of_delays
from uwblink.recording.schema import CirRow, Fault
from uwblink.ticks import REPORT_BITS
from uwblink.twr import STAMPS, Exchanges, board_range, raw_range
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.simulation import air
from uwbsim.simulation.air import Schedule
from uwbsim.simulation.timestamps import Begun, Stamped
from uwbsim.tables import in_time_order
from uwbsim.world.channel import CHANNEL_EFFECTS, OWN_EFFECTS
from uwbsim.world.clocks import NS_PER_S, SUBTICKS_PER_SECOND
from uwbsim.world.impulse_response import INDEX_STEPS, impulse_response
from uwbsim.world.reception import Frames, Medium
from uwbsim.world.world import World


def reported_exchanges(medium: Medium, kept: Ints, planned: int, rows: Begun, stamped: Stamped) -> Exchanges:
    """Return the reports of the `kept` exchanges (n,), of all `planned`: stamps wrapped, ranges as printed."""
    initiator, target = rows.initiator, rows.target
    ids = np.array([tag.id for tag in medium.scenario.tags], dtype=np.int64)
    none = np.zeros(len(kept), dtype=np.int64)
    stamps: dict[str, Ints] = {name: stamped.stamps.get(name, none) & MASK for name in STAMPS}
    fpp1, skew1 = _readings(medium, 1, kept, planned, stamped)
    fpp2, skew2 = _readings(medium, 2, kept, planned, stamped)
    nan = np.full(len(kept), np.nan)
    found = Exchanges(
        time_ns=np.rint(stamped.frames[0].departure * (NS_PER_S / SUBTICKS_PER_SECOND)).astype(np.int64),
        initiator=ids[initiator],
        target=ids[target],
        protocol=np.full(len(kept), medium.scenario.ranging.protocol),
        reporter=ids[initiator],
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
    return replace(found, range_m=printed(found))


def _readings(medium: Medium, number: int, kept: Ints, planned: int, stamped: Stamped) -> tuple[Floats, Floats]:
    """What the receiver of message `number` prints: first-path power and relative skew."""
    seed = medium.scenario.run.seed
    power_noise = stream(seed, "power reading", number).normal(size=planned)[kept]
    skew_noise = stream(seed, "skew reading", number).normal(size=planned)[kept]
    return medium.readings(stamped.frames[number - 1], stamped.power_dbm[number - 1], power_noise, skew_noise)


def reported_faults(scenario: Scenario, begun: Ints, plan: Schedule, outcomes: air.Outcomes) -> list[Fault]:
    """Return the failed exchanges, with their reasons and initiators."""
    ids = [tag.id for tag in scenario.tags]
    found = []
    for k in np.flatnonzero(np.array(outcomes.lost) >= 0):
        a, b = ids[plan.initiator[k]], ids[plan.target[k]]
        reason = outcomes.reason[k]
        found.append(
            Fault(
                round(int(begun[k]) * (NS_PER_S / SUBTICKS_PER_SECOND)),
                str(a),
                "lost frame" if reason == air.WEAK else reason,
                f"{a} ranged with {b}: message {outcomes.lost[k] + 1} {reason}",
                a,
                b,
            )
        )
    return found


def _programmed(scenario: Scenario) -> AntennaDelays:
    """Return antenna delays programmed into tags: under None the default, others by the ids of their tags."""
    found = {tag.id: AntennaDelay(**tag.antenna_delay.model_dump()) for tag in scenario.tags}
    return {None: AntennaDelay(), **{tag: one for tag, one in found.items() if one != AntennaDelay()}}


def provenance(scenario: Scenario) -> dict[str, Any]:
    """Return a recording's `meta` of a simulated flight: the scenario whole, its seed, and what it planted."""
    # Channel effects of plug-ins are not part of the scenario, but the flight cannot be repeated without them.
    added = [name for name in CHANNEL_EFFECTS if name not in OWN_EFFECTS]
    return {
        "source": "simulation",
        "scenario": scenario.model_dump(mode="json"),
        "scenario_name": scenario.run.name,
        "seed": scenario.run.seed,
        "planted": scenario.planted(),
        **meta_of_delays(_programmed(scenario)),
    } | ({"channel_effects": added} if added else {})


MASK: Final = (1 << REPORT_BITS) - 1
"""Bits of a stamp that boards report."""


def overhear(medium: Medium, stamped: Stamped, exchanges: Exchanges) -> dict[str, NDArray[Any]]:
    """Return the table `overheard` as columns, in order of time: every exchange at every passive tag that hears it.

    A listener that misses a message reports nothing.
    """
    poll = stamped.frames[0]
    _look_ahead(medium, stamped)
    parts = []
    for me, tag in enumerate(medium.scenario.tags):
        rows = np.flatnonzero((poll.sender != me) & (poll.receiver != me))
        if tag.passive and len(rows):
            parts.append(_heard_by(medium, me, rows, stamped, exchanges))
    return in_time_order(parts)


def _look_ahead(medium: Medium, stamped: Stamped) -> None:
    """Compute the responses of all listeners at once, which takes half the time."""
    listeners = np.array([me for me, tag in enumerate(medium.scenario.tags) if tag.passive], dtype=np.int64)
    if not len(listeners) or not isinstance(medium.links, World):
        return
    sender, departure = (np.concatenate([getattr(f, name) for f in stamped.frames]) for name in ("sender", "departure"))
    receiver = np.repeat(listeners, len(sender))
    sender, departure = np.tile(sender, len(listeners)), np.tile(departure, len(listeners))
    others = sender != receiver
    medium.links.prepare(sender[others], receiver[others], departure[others])


def _heard_by(medium: Medium, me: int, rows: Ints, stamped: Stamped, exchanges: Exchanges) -> dict[str, NDArray[Any]]:
    tag, count, planned = medium.scenario.tags[me], len(rows), len(exchanges)
    heard = np.ones(count, dtype=bool)
    columns: dict[str, NDArray[Any]] = {}
    for k in range(3):
        name = str(k + 1)
        if k >= len(stamped.frames):
            nothing = np.full(count, np.nan)
            columns |= {f"rx{name}": np.zeros(count, np.int64), f"fpp{name}_dbm": nothing, f"skew{name}_ppm": nothing}
            continue
        sent = stamped.frames[k]
        frames = Frames(sender=sent.sender[rows], receiver=np.full(count, me), departure=sent.departure[rows])
        # One stream a listener and message: another listener, or another noise, changes nothing else.
        noise = stream(medium.scenario.run.seed, "overheard", tag.id, k).normal(size=(4, planned))[:, rows]
        received = medium.receive(frames, noise[1])
        power = received.link.power_dbm
        heard &= medium.heard(power, noise[0])
        columns[f"rx{name}"] = received.stamp & MASK
        columns[f"fpp{name}_dbm"], columns[f"skew{name}_ppm"] = medium.readings(frames, power, noise[2], noise[3])
    columns |= {"time_ns": exchanges.time_ns[rows], "listener": np.full(count, tag.id)}
    columns |= {name: getattr(exchanges, name)[rows] for name in ("initiator", "target")}
    columns |= {f"{name}_n": getattr(exchanges, name)[rows] for name in STAMPS}
    for name in ("fpp1_dbm", "fpp2_dbm", "skew1_ppm", "skew2_ppm"):
        columns[name.replace("_", "_n_")] = getattr(exchanges, name)[rows]
    return {name: column[heard] for name, column in columns.items()}


def responses(
    scenario: Scenario, world: World, protocol: RangingProtocol, exchanges: Exchanges, stamped: Stamped
) -> list[CirRow]:
    """Return the initiators' impulse responses: of the last frame each received, as the boards print them.

    The fraction of the first path's index is that of the stamp: 64 ticks are a tap (the chip interpolates both).
    """
    rng = stream(scenario.run.seed, "impulse responses")
    last = max(k for k, message in enumerate(protocol.messages) if message.sender == "target")
    stamps = getattr(exchanges, f"rx{last + 1}")
    place = {tag.id: k for k, tag in enumerate(scenario.tags)}
    senders, receivers = (np.array([place[i] for i in end.tolist()]) for end in (exchanges.target, exchanges.initiator))
    heard = world.all_paths(senders, receivers, stamped.frames[last].departure, stamped.detour_m)
    columns = (exchanges.initiator, exchanges.target, stamps, exchanges.time_ns)
    rows = []
    for initiator, target, rx, time_ns, paths in zip(*(c.tolist() for c in columns), heard, strict=True):
        index, taps = impulse_response(rng, rx, paths)
        rows.append(CirRow(time_ns, initiator, initiator, target, index / INDEX_STEPS, taps))
    return rows
