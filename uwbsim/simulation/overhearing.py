"""What passive tags overhear of a flight, and the channel impulse responses of its receptions."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Ints
from uwblink.recording.schema import CirRow
from uwblink.ticks import REPORT_BITS, SPEED_OF_LIGHT
from uwblink.twr import Exchanges, RangingProtocol
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.simulation.timestamps import Stamped, reception
from uwbsim.world.clocks import SUBTICKS_PER_SECOND, Clocks
from uwbsim.world.impulse_response import impulse_response
from uwbsim.world.radio import printed_power_dbm, printed_skew_ppm, reception_bias_s, reception_noise_s
from uwbsim.world.world import World

MASK: Final = (1 << REPORT_BITS) - 1
CARRIED: Final = ("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")


def overhear(
    scenario: Scenario,
    protocol: RangingProtocol,
    world: World,
    clocks: Clocks,
    initiator: Ints,
    target: Ints,
    stamped: Stamped,
    exchanges: Exchanges,
) -> dict[str, NDArray[Any]]:
    """Return the table `overheard` as columns, in order of time: every exchange at every passive tag that hears it.

    `initiator` and `target` are places (n,). A listener that misses a message reports nothing.
    """
    parts = []
    for me, tag in enumerate(scenario.tags):
        rows = np.flatnonzero((initiator != me) & (target != me))
        if not tag.passive or not len(rows):
            continue
        parts.append(_heard_by(scenario, protocol, world, clocks, me, rows, initiator, target, stamped, exchanges))
    if not parts:
        return {}
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.argsort(columns["time_ns"], kind="stable")
    return {name: column[order] for name, column in columns.items()}


def _heard_by(  # noqa: PLR0913 - the columns of one flight
    scenario: Scenario,
    protocol: RangingProtocol,
    world: World,
    clocks: Clocks,
    me: int,
    rows: Ints,
    initiator: Ints,
    target: Ints,
    stamped: Stamped,
    exchanges: Exchanges,
) -> dict[str, NDArray[Any]]:
    radio, seed, tag = scenario.radio, scenario.run.seed, scenario.tags[me]
    count, mine = len(rows), np.full(len(rows), me)
    delay = np.full(count, tag.delays_ns()[1] * 1e-9 * SUBTICKS_PER_SECOND)
    heard = np.ones(count, dtype=bool)
    columns: dict[str, NDArray[Any]] = {}
    for k in range(3):
        name = str(k + 1)
        if k >= len(protocol.messages):
            columns |= {f"rx{name}": np.zeros(count, dtype=np.int64)}
            columns |= {
                f"{what}{name}_{unit}": np.full(count, np.nan) for what, unit in (("fpp", "dbm"), ("skew", "ppm"))
            }
            continue
        sender = (initiator if protocol.messages[k].sender == "initiator" else target)[rows]
        departure = stamped.departure[k][rows]
        link = world.link(sender, mine, departure)
        # One stream a listener and message: another listener, or another noise, changes nothing else.
        noise = stream(seed, "overheard", tag.id, k).normal(size=(4, len(initiator)))[:, rows]
        heard &= link.power_dbm + noise[0] * radio.power_noise_db >= radio.sensitivity_dbm
        late_s = reception_bias_s(radio, link.power_dbm, link.total_dbm)
        late_s = late_s + noise[1] * reception_noise_s(radio, link.power_dbm)
        flight = np.rint((link.distance_m + link.excess_m) / SPEED_OF_LIGHT * SUBTICKS_PER_SECOND).astype(np.int64)
        skew = (clocks.rate(mine, departure) - clocks.rate(sender, departure)) * 1e6
        columns[f"rx{name}"] = reception(clocks, mine, departure + flight, late_s, delay) & MASK
        columns[f"fpp{name}_dbm"] = printed_power_dbm(radio, link.power_dbm, noise[2])
        columns[f"skew{name}_ppm"] = printed_skew_ppm(radio, skew, noise[3])
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
    columns = (exchanges.time_ns, exchanges.initiator, exchanges.target, stamps, stamped.departure[last])
    rows = []
    for time_ns, initiator, target, rx, departure in zip(*(c.tolist() for c in columns), strict=True):
        echoes = world.echoes(place[target], place[initiator], departure)
        index, taps = impulse_response(rng, rx, echoes)
        rows.append(CirRow(time_ns, initiator, initiator, target, index / 1000, taps))
    return rows
