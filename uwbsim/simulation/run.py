"""Simulation of a scenario (plan, event loop, stamps, reports of the boards), and its preview."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from html import escape
from typing import Any

import numpy as np

from uwblink.arrays import Floats
from uwblink.protocols.table import ON_BOARDS, PROTOCOLS, RangingProtocol
from uwblink.recording.contents import Contents
from uwblink.recording.schema import FrameRow, Tag
from uwblink.ticks import COUNTER_BITS, SPEED_OF_LIGHT, TICK_S, UUS_TICKS, elapsed
from uwblink.twr import raw_range
from uwblink.wire.codec import Decoder, encode, exchanges_of
from uwblink.wire.messages import REPORTS, RangeReport
from uwbsim.errors import ScenarioError
from uwbsim.random_streams import stream
from uwbsim.scenario.loading import Source, as_scenario
from uwbsim.scenario.model import NO_BROADCASTS, Scenario
from uwbsim.scenario.ranging import before_marker_s
from uwbsim.simulation.air import WEAK, Air, Outcomes, Schedule, Slots, schedule, with_collisions_of_broadcasts
from uwbsim.simulation.timestamps import (
    Draws,
    draw,
    provenance,
    reported_broadcasts,
    reported_exchanges,
    reported_faults,
    responses,
    stamp,
)
from uwbsim.world.clocks import LONGEST_RUN_S, NS_PER_S, SUBTICKS, SUBTICKS_PER_SECOND, readings
from uwbsim.world.reception import Medium
from uwbsim.world.trajectories import sensor_readings
from uwbsim.world.world import SampledWorld, World


@dataclass(frozen=True, kw_only=True, repr=False)
class Simulated(Contents):
    """A simulated flight in memory: the contents of its recording, and the true distances, which are not recorded.

    `truth_m` (n,) are the true distances of the n exchanges in metres, each the mean over the first two messages, of
    broadcasts that at the poll; a selection (`select`) is without them. `poses` are those of motion capture, `faults`
    the exchanges that failed, `overheard` what passive tags received, `receptions` all received broadcasts,
    `temperature` the tags' readings of temperature and supply voltage, `imu` and `height` those of the bodies' sensors.
    `meta` is the recording's provenance.

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

    truth_m: Floats

    @property
    def planted(self) -> dict[str, Any]:
        """Return the planted values: `delays_ns` by tag, `bias_curve`, `sigma_curve`, `alpha_dbm`."""
        return dict(self.meta["planted"])

    def save(self, path: str | os.PathLike[str], *, frames: Sequence[FrameRow] = (), force: bool = False) -> None:
        """Write a recording (.uwb); `frames` are the bytes of the boards, from `through_wire`.

        Raises `RecordingExistsError` if the file exists, unless `force` is set.
        """
        Contents.save(replace(self, frames=list(frames)), path, force=force)

    def _repr_html_(self) -> str:
        """Return these lines, the first exchanges, and a figure of the errors over time, for a notebook."""
        from uwblink.pages.figures import notebook_image, values_over_time

        errors, name = 100 * (raw_range(self.exchanges) - self.truth_m), "raw range less truth (cm)"
        draw = partial(values_over_time, time_ns=self.exchanges.time_ns, values=errors, name=name)
        drawn = notebook_image(draw, f"{name} over time")
        return f"<pre>{escape(repr(self))}</pre>{self.exchanges._repr_html_()}{drawn}"

    def __repr__(self) -> str:
        """Return a few lines: counts, errors of the raw ranges, and failures."""
        run, ranging = (self.meta["scenario"][name] for name in ("run", "ranging"))
        error = raw_range(self.exchanges) - self.truth_m
        reasons = Counter(fault.kind for fault in self.faults)
        failed = ", ".join(f"{count} {reason}" for reason, count in sorted(reasons.items())) or "none"
        lines = [
            f"Simulated {run['name']!r}: {len(self.exchanges)} exchanges ({ranging['protocol']}) of "
            f"{len(self.tags)} tags on {len({tag.body for tag in self.tags})} bodies in {run['duration_s']:g} s",
            f"  failed: {failed}",
            f"  poses: {len(self.poses)}; overheard: {len(self.overheard.get('time_ns', ()))}; "
            f"impulse responses: {len(self.cirs)}"
            + (f"; receptions: {len(self.receptions['time_ns'])}" if self.receptions else ""),
        ]
        if len(error):
            median, spread = (100 * float(v) for v in (np.median(error), np.std(error)))
            lines.insert(1, f"  raw range less truth: median {median:+.1f} cm, standard deviation {spread:.1f} cm")
        return "\n".join(lines)


def simulate(
    scenario: Scenario | Source, *, progress: Callable[[float], None] | None = None, contention: bool = True
) -> Simulated:
    """Simulate a scenario in memory; the same scenario gives the same exchanges on every machine.

    `scenario` is a `Scenario`, a file (.toml), TOML text of more than one line, or the same as nested tables. Without
    `contention` there is no event loop: every exchange begins when planned and disturbs no other; stamps of exchanges
    that do not overlap are the same, and simulation is faster. `progress` is called with the done fraction, 0 to 1.
    Raises `ScenarioError` for an invalid scenario, and for one longer than the integer true time can hold (36 h), and
    `ArgumentError` for broadcasts that make no exchange.

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
    broadcast, protocol = scenario.ranging.plan == "broadcast", PROTOCOLS[scenario.ranging.protocol]
    if broadcast:  # every row of the plan is a message to one listener
        protocol = replace(protocol, messages=protocol.messages[:1])
    world, plan = World(scenario), schedule(scenario)
    medium, draws = Medium(scenario, world), draw(scenario, len(plan.start), len(protocol.messages))
    if broadcast:
        # All rows of a frame have the noise of one departure.
        listeners = len(scenario.tags) - 1
        draws = replace(draws, transmit=np.repeat(draws.transmit[::listeners], listeners, axis=0))
    slots = _slots(medium, world, protocol, plan, draws)
    outcomes = _executed(medium, world, protocol, slots, progress, contention=contention)
    begun, lost = np.array(outcomes.start, dtype=np.int64), np.array(outcomes.lost)
    kept = np.flatnonzero(lost < 0)
    kept = kept[np.argsort(begun[kept], kind="stable")]
    rows = replace(plan[kept], start=begun[kept])
    stamped = stamp(medium, protocol, rows, draws[kept])
    found = (reported_broadcasts if broadcast else reported_exchanges)(medium, stamped)
    return Simulated(
        **found,
        poses=world.motion_capture(),
        tags=[Tag(t.id, t.body, t.lever_arm_m) for t in scenario.tags],
        faults=reported_faults(scenario, plan, outcomes),
        cirs=responses(scenario, world, protocol, found["exchanges"], stamped) if scenario.ranging.get_cir else [],
        meta=provenance(scenario) | ({"timestamp_bits": COUNTER_BITS} if broadcast else {}),
        temperature=readings(scenario),
        imu=sensor_readings(scenario, world.trajectories, "imu"),
        height=sensor_readings(scenario, world.trajectories, "height"),
    )


def _slots(medium: Medium, world: World, protocol: RangingProtocol, plan: Schedule, draws: Draws) -> Slots:
    """Return the plan with the nominal delays of its messages, and whether each is strong enough.

    Power noise makes the limit soft. In a common list an initiator waits longer for an exchange that it cannot hear.
    """
    scenario, ranging, radio = medium.scenario, medium.scenario.ranging, medium.scenario.radio
    messages, ends, pause = protocol.messages, (plan.initiator, plan.target), plan.start * 0
    at_once = np.rint(draws.reply_s * SUBTICKS_PER_SECOND).astype(np.int64)
    delays = {"at once": at_once, "scheduled": at_once * 0 + ranging.response_delay_uus * UUS_TICKS * SUBTICKS}
    delay = np.array([delays[message.timing] for message in messages])
    if ranging.plan == "common-list":
        before, mine = plan.target[:-1], plan.initiator[1:]
        others = np.flatnonzero(before != mine)
        power = world.link(before[others], mine[others], plan.start[others + 1]).power_dbm
        timeout = round((ranging.list_timeout_ms * 1e-3) * SUBTICKS_PER_SECOND)
        pause[others[power < radio.sensitivity_dbm] + 1] = timeout
    # All messages of an exchange have the power of its first, unless powers change within it.
    changing, powers = bool(world.levels) or any(tag.tx_power_db for tag in scenario.tags), []
    time = plan.start + (round(before_marker_s(radio.preamble_symbols) * SUBTICKS_PER_SECOND) if world.levels else 0)
    for k, message in enumerate(messages):
        if k and world.levels:
            time = time + delay[k]
        if not k or changing:
            power = world.link(*(ends if message.sender == "initiator" else ends[::-1]), time).power_dbm
        powers.append(power)
    noise = stream(scenario.run.seed, "fading").normal(size=(len(messages), len(time)))
    return Slots(plan, pause, medium.heard(np.array(powers), noise), delay)


def _executed(
    medium: Medium,
    world: World,
    protocol: RangingProtocol,
    slots: Slots,
    progress: Callable[[float], None] | None,
    *,
    contention: bool,
) -> Outcomes:
    """Return the outcomes of a plan by the event loop; without contention only messages that are too weak are lost.

    Broadcasts need no event loop, because their slots depend on nothing that is received.
    """
    scenario = medium.scenario
    broadcast, radio = scenario.ranging.plan == "broadcast", scenario.radio
    if contention and not broadcast:
        sampled = SampledWorld(world)
        air = Air(protocol, slots, lambda tag, time: sampled.from_sender(tag, max(time, 0)).power_dbm, radio)
        return air.execute(progress)
    lost = np.where(slots.heard.all(axis=0), -1, np.argmin(slots.heard, axis=0)).tolist()
    marker = round(before_marker_s(radio.preamble_symbols) * SUBTICKS_PER_SECOND)
    alone = Outcomes((slots.plan.start + marker).tolist(), lost, [WEAK if k >= 0 else "" for k in lost])
    return with_collisions_of_broadcasts(medium, slots.plan, alone) if contention else alone


def through_wire(simulated: Simulated) -> tuple[Simulated, list[FrameRow]]:
    """Return a flight whose exchanges were decoded from the boards' bytes, and those bytes.

    Raises `ScenarioError` for a protocol that the boards do not know.

    >>> import uwbsim
    >>> mast, drone = ({"model": "static", "position_m": [x, 0.0, 2.0]} for x in (0.0, 5.0))
    >>> flight = uwbsim.simulate(
    ...     {
    ...         "run": {"duration_s": 2.0},
    ...         "ranging": {"rate_hz": 50.0},
    ...         "bodies": [{"name": "mast", "motion": mast}, {"name": "drone", "motion": drone}],
    ...         "tags": [{"id": 1, "body": "mast"}, {"id": 2, "body": "drone"}],
    ...     }
    ... )
    >>> decoded, frames = uwbsim.through_wire(flight)
    >>> len(frames), bool((decoded.exchanges.rx2 == flight.exchanges.rx2).all())
    (100, True)
    >>> decoded.save("wire.uwb", frames=frames)
    """
    e = simulated.exchanges
    if simulated.receptions:
        raise ScenarioError(NO_BROADCASTS)
    strange = sorted(set(np.unique(e.protocol).tolist()) - set(ON_BOARDS))
    if strange:
        raise ScenarioError(
            f"ranging.protocol: found {strange[0]!r}, but the boards report only {', '.join(ON_BOARDS)}"
        )
    last = np.where(e.rx3 != 0, e.rx3, e.rx2)
    time_ns = e.time_ns + np.rint(elapsed(last, e.tx1) * (TICK_S * NS_PER_S)).astype(np.int64)
    names = [name for name in RangeReport.FIELDS if name != "neighbour"]
    columns = [e.target.tolist(), *(getattr(e, name).tolist() for name in names)]
    reports = (encode(RangeReport(*row)) for row in zip(*columns, strict=True))
    frames = [
        FrameRow(t, f"board {i}", "in", data)
        for t, i, data in zip(time_ns.tolist(), e.initiator.tolist(), reports, strict=True)
    ]
    decoder, by_board = Decoder(REPORTS), sorted(zip(e.initiator.tolist(), frames, strict=True), key=lambda row: row[0])
    heard = ((frame.time_ns, board, event) for board, frame in by_board for event in decoder.feed(frame.data))
    exchanges = exchanges_of(heard).in_time_order()
    ports = {str(board): f"board {board}" for board in np.unique(e.initiator).tolist()}
    return replace(simulated, exchanges=exchanges, meta={**simulated.meta, "ports": ports}), frames


@dataclass(frozen=True, slots=True, kw_only=True)
class PairPreview:
    """The preview of a pair: rate, distances and first-path powers over the run, and its bias by skew in SS-TWR."""

    initiator: int
    target: int
    exchanges: int
    rate_hz: float
    distance_m: tuple[float, float]
    power_dbm: tuple[float, float]
    audible: float
    ss_bias_m: float


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Preview:
    """The preview of a run of `scenario`; `air_share` is the share of time in which a frame is on the air."""

    scenario: Scenario

    pairs: tuple[PairPreview, ...]
    exchanges: int
    rate_hz: float
    fastest_hz: float
    air_share: float
    duration_s: float

    def __repr__(self) -> str:
        """Return the preview as lines; warnings begin with "warning:"."""
        scenario, ranging = self.scenario, self.scenario.ranging
        plan = ranging.plan if isinstance(ranging.plan, str) else ranging.plan.file
        lines = [
            f"{scenario.run.name}: {PROTOCOLS[ranging.protocol].title}, plan {plan}, {self.duration_s:g} s",
            f"{self.exchanges} {'broadcasts' if plan == 'broadcast' else 'exchanges'} planned among "
            f"{len(self.pairs)} pairs, {self.rate_hz:.3g} a second "
            f"(one after the other at most {self.fastest_hz:.0f}); "
            f"frames on the air {100 * self.air_share:.1f} % of the time",
            f"{'pair':>10s}{'exchanges':>11s}{'Hz':>7s}{'metres':>17s}{'dBm':>18s}  SS-TWR's bias (cm)",
        ]
        lines += [
            f"{pair.initiator:3d} -> {pair.target:3d}{pair.exchanges:11d}{pair.rate_hz:7.3g}"
            f"{pair.distance_m[0]:8.2f} to {pair.distance_m[1]:5.2f}{pair.power_dbm[0]:8.1f} to "
            f"{pair.power_dbm[1]:6.1f}{100 * pair.ss_bias_m:+20.1f}"
            for pair in self.pairs
        ]
        lines += [
            f"warning: {pair.initiator} and {pair.target} hear each other {100 * pair.audible:.0f} % of the time "
            f"(sensitivity {scenario.radio.sensitivity_dbm:g} dBm)"
            for pair in self.pairs
            if pair.audible < 0.9
        ]
        # A range has the sum of two tags' delays: these sums determine the delays if their matrix has full rank.
        ends = np.array([(pair.initiator, pair.target) for pair in self.pairs]).reshape(-1, 2)
        tags = np.unique(ends)
        if len(tags) and np.linalg.matrix_rank((ends[:, :, None] == tags).sum(axis=1)) < len(tags):
            lines.append(
                "warning: the pairs split the tags into two groups that range only with each other; their antenna "
                "delays will not be determined"
            )
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return what `uwbsim validate --json` prints: the figures, without the scenario."""
        figures = ("exchanges", "rate_hz", "fastest_hz", "air_share", "duration_s")
        return {"pairs": [asdict(pair) for pair in self.pairs]} | {name: getattr(self, name) for name in figures}


def preview(scenario: Scenario | Source) -> Preview:
    """Predict exchanges, distances and powers of a scenario without running it; raises `ScenarioError`.

    `scenario` is whatever `load` takes, or a `Scenario`.

    >>> import uwbsim
    >>> mast, drone = ({"model": "static", "position_m": [x, 0.0, 2.0]} for x in (0.0, 5.0))
    >>> found = uwbsim.preview(
    ...     {
    ...         "run": {"name": "two", "duration_s": 2.0},
    ...         "ranging": {"rate_hz": 50.0},
    ...         "bodies": [{"name": "mast", "motion": mast}, {"name": "drone", "motion": drone}],
    ...         "tags": [{"id": 1, "body": "mast"}, {"id": 2, "body": "drone"}],
    ...     }
    ... )
    >>> found.exchanges, found.pairs[0].distance_m
    (100, (5.0, 5.0))
    >>> print(str(found).splitlines()[0])
    two: DS-TWR, third message from the target, plan round-robin, 2 s
    """
    scenario = as_scenario(scenario)
    plan, world = schedule(scenario), World(scenario)
    duration, radio, samples = scenario.run.duration_s, scenario.radio, 200
    time = (np.linspace(0, duration, samples) * SUBTICKS_PER_SECOND).astype(np.int64)
    ranging, pairs, senders = scenario.ranging, [], len(scenario.senders())
    turns = len(plan.start) // (len(scenario.tags) - 1 if ranging.plan == "broadcast" else 1)
    for i, j in sorted(set(zip(plan.initiator.tolist(), plan.target.tolist(), strict=True))):
        count = int(np.count_nonzero((plan.initiator == i) & (plan.target == j)))
        link = world.link(np.full(samples, i), np.full(samples, j), time)
        one, two = scenario.tags[i], scenario.tags[j]
        pairs.append(
            PairPreview(
                initiator=one.id,
                target=two.id,
                exchanges=count,
                rate_hz=count / duration,
                distance_m=(float(link.distance_m.min()), float(link.distance_m.max())),
                power_dbm=(float(link.power_dbm.min()), float(link.power_dbm.max())),
                audible=float(np.mean(link.power_dbm >= radio.sensitivity_dbm)),
                ss_bias_m=SPEED_OF_LIGHT / 2 * (one.skew_ppm - two.skew_ppm) * 1e-6 * ranging.scheduled_s,
            )
        )
    return Preview(
        scenario=scenario,
        pairs=tuple(pairs),
        exchanges=turns,
        rate_hz=turns / duration,
        fastest_hz=ranging.fastest_hz(radio.preamble_symbols, senders),
        air_share=ranging.rate_hz * ranging.air_s(radio.preamble_symbols, senders),
        duration_s=duration,
    )
