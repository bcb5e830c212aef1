"""Runs a scenario: plan, event loop, stamps, and the recording that a real flight would have made."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Bools, Floats, Ints
from uwblink.protocols.rows import RangingProtocol
from uwblink.protocols.table import PROTOCOLS
from uwblink.recording.file import Recording
from uwblink.recording.schema import CirRow, Fault, FrameRow, Poses, Tag
from uwblink.ticks import REPORT_BITS, UUS_TICKS
from uwblink.twr import STAMPS, Exchanges, board_range, raw_range
from uwbsim.errors import ScenarioError
from uwbsim.random_streams import stream
from uwbsim.scenario.airtime import before_marker_s
from uwbsim.scenario.loading import Source, as_scenario
from uwbsim.scenario.model import Scenario
from uwbsim.simulation import air
from uwbsim.simulation.overhearing import overhear, responses
from uwbsim.simulation.schedule import Schedule, schedule
from uwbsim.simulation.timestamps import Begun, Draws, Stamped, draw, stamp
from uwbsim.units import NS_PER_S
from uwbsim.world.channel import CHANNEL_EFFECTS, OWN_EFFECTS
from uwbsim.world.clocks import LONGEST_RUN_S, Clocks
from uwbsim.world.inertial import height_readings, inertial_readings
from uwbsim.world.lookahead import SampledWorld
from uwbsim.world.reception import Medium
from uwbsim.world.temperature import readings
from uwbsim.world.true_time import SUBTICKS, SUBTICKS_PER_SECOND
from uwbsim.world.world import World


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Simulated:
    """A simulated flight in memory: what a recording of it holds, and the truth, which none does.

    `exchanges` are n exchanges in order of time and `truth_m` (n,) their true distances in metres, each the mean over
    the first two messages; `poses` are those of motion capture; `tags` say which body carries which tag, and where;
    `faults` are the exchanges that failed. `overheard` are the columns of what passive tags heard, `cirs` impulse
    responses (time_ns, board, initiator, target, first path in taps, 1016 magnitudes). `meta` is the recording's
    provenance. `temperature` are the columns of what tags with a temperature or a supply voltage read of them, `imu`
    and `height` those of bodies' inertial and height sensors.

    >>> import uwbsim
    >>> mast, drone = ({"model": "static", "position_m": [x, 0.0, 2.0]} for x in (0.0, 5.0))
    >>> flight = uwbsim.simulate(
    ...     {
    ...         "run": {"name": "two", "duration_s": 2.0},
    ...         "ranging": {"rate_hz": 50.0},
    ...         "bodies": [{"name": "mast", "motion": mast}, {"name": "drone", "motion": drone}],
    ...         "tags": [{"id": 1, "body": "mast"}, {"id": 2, "body": "drone"}],
    ...     }
    ... )
    >>> print(flight)
    Simulated 'two': 100 exchanges (ds) of 2 tags on 2 bodies in 2 s
      raw range less truth: median +0.3 cm, standard deviation 2.8 cm
      failed: none
      poses: 414; overheard: 0; impulse responses: 0
    >>> flight.save("two.uwb")
    """

    exchanges: Exchanges
    poses: Poses
    tags: list[Tag]
    faults: list[Fault]
    overheard: dict[str, NDArray[Any]]
    cirs: list[CirRow]
    truth_m: Floats
    meta: dict[str, Any]
    temperature: dict[str, NDArray[Any]] = field(default_factory=dict)
    imu: dict[str, NDArray[Any]] = field(default_factory=dict)
    height: dict[str, NDArray[Any]] = field(default_factory=dict)

    @property
    def planted(self) -> dict[str, Any]:
        """Return what a calibration should find: `delays_ns` by tag, `bias_curve`, `sigma_curve`, `alpha_dbm`."""
        planted: dict[str, Any] = self.meta["planted"]
        return planted

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        frames: Sequence[FrameRow] = (),
        force: bool = False,
    ) -> None:
        """Write a recording (.uwb), with the bytes of boards where there are any (`through_wire`).

        Raises `RecordingExistsError` where the file is there already, unless `force` says to replace it.
        """
        write(self, path, frames=frames, force=force)

    def __repr__(self) -> str:
        """Return a few lines: what was simulated, how the raw ranges err, and what failed."""
        return _described(self)


@dataclass(frozen=True, slots=True)
class _Run:
    """Everything a run needs at hand, made once from the scenario."""

    scenario: Scenario
    protocol: RangingProtocol
    world: World
    medium: Medium


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
    run = _Run(scenario, protocol, world, Medium(scenario, world, Clocks.of(scenario)))
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
    exchanges = _exchanges(run, kept, len(plan.start), rows, stamped)
    return Simulated(
        exchanges=exchanges,
        poses=run.world.motion_capture(),
        tags=[Tag(t.id, t.body, t.lever_arm_m) for t in scenario.tags],
        faults=_faults(run, begun, plan, outcomes),
        overheard=overhear(run.medium, stamped, exchanges),
        cirs=responses(scenario, run.world, protocol, exchanges, stamped) if scenario.ranging.get_cir else [],
        truth_m=(stamped.distance_m[0] + stamped.distance_m[1]) / 2,
        meta=_provenance(scenario),
        temperature=readings(scenario),
        imu=inertial_readings(scenario, world.trajectories),
        height=height_readings(scenario, world.trajectories),
    )


def write(
    simulated: Simulated,
    path: str | os.PathLike[str],
    *,
    frames: Sequence[FrameRow] = (),
    force: bool = False,
) -> None:
    """Write the recording, with the bytes of boards where there are any; raises what `Recording.create` raises."""
    with Recording.create(path, meta=simulated.meta, force=force) as recording:
        recording.append_tags(simulated.tags)
        recording.append_poses(simulated.poses)
        recording.append_exchanges(simulated.exchanges)
        recording.append_faults(simulated.faults)
        recording.append_columns("overheard", simulated.overheard)
        recording.append_columns("temperature", simulated.temperature)
        recording.append_columns("imu", simulated.imu)
        recording.append_columns("height", simulated.height)
        recording.append_cirs(simulated.cirs)
        recording.append_frames(frames)


def _described(flight: Simulated) -> str:
    run, ranging = (flight.meta["scenario"][name] for name in ("run", "ranging"))
    error = raw_range(flight.exchanges) - flight.truth_m
    reasons = Counter(fault.kind for fault in flight.faults)
    failed = ", ".join(f"{count} {reason}" for reason, count in sorted(reasons.items())) or "none"
    lines = [
        f"Simulated {run['name']!r}: {len(flight.exchanges)} exchanges ({ranging['protocol']}) of "
        f"{len(flight.tags)} tags on {len({tag.body for tag in flight.tags})} bodies in {run['duration_s']:g} s",
        f"  failed: {failed}",
        f"  poses: {len(flight.poses)}; overheard: {len(flight.overheard.get('time_ns', ()))}; "
        f"impulse responses: {len(flight.cirs)}",
    ]
    if len(error):
        median, spread = (100 * float(v) for v in (np.median(error), np.std(error)))
        lines.insert(1, f"  raw range less truth: median {median:+.1f} cm, standard deviation {spread:.1f} cm")
    return "\n".join(lines)


def _slots(run: _Run, plan: Schedule, draws: Draws) -> air.Slots:
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


def _undisturbed(run: _Run, plan: Schedule, draws: Draws) -> air.Outcomes:
    """What becomes of exchanges that do not meet: only a message too weak to be heard is lost."""
    heard = _heard(run, plan, draws)
    lost = np.where(heard.all(axis=0), -1, np.argmin(heard, axis=0))
    marker = round(before_marker_s(run.scenario.radio.preamble_symbols) * SUBTICKS_PER_SECOND)
    reasons = [air.WEAK if k >= 0 else "" for k in lost.tolist()]
    return air.Outcomes((plan.start + marker).tolist(), lost.tolist(), reasons)


def _pauses(run: _Run, plan: Schedule) -> list[int]:
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


def _heard(run: _Run, plan: Schedule, draws: Draws) -> Bools:
    """Whether each message (messages, n) is received; a little fading makes the edge soft."""
    forth = back = run.world.link(plan.initiator, plan.target, plan.start).power_dbm
    if any(tag.tx_power_db for tag in run.scenario.tags):
        back = run.world.link(plan.target, plan.initiator, plan.start).power_dbm
    power_dbm = np.array([forth if m.sender == "initiator" else back for m in run.protocol.messages])
    if run.world.levels is not None:
        power_dbm = _at_their_instants(run, plan, draws)
    fading = stream(run.scenario.run.seed, "fading").normal(size=power_dbm.shape)
    return run.medium.heard(power_dbm, fading)


def _at_their_instants(run: _Run, plan: Schedule, draws: Draws) -> Floats:
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


def _exchanges(run: _Run, kept: Ints, planned: int, rows: Begun, stamped: Stamped) -> Exchanges:
    initiator, target = rows.initiator, rows.target
    ids = np.array([tag.id for tag in run.scenario.tags], dtype=np.int64)
    mask = (1 << REPORT_BITS) - 1
    none = np.zeros(len(kept), dtype=np.int64)
    stamps: dict[str, Ints] = {name: stamped.stamps.get(name, none) & mask for name in STAMPS}
    fpp1, skew1 = _readings(run, 1, kept, planned, stamped)
    fpp2, skew2 = _readings(run, 2, kept, planned, stamped)
    nan = np.full(len(kept), np.nan)
    exchanges = Exchanges(
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
    return replace(exchanges, range_m=printed(exchanges))


def _readings(run: _Run, number: int, kept: Ints, planned: int, stamped: Stamped) -> tuple[Floats, Floats]:
    """What the receiver of message `number` prints: first-path power and relative skew."""
    seed = run.scenario.run.seed
    power_noise = stream(seed, "power reading", number).normal(size=planned)[kept]
    skew_noise = stream(seed, "skew reading", number).normal(size=planned)[kept]
    return run.medium.readings(stamped.frames[number - 1], stamped.power_dbm[number - 1], power_noise, skew_noise)


def _faults(run: _Run, begun: Ints, plan: Schedule, outcomes: air.Outcomes) -> list[Fault]:
    ids = [tag.id for tag in run.scenario.tags]
    faults = []
    for k in np.flatnonzero(np.array(outcomes.lost) >= 0):
        a, b = ids[plan.initiator[k]], ids[plan.target[k]]
        reason = outcomes.reason[k]
        faults.append(
            Fault(
                round(int(begun[k]) * (NS_PER_S / SUBTICKS_PER_SECOND)),
                str(a),
                "lost frame" if reason == air.WEAK else reason,
                f"{a} ranged with {b}: message {outcomes.lost[k] + 1} {reason}",
                a,
                b,
            )
        )
    return faults


def _provenance(scenario: Scenario) -> dict[str, Any]:
    # A scenario's text does not say what strangers added to the channel, and the flight cannot be repeated without.
    added = [name for name in CHANNEL_EFFECTS if name not in OWN_EFFECTS]
    return {
        "source": "simulation",
        "scenario": scenario.model_dump(mode="json"),
        "scenario_name": scenario.run.name,
        "seed": scenario.run.seed,
        "planted": scenario.planted(),
    } | ({"channel_effects": added} if added else {})
