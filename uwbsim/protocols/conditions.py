"""Conditions of exchanges, sampled from a scenario as columns, and the Monte Carlo simulation of ranges under them.

The Monte Carlo is the same model as the event loop with its integer stamps (`uwbsim.simulation.timestamps`), in floats
relative to the start of an exchange, for exchanges that do not interfere. It runs in pieces that fit into the cache.
Noise comes from named streams, one a frame, so that all protocols have the same noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import cycle
from typing import Any, Final

import numpy as np

from uwblink.arrays import Floats, Ints
from uwblink.protocols.table import PROTOCOLS, Intervals, ProtocolMessage, RangingProtocol
from uwblink.ticks import ANTENNA_DELAY_TICKS, DELAYED_TX_GRID, METRES_PER_TICK, SPEED_OF_LIGHT, TICK_S, UUS_TICKS
from uwbsim.errors import ParameterError, ScenarioError
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.ranging import before_marker_s
from uwbsim.simulation.air import schedule
from uwbsim.simulation.timestamps import draw_reply_s
from uwbsim.world.clocks import RATE_SPAN_S, SUBTICKS_PER_SECOND, WALK_STEP_S, Clocks
from uwbsim.world.radio import carrier_bias_ppm
from uwbsim.world.reception import AntennaDelays, arrive
from uwbsim.world.world import World

SIDES: Final = ("initiator", "target")

STATES: Final = 16_384
"""States of the world that are sampled; it is also the length of the pieces that fit into a core's cache."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Conditions:
    """The state of the world in exchanges, columns of length n; times of flight and delays in seconds.

    `flight` is that of the straight line, `excess` the additional time of the first path: an error of the range.
    Clocks run at 1 + rate; `drift` is the change of the rate in 1/s, `white` its white noise, a fraction times the root
    of a second (of flicker and random walk there is only the rate that they have reached). `late` is what power adds to
    each reception and `rx_std` its noise, both on average over the two directions; `tx_std` that of transmissions.
    `at_once` and `scheduled` are the two kinds of reply, `carrier_bias_ppm` and `carrier_std_ppm` those of the carrier
    integrator, which reads `carrier_sign` times the rate of the initiator's clock less the target's. `multipath` is the
    probability of a detour of `detour_s` on average, which all messages of an exchange take. `quantize` says whether
    stamps are whole ticks and delayed transmissions on the chip's grid.
    """

    flight: Floats
    excess: Floats
    flight_rate: Floats
    rate_initiator: Floats
    rate_target: Floats
    drift_initiator: Floats
    drift_target: Floats
    white_initiator: Floats
    white_target: Floats
    late: Floats
    rx_std: Floats
    tx_std: Floats
    tx_delay_initiator: Floats
    rx_delay_initiator: Floats
    tx_delay_target: Floats
    rx_delay_target: Floats
    at_once: Floats
    scheduled: Floats
    power_dbm: Floats
    carrier_bias_ppm: Floats
    carrier_sign: float = 1.0
    carrier_std_ppm: float = 0.0
    multipath: float = 0.0
    detour_s: float = 0.0
    quantize: bool = False

    def __len__(self) -> int:
        """Return the number of states."""
        return len(self.flight)

    def by_side(self, name: str) -> dict[str, Floats]:
        """Return a property of which the two boards have one each, such as `rate`, by `SIDES`."""
        return {side: getattr(self, f"{name}_{side}") for side in SIDES}

    @property
    def distance_m(self) -> Floats:
        """Return the distances of the states."""
        return self.flight * SPEED_OF_LIGHT

    def __getitem__(self, rows: slice | Ints) -> Conditions:
        """Return the chosen states."""
        columns: dict[str, Any] = {name: getattr(self, name)[rows] for name in COLUMNS}
        return replace(self, **columns)

    def with_columns(self, **values: float | Floats) -> Conditions:
        """Return the same states with some columns changed."""
        columns: dict[str, Any] = {
            name: np.broadcast_to(np.asarray(v, dtype=float), (len(self),)) for name, v in values.items()
        }
        return replace(self, **columns)

    @classmethod
    def single(cls, **values: Any) -> Conditions:
        """Return one state: zeros, but for what is given."""
        columns: dict[str, Any] = {name: np.array([float(values.pop(name, 0.0))]) for name in COLUMNS}
        return cls(**columns, **values)


COLUMNS: Final = tuple(f.name for f in fields(Conditions) if f.type == "Floats")


Protocols = Sequence[str | RangingProtocol]


def chosen(protocols: Protocols | None, parameter: str = "protocols") -> list[RangingProtocol]:
    """Return rows of protocols, given as rows or by name, each once; None is all that there are.

    Raises `ParameterError` that lists what there is.
    """
    wanted = list(PROTOCOLS) if protocols is None else protocols
    rows: dict[str, RangingProtocol] = {}
    for one in wanted:
        if not isinstance(one, RangingProtocol) and one not in PROTOCOLS:
            raise ParameterError(f"found {one!r}, allowed: {', '.join(PROTOCOLS)}", parameter=parameter)
        row = one if isinstance(one, RangingProtocol) else PROTOCOLS[one]
        rows.setdefault(row.name, row)
    if not rows:
        raise ParameterError(f"found none, allowed: {', '.join(PROTOCOLS)}", parameter=parameter)
    return list(rows.values())


def interval_stamps(protocol: RangingProtocol) -> dict[str, tuple[str, str]]:
    """Return the two stamps that each interval of a protocol lies between, the later one first.

    dt41 is the initiator's round trip and dt32 the target's reply; dt53 is the third leg as its sender has it, dt64 as
    its receiver.
    """
    found = {"dt41": ("rx2", "tx1"), "dt32": ("tx2", "rx1")}
    if len(protocol.messages) == 3:
        ends = ("tx2", "rx2") if protocol.messages[2].sender == "target" else ("rx2", "tx2")
        found |= {"dt53": ("tx3", ends[0]), "dt64": ("rx3", ends[1])}
    return found


def intervals_of(protocol: RangingProtocol, stamps: dict[str, Floats], carrier_ppm: Floats) -> Intervals:
    """Return the intervals of exchanges with stamps in ticks, (n,) each; 1 for those that a protocol does not have."""
    spans = dict.fromkeys(("dt53", "dt64"), np.ones_like(stamps["tx1"]))
    for name, (later, earlier) in interval_stamps(protocol).items():
        spans[name] = stamps[later] - stamps[earlier]
    return Intervals(**spans, carrier_ppm=carrier_ppm)


def conditions_of(scenario: Scenario, count: int = STATES) -> Conditions:
    """Sample the exchanges of a scenario's plan, evenly over its duration; fewer than `count` if it plans fewer.

    Raises `ScenarioError` for tags whose stamps of delayed replies have another antenna delay than their other stamps.
    """
    for tag in scenario.tags:
        if tag.antenna_delay.reply != tag.antenna_delay.tx:
            raise ScenarioError(
                f"tag {tag.id}: antenna_delay: reply = {tag.antenna_delay.reply} and tx = {tag.antenna_delay.tx} are "
                "simulated by `uwbsim run` and served boards only, not in comparisons of protocols"
            )
    # Exchanges that an outage prevents have no range.
    scenario = scenario.model_copy(update={"radio": scenario.radio.model_copy(update={"outages": None})})
    plan = schedule(scenario)
    if not len(plan.start):
        raise ScenarioError(f"run.duration_s: no exchange is planned in {scenario.run.duration_s:g} s; fly longer")
    rows = np.unique(np.linspace(0, len(plan.start) - 1, min(count, len(plan.start))).astype(np.int64))
    marker = round(before_marker_s(scenario.radio.preamble_symbols) * SUBTICKS_PER_SECOND)
    start, i, j = plan.start[rows] + marker, plan.initiator[rows], plan.target[rows]
    world, clocks, radio = World.of(scenario), Clocks.of(scenario), scenario.radio
    link = world.link(i, j, start)
    step_s = 1e-3  # over which the speed along the line between two tags is measured
    later = world.link(i, j, start + round(step_s * SUBTICKS_PER_SECOND))
    arrivals, back = [arrive(radio, link)], link
    if any(tag.tx_power_db for tag in scenario.tags):
        back = world.link(j, i, start)
        arrivals.append(arrive(radio, back))
    delays = AntennaDelays.of(scenario)
    white = np.array([(tag.white_ppm_sqrt_s * 1e-6) for tag in scenario.tags])
    share, mean_m = radio.independent_multipath
    nothing = np.zeros(len(rows))
    return Conditions(
        flight=link.distance_m / SPEED_OF_LIGHT,
        excess=link.excess_m / SPEED_OF_LIGHT,
        flight_rate=(later.distance_m - link.distance_m) / step_s / SPEED_OF_LIGHT,
        rate_initiator=clocks.rate(i, start, WALK_STEP_S),
        rate_target=clocks.rate(j, start, WALK_STEP_S),
        drift_initiator=nothing,
        drift_target=nothing,
        white_initiator=white[i],
        white_target=white[j],
        late=np.mean([arrival.bias_s for arrival in arrivals], axis=0),
        rx_std=np.sqrt(np.mean([arrival.std_s**2 for arrival in arrivals], axis=0)),
        tx_std=np.full(len(rows), (radio.tx_noise_ps * 1e-12)),
        tx_delay_initiator=delays.transmit_s(i, start),
        rx_delay_initiator=delays.receive_s(i, start),
        tx_delay_target=delays.transmit_s(j, start),
        rx_delay_target=delays.receive_s(j, start),
        at_once=draw_reply_s(scenario, stream(scenario.run.seed, "reply latency"), len(rows)),
        scheduled=np.full(len(rows), scenario.ranging.response_delay_uus * UUS_TICKS * TICK_S),
        power_dbm=link.power_dbm,
        carrier_bias_ppm=carrier_bias_ppm(radio, back.power_dbm),
        carrier_sign=radio.carrier_sign,
        carrier_std_ppm=radio.skew_noise_ppm,
        multipath=share,
        detour_s=mean_m / SPEED_OF_LIGHT,
        quantize=radio.quantize,
    )


def calibrated(conditions: Conditions) -> Conditions:
    """Return the same world as a calibration leaves it: no antenna delays, no bias by power, no reflections."""
    delays = {f"{end}_delay_{side}": 0.0 for end in ("tx", "rx") for side in ("initiator", "target")}
    return replace(conditions.with_columns(late=0.0, excess=0.0, **delays), multipath=0.0)


def range_errors_m(
    protocol: RangingProtocol,
    conditions: Conditions,
    seed: int,
    count: int,
    progress: Callable[[float], None] | None = None,
) -> Floats:
    """Return the errors of `count` ranges in metres, (count,); range k meets the state k modulo their number.

    An error is the range by the protocol's formula less the mean distance at its first two messages, before any
    calibration. `progress` is called with the done fraction.
    """
    noise = _Noise(protocol, conditions, seed)
    length = min(len(conditions), STATES)
    pieces = cycle([_Ticks(conditions[k : k + length]) for k in range(0, len(conditions), length)])
    errors, done = np.empty(count), 0
    while done < count:
        part = _execute(protocol, next(pieces), noise)[: count - done]
        errors[done : done + len(part)] = part
        done += len(part)
        if progress:
            progress(done / count)
    return errors


class _Ticks:
    """Conditions with times in device ticks."""

    def __init__(self, c: Conditions) -> None:
        scale = 1 / TICK_S
        self.conditions, self.moving = c, bool(np.any(c.flight_rate))
        self.flight, self.way, self.detour = c.flight * scale, (c.flight + c.excess) * scale, c.detour_s * scale
        self.faster = {side: 1 + rate for side, rate in c.by_side("rate").items()}
        self.slower = {side: 1 / rate for side, rate in self.faster.items()}
        self.half_drift = {s: d * (TICK_S / 2) if np.any(d) else None for s, d in c.by_side("drift").items()}
        self.tx_delay = {side: delay * scale for side, delay in c.by_side("tx_delay").items()}
        self.rx_late = {side: c.late * scale + delay * scale for side, delay in c.by_side("rx_delay").items()}
        # Transmit and receive noise of a frame appear only as a sum in its receive stamp, so one draw with their common
        # standard deviation replaces two. (The effect on later departures, by motion, drift or clock noise, is below
        # 10^-7 of it.)
        self.noise_std = {
            sender: np.hypot(c.tx_std * self.slower[sender] * self.faster[receiver], c.rx_std) * scale
            for sender, receiver in (SIDES, SIDES[::-1])
        }
        self.reply = {"at once": c.at_once * scale, "scheduled": c.scheduled * scale}
        self.carrier_ppm = c.carrier_sign * (c.rate_initiator - c.rate_target) * 1e6 + c.carrier_bias_ppm
        # The standard deviation of a clock's phase after a tick, in ticks.
        self.white = {side: white * scale**0.5 for side, white in c.by_side("white").items()}


class _Wander:
    """The phase of a clock with white noise of its rate, in ticks, at instants in order of time."""

    def __init__(self, white: Floats, steps: list[Floats]) -> None:
        """The phase is zero at the first instant; `steps` are standard normal, one per instant."""
        self._white, self._steps = white, iter(steps)
        self._time: Floats | None = None
        self._phase = np.zeros_like(white)

    def at(self, time: Floats) -> Floats:
        """Return the phase at times (n,) in ticks, none earlier than the last."""
        if self._time is not None:
            gap = np.maximum(time - self._time, 0)
            self._phase = self._phase + self._white * np.sqrt(gap) * next(self._steps)
        self._time = time
        return self._phase


class _Noise:
    """Named streams of random numbers, drawn in the order of exchanges; only those that the conditions need."""

    def __init__(self, protocol: RangingProtocol, c: Conditions, seed: int) -> None:
        numbers = range(len(protocol.messages)) if np.any(c.tx_std) or np.any(c.rx_std) else ()
        white = np.any(c.white_initiator) or np.any(c.white_target)
        self.frames = [stream(seed, "frame noise", k) for k in numbers]
        self.carrier = stream(seed, "skew reading", 2) if c.carrier_std_ppm else None
        self.counters = {side: stream(seed, "counter phase", side) for side in SIDES} if c.quantize else {}
        self.clocks = {side: stream(seed, "clock noise", side) for side in SIDES} if white else {}
        self._hit, self._share = stream(seed, "multipath"), c.multipath

    def detours(self, count: int) -> Floats | float:
        """Return the detours of the next exchanges, (count,), in units of their mean."""
        if not self._share:
            return 0.0
        hit = self._hit.random(count)
        # A uniform draw below a threshold, divided by it, is uniform: one draw gives both occurrence and length.
        return np.where(hit < self._share, -np.log(np.maximum(hit / self._share, 1e-300)), 0.0)


def _execute(protocol: RangingProtocol, c: _Ticks, noise: _Noise) -> Floats:
    """Return range errors in metres of one piece."""
    stamps: dict[str, Floats] = {}
    flights: list[Floats] = []
    count, instants = len(c.flight), len(protocol.messages) + 2
    # The phases of the counters on the grid of transmissions at the start.
    phases = {side: own.random(count) * DELAYED_TX_GRID for side, own in noise.counters.items()}
    wander = {
        side: _Wander(c.white[side], [own.standard_normal(count) for _ in range(instants)])
        for side, own in noise.clocks.items()
    }
    carrier = c.carrier_ppm
    path = c.way + noise.detours(count) * c.detour
    for k, message in enumerate(protocol.messages):
        sender = message.sender
        receiver = SIDES[1 - SIDES.index(sender)]
        printed = _transmission(message, stamps, c, phases)
        departure = (printed - c.tx_delay[sender]) * c.slower[sender]
        half = c.half_drift[sender]
        if half is not None:
            departure -= half * departure**2
        if wander:
            if k == 1:
                carrier = carrier + c.conditions.carrier_sign * _carrier_ppm(wander, departure)
            departure = departure - wander[sender].at(departure)
        moved = c.conditions.flight_rate * departure if c.moving else 0.0
        arrival = departure + (path + moved)
        seen = arrival * c.faster[receiver]
        half = c.half_drift[receiver]
        if half is not None:
            seen += half * arrival**2
        if wander:
            seen += wander[receiver].at(arrival)
        seen += c.rx_late[receiver]
        if noise.frames:
            seen += noise.frames[k].standard_normal(count) * c.noise_std[sender]
        if phases:
            seen += phases[receiver]
            np.rint(seen, out=seen)
            seen -= phases[receiver]
        stamps[f"tx{k + 1}"], stamps[f"rx{k + 1}"] = printed, seen
        flights.append(c.flight + moved)
    if noise.carrier is not None:
        carrier = carrier + noise.carrier.standard_normal(count) * c.conditions.carrier_std_ppm
    truth = (flights[0] + flights[1]) / 2
    return np.asarray((protocol.flight_ticks(intervals_of(protocol, stamps, carrier)) - truth) * METRES_PER_TICK)


def _transmission(message: ProtocolMessage, stamps: dict[str, Floats], c: _Ticks, phases: dict[str, Floats]) -> Floats:
    """Return the printed transmit stamp, in ticks since the start: near zero for the poll."""
    due = stamps[message.after] + c.reply[message.timing] if message.after else np.zeros_like(c.flight)
    if not phases:
        return due
    # Transmissions begin on the grid of the counter, and the latency of the software ends at the antenna. Boards round
    # a scheduled transmission down to the grid, and send others at its next instant.
    due = due + phases[message.sender]
    slot = due // DELAYED_TX_GRID
    if message.timing == "at once":
        slot = np.ceil((due - ANTENNA_DELAY_TICKS) / DELAYED_TX_GRID)
    return np.asarray(slot * DELAYED_TX_GRID + ANTENNA_DELAY_TICKS - phases[message.sender])


def _carrier_ppm(wander: dict[str, _Wander], departure: Floats) -> Floats:
    """Return the effect of the clocks' noise over a preamble on the carrier integrator's reading of the frame."""
    span = RATE_SPAN_S / TICK_S
    begun = {side: path.at(departure - span) for side, path in wander.items()}
    gained = {side: path.at(departure) - begun[side] for side, path in wander.items()}
    return np.asarray((gained["initiator"] - gained["target"]) / span * 1e6)
