"""Conditions of exchanges, sampled from a scenario as columns, and the Monte Carlo simulation of ranges under them.

`exchange` is the same model as the event loop with its integer stamps (`uwbsim.simulation.timestamps`), in floats
relative to the start of an exchange, for exchanges that do not interfere. With noise it is the Monte Carlo, in pieces
that fit into the cache; without it is the mean that `predict` needs. Noise comes from named streams, one a frame, so
that all protocols have the same noise.
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
from uwbsim.world.clocks import RATE_SPAN_S, SUBTICKS_PER_SECOND, WALK_STEP_S, Clocks
from uwbsim.world.radio import carrier_bias_ppm
from uwbsim.world.reception import AntennaDelays, stamp_errors_s
from uwbsim.world.world import World

SIDES: Final = ("initiator", "target")

Both = Floats
"""Columns (2, n): of the initiator, then of the target."""

STATES: Final = 16_384
"""States of the world that are sampled; it is also the length of the pieces that fit into a core's cache."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Conditions:
    """The state of the world in exchanges, columns (n,) or `Both` (2, n); times of flight and delays in seconds.

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
    rate: Both
    drift: Both
    white: Both
    late: Floats
    rx_std: Floats
    tx_std: Floats
    tx_delay: Both
    rx_delay: Both
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

    @property
    def distance_m(self) -> Floats:
        """Return the distances of the states."""
        return self.flight * SPEED_OF_LIGHT

    def __getitem__(self, rows: slice | Ints) -> Conditions:
        """Return the chosen states."""
        columns: dict[str, Any] = {name: getattr(self, name)[..., rows] for name in STATE_SHAPES}
        return replace(self, **columns)

    def with_columns(self, **values: float | Floats) -> Conditions:
        """Return the same states with some columns changed; those of both boards may be given as (2, 1)."""
        columns: dict[str, Any] = {
            name: np.broadcast_to(np.asarray(v, dtype=float), getattr(self, name).shape) for name, v in values.items()
        }
        return replace(self, **columns)

    @classmethod
    def single(cls, **values: Any) -> Conditions:
        """Return one state: zeros, but for what is given; of both boards, a pair is given."""
        # A pair is transposed into a column.
        columns: dict[str, Any] = {
            name: np.zeros(shape) + np.transpose([values.pop(name, 0.0)]) for name, shape in STATE_SHAPES.items()
        }
        return cls(**columns, **values)


STATE_SHAPES: Final = {
    f.name: (2, 1) if f.type == "Both" else (1,) for f in fields(Conditions) if f.type in ("Both", "Floats")
}
"""The columns, with their shapes for a single state."""

Protocols = Sequence[str | RangingProtocol]


def chosen(protocols: Protocols | None, parameter: str = "protocols") -> list[RangingProtocol]:
    """Return rows of protocols, given as rows or by name, each once; None is all that there are.

    Raises `ParameterError` that lists what there is.
    """
    rows: dict[str, RangingProtocol] = {}
    for one in PROTOCOLS if protocols is None else protocols:
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
    scenario = scenario.changed("radio", outages=None)
    plan = schedule(scenario)
    if not len(plan.start):
        raise ScenarioError(
            f"run.duration_s: no exchange is planned in {scenario.run.duration_s:g} s; use a longer run"
        )
    rows = np.unique(np.linspace(0, len(plan.start) - 1, min(count, len(plan.start))).astype(np.int64))
    marker = round(before_marker_s(scenario.radio.preamble_symbols) * SUBTICKS_PER_SECOND)
    start, i, j = plan.start[rows] + marker, plan.initiator[rows], plan.target[rows]
    world, clocks, radio = World(scenario), Clocks.of(scenario), scenario.radio
    link = world.link(i, j, start)
    step_s = 1e-3  # over which the speed along the line between two tags is measured
    later = world.link(i, j, start + round(step_s * SUBTICKS_PER_SECOND))
    errors_s, back = [stamp_errors_s(radio, link)], link
    if any(tag.tx_power_db for tag in scenario.tags):
        back = world.link(j, i, start)
        errors_s.append(stamp_errors_s(radio, back))
    delays = AntennaDelays.of(scenario)
    white = np.array([(tag.white_ppm_sqrt_s * 1e-6) for tag in scenario.tags])
    share, mean_m = radio.independent_multipath
    return Conditions(
        flight=link.distance_m / SPEED_OF_LIGHT,
        excess=link.excess_m / SPEED_OF_LIGHT,
        flight_rate=(later.distance_m - link.distance_m) / step_s / SPEED_OF_LIGHT,
        rate=np.array([clocks.rate(end, start, WALK_STEP_S) for end in (i, j)]),
        drift=np.zeros((2, len(rows))),
        white=np.array([white[i], white[j]]),
        late=np.mean([bias for bias, _ in errors_s], axis=0),
        rx_std=np.sqrt(np.mean([std**2 for _, std in errors_s], axis=0)),
        tx_std=np.full(len(rows), (radio.tx_noise_ps * 1e-12)),
        tx_delay=np.array([delays.transmit_s(end, start) for end in (i, j)]),
        rx_delay=np.array([delays.receive_s(end, start) for end in (i, j)]),
        at_once=scenario.ranging.reply.draw_s(stream(scenario.run.seed, "reply latency"), len(rows)),
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
    return replace(conditions.with_columns(late=0.0, excess=0.0, tx_delay=0.0, rx_delay=0.0), multipath=0.0)


def range_errors_m(
    protocol: RangingProtocol,
    conditions: Conditions,
    seed: int,
    count: int,
    progress: Callable[[float], None] | None = None,
) -> Floats:
    """Return the errors of `count` ranges in metres, (count,); range k has the state k modulo their number.

    An error is the range by the protocol's formula less the mean distance at its first two messages, before any
    calibration. `progress` is called with the done fraction.
    """
    noise, errors, done = Noise(protocol, conditions, seed), np.empty(count), 0
    pieces = cycle([conditions[k : k + STATES] for k in range(0, len(conditions), STATES)])
    while done < count:
        found = exchange(protocol, next(pieces), noise)
        flight = protocol.flight_ticks(intervals_of(protocol, found.stamps, found.carrier_ppm))
        part = ((flight - found.truth) * METRES_PER_TICK)[: count - done]
        errors[done : done + len(part)] = part
        done += len(part)
        if progress:
            progress(done / count)
    return errors


@dataclass(frozen=True, slots=True, kw_only=True)
class Stamps:
    """Exchanges, one for each of n states: stamps by name, times of departure and of arrival, and the true flight.

    All are in ticks, (n,) each, the times by message. `carrier_ppm` are the readings of the carrier integrator.
    """

    stamps: dict[str, Floats]
    leave: list[Floats]
    arrive: list[Floats]
    truth: Floats
    carrier_ppm: Floats


def exchange(protocol: RangingProtocol, c: Conditions, noise: Noise | None = None) -> Stamps:
    """Return exchanges under n conditions, with noise, or at the mean of all noise but that of multipath.

    A clock reads 1 + rate times the true time, plus half of drift times its square, plus the phase of its noise.
    Antenna delays and power add to stamps.
    """
    way, tx, late = (c.flight + c.excess) / TICK_S, c.tx_delay / TICK_S, (c.rx_delay + c.late) / TICK_S
    faster, drift = 1 + c.rate, c.drift * (TICK_S / 2)
    carrier = c.carrier_sign * (c.rate[0] - c.rate[1]) * 1e6 + c.carrier_bias_ppm
    stamps: dict[str, Floats] = {}
    leave, arrive = [], []
    if noise:
        noise.begin(c)
        way = way + noise.detours(c) / TICK_S
    for k, message in enumerate(protocol.messages):
        sender = SIDES.index(message.sender)
        receiver = 1 - sender
        sent = _transmit_stamp(message, stamps, c, noise)
        left = (sent - tx[sender]) / faster[sender]
        left -= drift[sender] * left**2
        if noise and k == 1:
            carrier = carrier + noise.carrier_ppm(c, left)
        if noise and noise.white:
            left -= noise.phase(sender, left)
        came = left + way + c.flight_rate * left
        seen = faster[receiver] * came + late[receiver] + drift[receiver] * came**2
        if noise:
            seen = noise.received(c, k, receiver, seen, came)
        stamps[f"tx{k + 1}"], stamps[f"rx{k + 1}"] = sent, seen
        leave.append(left)
        arrive.append(came)
    truth = c.flight / TICK_S + c.flight_rate * (leave[0] + leave[1]) / 2
    return Stamps(stamps=stamps, leave=leave, arrive=arrive, truth=truth, carrier_ppm=carrier)


def _transmit_stamp(message: ProtocolMessage, stamps: dict[str, Floats], c: Conditions, noise: Noise | None) -> Floats:
    """Return the printed transmit stamp, in ticks since the start: near zero for the poll."""
    reply, scheduled = (c.scheduled if message.timing == "scheduled" else c.at_once), message.timing == "scheduled"
    due = stamps[message.after] + reply / TICK_S if message.after else np.zeros(len(c))
    if not c.quantize:
        return due
    # Transmissions begin on the grid of the counter, and the latency of the software ends at the antenna. Boards round
    # a scheduled transmission down to the grid, and send others at its next instant.
    if noise is None:
        half = DELAYED_TX_GRID / 2
        return due + (ANTENNA_DELAY_TICKS - half if scheduled else half) if message.after else due
    grid = noise.grid[SIDES.index(message.sender)]
    due = due + grid
    slot = due // DELAYED_TX_GRID
    if message.timing == "at once":
        slot = np.ceil((due - ANTENNA_DELAY_TICKS) / DELAYED_TX_GRID)
    return np.asarray(slot * DELAYED_TX_GRID + ANTENNA_DELAY_TICKS - grid)


class Noise:
    """The noise of exchanges, from named streams; `grid` are the phases of the counters at the start, by side."""

    def __init__(self, protocol: RangingProtocol, c: Conditions, seed: int) -> None:
        """Open the streams; those that the conditions do not need are not drawn from."""
        self._frames = [stream(seed, "frame noise", k) for k in range(len(protocol.messages))]
        self._multipath, self._carrier = stream(seed, "multipath"), stream(seed, "skew reading", 2)
        self._counters = [stream(seed, "counter phase", side) for side in SIDES]
        self._clocks = [stream(seed, "clock noise", side) for side in SIDES]
        self.white = bool(np.any(c.white))

    def begin(self, c: Conditions) -> None:
        """Begin exchanges: draw the phases of the counters; the phases of the clocks' noise are zero."""
        if c.quantize:
            self.grid = [own.random(len(c)) * DELAYED_TX_GRID for own in self._counters]
        self._std = np.sqrt(c.tx_std**2 + c.rx_std**2) / TICK_S
        self._walks: dict[int, tuple[Floats, Floats]] = {}
        # The standard deviation of a clock's phase after a tick, in ticks.
        self._wander = c.white * TICK_S**-0.5

    def detours(self, c: Conditions) -> Floats | float:
        """Return the detours of the exchanges in seconds."""
        if not c.multipath:
            return 0.0
        hit = self._multipath.random(len(c))
        # A uniform draw below a threshold, divided by it, is uniform: one draw gives both occurrence and length.
        units = np.where(hit < c.multipath, -np.log(np.maximum(hit / c.multipath, 1e-300)), 0.0)
        return units * c.detour_s

    def phase(self, side: int, time: Floats) -> Floats:
        """Return the phase of a clock by the white noise of its rate at times in ticks, none earlier than the last."""
        last, phase = self._walks.get(side, (time, np.zeros_like(time)))
        step = np.sqrt(np.maximum(time - last, 0)) * self._clocks[side].standard_normal(len(time))
        self._walks[side] = time, phase + self._wander[side] * step
        return self._walks[side][1]

    def carrier_ppm(self, c: Conditions, departure: Floats) -> Floats | float:
        """Return the noise of the carrier integrator, with that of the clocks over the preamble before a departure."""
        noise = self._carrier.standard_normal(len(c)) * c.carrier_std_ppm if c.carrier_std_ppm else 0.0
        if not self.white:
            return noise
        span = RATE_SPAN_S / TICK_S
        before = [self.phase(side, departure - span) for side in (0, 1)]
        mine, other = (self.phase(side, departure) - phase for side, phase in enumerate(before))
        return noise + c.carrier_sign * (mine - other) / span * 1e6

    def received(self, c: Conditions, k: int, side: int, seen: Floats, time: Floats) -> Floats:
        """Return receive stamps of message k at times in ticks with all noise, in ticks of the receiver's counter.

        Transmit noise is added here, too: its effect on later departures is below 1e-7 of it.
        """
        if self.white:
            seen += self.phase(side, time)
        seen += self._frames[k].standard_normal(len(c)) * self._std
        return np.rint(seen + self.grid[side]) - self.grid[side] if c.quantize else seen
