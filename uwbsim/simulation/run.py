"""Runs a scenario: plan, event loop, stamps, and what boards would have reported of the flight."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from uwblink.arrays import Bools, Floats
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
from uwbsim.simulation.reporting import Run, overhear, provenance, reported_exchanges, reported_faults, responses
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
    run = Run(scenario, protocol, world, Medium(scenario, world, Clocks.of(scenario)))
    plan = schedule(scenario)
    draws = draw(scenario, len(plan.start), len(protocol.messages))
    if contention:
        slots, powers = _slots(run, plan, draws), _powers(run.world)
        outcomes = air.run(protocol, slots, plan.hosts(), len(scenario.tags), powers, _rules(scenario), progress)
    else:
        outcomes = _undisturbed(run, plan, draws)
    lost, begun = np.array(outcomes.lost), np.array(outcomes.start, dtype=np.int64)
    kept = np.flatnonzero(lost < 0)
    kept = kept[np.argsort(begun[kept], kind="stable")]
    rows = Begun(start=begun[kept], initiator=plan.initiator[kept], target=plan.target[kept])
    stamped = stamp(run.medium, protocol, rows, draws[kept])
    exchanges = reported_exchanges(run, kept, len(plan.start), rows, stamped)
    return Simulated(
        exchanges=exchanges,
        poses=run.world.motion_capture(),
        tags=[Tag(t.id, t.body, t.lever_arm_m) for t in scenario.tags],
        faults=reported_faults(run, begun, plan, outcomes),
        overheard=overhear(run.medium, stamped, exchanges),
        cirs=responses(scenario, run.world, protocol, exchanges, stamped) if scenario.ranging.get_cir else [],
        truth_m=(stamped.distance_m[0] + stamped.distance_m[1]) / 2,
        meta=provenance(scenario),
        temperature=readings(scenario),
        imu=inertial_readings(scenario, world.trajectories),
        height=height_readings(scenario, world.trajectories),
    )


def _slots(run: Run, plan: Schedule, draws: Draws) -> air.Slots:
    """Give the event loop what it needs, as plain integers: it does no arithmetic of its own."""
    scheduled = run.scenario.ranging.response_delay_uus * UUS_TICKS * SUBTICKS
    at_once = np.rint(draws.reply_s * SUBTICKS_PER_SECOND).astype(np.int64)
    delay = [at_once if m.timing == "at once" else np.full_like(at_once, scheduled) for m in run.protocol.messages]
    return air.Slots(
        plan.start.tolist(),
        plan.initiator.tolist(),
        plan.target.tolist(),
        _pauses(run, plan),
        _heard(run, plan, draws),
        np.array(delay),
    )


def _undisturbed(run: Run, plan: Schedule, draws: Draws) -> air.Outcomes:
    """What becomes of exchanges that do not meet: only a message too weak to be heard is lost."""
    heard = _heard(run, plan, draws)
    lost = np.where(heard.all(axis=0), -1, np.argmin(heard, axis=0))
    marker = round(before_marker_s(run.scenario.radio.preamble_symbols) * SUBTICKS_PER_SECOND)
    reasons = [air.WEAK if k >= 0 else "" for k in lost.tolist()]
    return air.Outcomes((plan.start + marker).tolist(), lost.tolist(), reasons)


def _pauses(run: Run, plan: Schedule) -> list[int]:
    """How long each slot's initiator waits first: in a common list, for what it does not hear of the one before."""
    scenario = run.scenario
    none = np.zeros(len(plan.start), dtype=np.int64)
    if scenario.ranging.plan != "common-list" or len(none) < 2:
        return [0] * len(none)
    before, power = plan.target[:-1], np.full(len(none), np.inf)
    mine = plan.initiator[1:]
    other = np.flatnonzero(before != mine)
    power[other + 1] = run.world.link(before[other], mine[other], plan.start[other + 1]).power_dbm
    timeout = round(scenario.ranging.list_timeout_s * SUBTICKS_PER_SECOND)
    return [timeout if weak else 0 for weak in (power < scenario.radio.sensitivity_dbm).tolist()]


def _powers(world: World) -> air.Powers:
    ahead = SampledWorld(world)
    return lambda sender, time: ahead.from_sender(sender, max(time, 0)).power_dbm


def _rules(scenario: Scenario) -> air.Rules:
    radio = scenario.radio
    return air.Rules(radio.sensitivity_dbm, radio.capture_db, radio.preamble_symbols)


def _heard(run: Run, plan: Schedule, draws: Draws) -> Bools:
    """Whether each message (messages, n) is received; a little fading makes the edge soft."""
    forth = back = run.world.link(plan.initiator, plan.target, plan.start).power_dbm
    if any(tag.tx_power_db for tag in run.scenario.tags):
        back = run.world.link(plan.target, plan.initiator, plan.start).power_dbm
    power_dbm = np.array([forth if m.sender == "initiator" else back for m in run.protocol.messages])
    if run.world.levels is not None:
        power_dbm = _at_their_instants(run, plan, draws)
    fading = stream(run.scenario.run.seed, "fading").normal(size=power_dbm.shape)
    return run.medium.heard(power_dbm, fading)


def _at_their_instants(run: Run, plan: Schedule, draws: Draws) -> Floats:
    """Return the powers of messages (messages, n) when they leave: an outage may begin within an exchange."""
    at_once = np.rint(draws.reply_s * SUBTICKS_PER_SECOND).astype(np.int64)
    scheduled = run.scenario.ranging.response_delay_uus * UUS_TICKS * SUBTICKS
    delay = {"at once": at_once, "scheduled": np.full_like(at_once, scheduled)}
    time, powers = plan.start + round(before_marker_s(run.scenario.radio.preamble_symbols) * SUBTICKS_PER_SECOND), []
    for message in run.protocol.messages:
        time = time + delay[message.timing] if message.after else time
        ends = (plan.initiator, plan.target) if message.sender == "initiator" else (plan.target, plan.initiator)
        powers.append(run.world.link(*ends, time).power_dbm)
    return np.array(powers)
