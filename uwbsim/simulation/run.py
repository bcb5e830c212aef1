"""Runs a scenario: plan, event loop, stamps, and what boards would have reported of the flight."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from uwblink.arrays import Bools, Floats, Ints
from uwblink.protocols.table import PROTOCOLS
from uwblink.recording.schema import Tag
from uwblink.ticks import UUS_TICKS
from uwbsim.errors import ScenarioError
from uwbsim.random_streams import stream
from uwbsim.scenario.loading import Source, as_scenario
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.ranging import before_marker_s
from uwbsim.simulation import air
from uwbsim.simulation.air import Schedule, schedule
from uwbsim.simulation.reporting import overhear, provenance, reported_exchanges, reported_faults, responses
from uwbsim.simulation.simulated import Simulated
from uwbsim.simulation.timestamps import Begun, Draws, draw, stamp
from uwbsim.world.clocks import LONGEST_RUN_S, SUBTICKS, SUBTICKS_PER_SECOND, Clocks
from uwbsim.world.reception import Medium
from uwbsim.world.temperature import readings
from uwbsim.world.trajectories import height_readings, inertial_readings
from uwbsim.world.world import SampledWorld, World


def simulate(
    scenario: Scenario | Source, progress: Callable[[float], None] | None = None, *, contention: bool = True
) -> Simulated:
    """Simulate a scenario: give exchanges and truth in memory; the same scenario gives the same on every machine.

    `scenario` is a `Scenario`, a file (.toml), TOML text of more than one line, or the same as nested tables. Without
    `contention` there is no event loop: every exchange begins when it is planned and disturbs no other, so where
    exchanges do not meet the stamps are the same, sooner. `progress` is called with the done fraction, 0 to 1. Raises
    `ScenarioError` for a scenario that cannot be, and for one longer than the integer true time carries (36 h).

    >>> import uwbsim
    >>> flight = uwbsim.simulate(
    ...     {
    ...         "run": {"duration_s": 2.0, "seed": 1},
    ...         "ranging": {"rate_hz": 50.0},
    ...         "bodies": [
    ...             {"name": "mast", "motion": {"model": "static", "position_m": [0.0, 0.0, 2.0]}},
    ...             {"name": "drone", "motion": {"model": "static", "position_m": [3.0, 4.0, 2.0]}},
    ...         ],
    ...         "tags": [{"id": 1, "body": "mast"}, {"id": 2, "body": "drone", "delay_ns": -0.3}],
    ...     }
    ... )
    >>> len(flight.exchanges), flight.truth_m.max().round(6).item(), round(flight.planted["delays_ns"]["2"], 6)
    (100, 5.0, -0.3)
    """
    scenario = as_scenario(scenario)
    if scenario.run.duration_s > LONGEST_RUN_S:
        raise ScenarioError(f"run.duration_s: at most {LONGEST_RUN_S:g} (36 h)")
    protocol = PROTOCOLS[scenario.ranging.protocol]
    world = World.of(scenario)
    medium = Medium(scenario, world, Clocks.of(scenario))
    plan = schedule(scenario)
    draws = draw(scenario, len(plan.start), len(protocol.messages))
    if contention:
        ahead, radio = SampledWorld(world), scenario.radio

        def powers(sender: int, time: int) -> Floats:
            return ahead.from_sender(sender, max(time, 0)).power_dbm

        slots = _slots(medium, world, plan, draws)
        outcomes = air.run(protocol, slots, plan.hosts(), len(scenario.tags), powers, radio, progress)
    else:
        outcomes = _undisturbed(medium, world, plan, draws)
    lost, begun = np.array(outcomes.lost), np.array(outcomes.start, dtype=np.int64)
    kept = np.flatnonzero(lost < 0)
    kept = kept[np.argsort(begun[kept], kind="stable")]
    rows = Begun(start=begun[kept], initiator=plan.initiator[kept], target=plan.target[kept])
    stamped = stamp(medium, protocol, rows, draws[kept])
    exchanges = reported_exchanges(medium, kept, len(plan.start), rows, stamped)
    return Simulated(
        exchanges=exchanges,
        poses=world.motion_capture(),
        tags=[Tag(t.id, t.body, t.lever_arm_m) for t in scenario.tags],
        faults=reported_faults(scenario, begun, plan, outcomes),
        overheard=overhear(medium, stamped, exchanges),
        cirs=responses(scenario, world, protocol, exchanges, stamped) if scenario.ranging.get_cir else [],
        truth_m=(stamped.distance_m[0] + stamped.distance_m[1]) / 2,
        meta=provenance(scenario),
        temperature=readings(scenario),
        imu=inertial_readings(scenario, world.trajectories),
        height=height_readings(scenario, world.trajectories),
    )


def _delays(scenario: Scenario, draws: Draws) -> dict[str, Ints]:
    """Return by the timing of a message how long after the stamp that it waits for it leaves, in sub-ticks, (n,)."""
    at_once = np.rint(draws.reply_s * SUBTICKS_PER_SECOND).astype(np.int64)
    scheduled = scenario.ranging.response_delay_uus * UUS_TICKS * SUBTICKS
    return {"at once": at_once, "scheduled": np.full_like(at_once, scheduled)}


def _slots(medium: Medium, world: World, plan: Schedule, draws: Draws) -> air.Slots:
    """Give the event loop what it needs, as plain integers: it does no arithmetic of its own."""
    scenario, delays = medium.scenario, _delays(medium.scenario, draws)
    none = np.zeros(len(plan.start), dtype=np.int64)
    if scenario.ranging.plan == "common-list" and len(none) > 1:
        # In a common list the initiator waits for what it does not hear of the exchange before.
        before, mine = plan.target[:-1], plan.initiator[1:]
        others = np.flatnonzero(before != mine)
        power = world.link(before[others], mine[others], plan.start[others + 1]).power_dbm
        none[others[power < scenario.radio.sensitivity_dbm] + 1] = round(
            (scenario.ranging.list_timeout_ms * 1e-3) * SUBTICKS_PER_SECOND
        )
    return air.Slots(
        plan.start.tolist(),
        plan.initiator.tolist(),
        plan.target.tolist(),
        none.tolist(),
        _heard(medium, world, plan, draws),
        np.array([delays[message.timing] for message in PROTOCOLS[scenario.ranging.protocol].messages]),
    )


def _undisturbed(medium: Medium, world: World, plan: Schedule, draws: Draws) -> air.Outcomes:
    """Return what becomes of exchanges that do not meet: only a message too weak to be heard is lost."""
    heard = _heard(medium, world, plan, draws)
    lost = np.where(heard.all(axis=0), -1, np.argmin(heard, axis=0))
    marker = round(before_marker_s(medium.scenario.radio.preamble_symbols) * SUBTICKS_PER_SECOND)
    reasons = [air.WEAK if k >= 0 else "" for k in lost.tolist()]
    return air.Outcomes((plan.start + marker).tolist(), lost.tolist(), reasons)


def _heard(medium: Medium, world: World, plan: Schedule, draws: Draws) -> Bools:
    """Return whether each message (messages, n) is received; a little fading makes the edge soft."""
    scenario, time = medium.scenario, plan.start
    messages = PROTOCOLS[scenario.ranging.protocol].messages
    delays = None
    if world.levels is not None:
        # An outage may begin within an exchange, so powers are those at the messages' own instants.
        delays = _delays(scenario, draws)
        time = time + round(before_marker_s(scenario.radio.preamble_symbols) * SUBTICKS_PER_SECOND)
    powers: list[Floats] = []
    for message in messages:
        if delays is not None and message.after:
            time = time + delays[message.timing]
        ends = (plan.initiator, plan.target) if message.sender == "initiator" else (plan.target, plan.initiator)
        # Without levels and unequal powers all messages of an exchange have the power of its first.
        same = powers and delays is None and not any(tag.tx_power_db for tag in scenario.tags)
        powers.append(powers[0] if same else world.link(*ends, time).power_dbm)
    fading = stream(scenario.run.seed, "fading").normal(size=(len(messages), len(time)))
    return medium.heard(np.array(powers), fading)
