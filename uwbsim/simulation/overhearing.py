"""What passive tags overhear of a flight, and the channel impulse responses of its receptions."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Ints
from uwblink.protocols.rows import RangingProtocol
from uwblink.recording.schema import CirRow
from uwblink.ticks import REPORT_BITS
from uwblink.twr import Exchanges
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.simulation.timestamps import Stamped
from uwbsim.world.impulse_response import INDEX_STEPS, impulse_response
from uwbsim.world.reception import Frames, Medium
from uwbsim.world.world import World

MASK: Final = (1 << REPORT_BITS) - 1
CARRIED: Final = ("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")


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
    if not parts:
        return {}
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.argsort(columns["time_ns"], kind="stable")
    return {name: column[order] for name, column in columns.items()}


def _look_ahead(medium: Medium, stamped: Stamped) -> None:
    """Let the world work out what all listeners will ask for: together it takes half the time."""
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
            columns |= {f"rx{name}": np.zeros(count, dtype=np.int64)}
            columns |= {
                f"{what}{name}_{unit}": np.full(count, np.nan) for what, unit in (("fpp", "dbm"), ("skew", "ppm"))
            }
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
    columns |= {f"{name}_n": getattr(exchanges, name)[rows] for name in CARRIED}
    for name in ("fpp1", "fpp2"):
        columns[f"{name}_n_dbm"] = getattr(exchanges, f"{name}_dbm")[rows]
    for name in ("skew1", "skew2"):
        columns[f"{name}_n_ppm"] = getattr(exchanges, f"{name}_ppm")[rows]
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
