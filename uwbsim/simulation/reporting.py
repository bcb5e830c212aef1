"""What boards report of a run: columns of exchanges from their stamps, what failed, and where all of it comes from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from uwblink.arrays import Floats, Ints
from uwblink.protocols.rows import RangingProtocol
from uwblink.recording.antenna_delays import AntennaDelay, AntennaDelays, meta_of_delays
from uwblink.recording.schema import Fault
from uwblink.ticks import REPORT_BITS
from uwblink.twr import STAMPS, Exchanges, board_range, raw_range
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.simulation import air
from uwbsim.simulation.schedule import Schedule
from uwbsim.simulation.timestamps import Begun, Stamped
from uwbsim.units import NS_PER_S
from uwbsim.world.channel import CHANNEL_EFFECTS, OWN_EFFECTS
from uwbsim.world.reception import Medium
from uwbsim.world.true_time import SUBTICKS_PER_SECOND
from uwbsim.world.world import World


@dataclass(frozen=True, slots=True)
class Run:
    """Everything a run needs at hand, made once from the scenario."""

    scenario: Scenario
    protocol: RangingProtocol
    world: World
    medium: Medium


def reported_exchanges(run: Run, kept: Ints, planned: int, rows: Begun, stamped: Stamped) -> Exchanges:
    """Return the reports of the `kept` exchanges (n,), of all `planned`: stamps wrapped, ranges as printed."""
    initiator, target = rows.initiator, rows.target
    ids = np.array([tag.id for tag in run.scenario.tags], dtype=np.int64)
    mask = (1 << REPORT_BITS) - 1
    none = np.zeros(len(kept), dtype=np.int64)
    stamps: dict[str, Ints] = {name: stamped.stamps.get(name, none) & mask for name in STAMPS}
    fpp1, skew1 = _readings(run, 1, kept, planned, stamped)
    fpp2, skew2 = _readings(run, 2, kept, planned, stamped)
    nan = np.full(len(kept), np.nan)
    found = Exchanges(
        time_ns=np.rint(stamped.frames[0].departure * (NS_PER_S / SUBTICKS_PER_SECOND)).astype(np.int64),
        initiator=ids[initiator],
        target=ids[target],
        protocol=np.full(len(kept), run.protocol.name),
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
    printed = board_range if run.scenario.radio.quantize else raw_range
    return replace(found, range_m=printed(found))


def _readings(run: Run, number: int, kept: Ints, planned: int, stamped: Stamped) -> tuple[Floats, Floats]:
    """What the receiver of message `number` prints: first-path power and relative skew."""
    seed = run.scenario.run.seed
    power_noise = stream(seed, "power reading", number).normal(size=planned)[kept]
    skew_noise = stream(seed, "skew reading", number).normal(size=planned)[kept]
    return run.medium.readings(stamped.frames[number - 1], stamped.power_dbm[number - 1], power_noise, skew_noise)


def reported_faults(run: Run, begun: Ints, plan: Schedule, outcomes: air.Outcomes) -> list[Fault]:
    """Return what became of the exchanges that failed, each under its initiator's name."""
    ids = [tag.id for tag in run.scenario.tags]
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
    """Return what is programmed into tags; under None what is usual, and the others by their ids."""
    found = {tag.id: AntennaDelay(**tag.antenna_delay.model_dump()) for tag in scenario.tags}
    return {None: AntennaDelay(), **{tag: one for tag, one in found.items() if one != AntennaDelay()}}


def provenance(scenario: Scenario) -> dict[str, Any]:
    """Return a recording's `meta` of a simulated flight: the scenario whole, its seed, and what it planted."""
    # A scenario's text does not say what strangers added to the channel, and the flight cannot be repeated without.
    added = [name for name in CHANNEL_EFFECTS if name not in OWN_EFFECTS]
    return {
        "source": "simulation",
        "scenario": scenario.model_dump(mode="json"),
        "scenario_name": scenario.run.name,
        "seed": scenario.run.seed,
        "planted": scenario.planted(),
        **meta_of_delays(_programmed(scenario)),
    } | ({"channel_effects": added} if added else {})
