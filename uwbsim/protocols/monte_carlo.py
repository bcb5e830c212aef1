"""Monte Carlo of exchanges as NumPy columns, in pieces that fit into the cache: any protocol, from its row.

The same model as the event loop with its integer stamps (`uwbsim.simulation.timestamps`), in floats about the start of
an exchange, for exchanges that disturb no other. Noise comes from named streams, one a frame, so all protocols see the
same noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.protocols.rows import Intervals, ProtocolMessage, RangingProtocol
from uwblink.ticks import ANTENNA_DELAY_TICKS, DELAYED_TX_GRID, METRES_PER_TICK, TICK_S
from uwbsim.protocols.conditions import STATES, Conditions, interval_stamps
from uwbsim.random_streams import stream
from uwbsim.world.clocks import RATE_SPAN_S

SIDES: Final = ("initiator", "target")


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
    errors = np.empty(count)
    begin = 0
    for part in error_pieces(protocol, conditions, seed, count):
        errors[begin : begin + len(part)] = part
        begin += len(part)
        if progress:
            progress(begin / count)
    return errors


def error_pieces(protocol: RangingProtocol, conditions: Conditions, seed: int, count: int) -> Iterator[Floats]:
    """Yield the same errors in pieces as long as there are states, at most `STATES`, so that memory stays flat."""
    source = _Noise(protocol, conditions, seed)
    length = min(len(conditions), STATES)
    pieces = [_Ticks(conditions[k : k + length]) for k in range(0, len(conditions), length)]
    done, turn = 0, 0
    while done < count:
        ticks = pieces[turn % len(pieces)]
        error = _execute(protocol, ticks, source.draw(len(ticks.flight)))
        yield error[: count - done]
        done += len(error)
        turn += 1


class _Ticks:
    """Conditions with times in device ticks."""

    def __init__(self, c: Conditions) -> None:
        scale = 1 / TICK_S
        self.flight, self.flight_rate = c.flight * scale, c.flight_rate
        self.way = (c.flight + c.excess) * scale
        self.faster = {"initiator": 1 + c.rate_initiator, "target": 1 + c.rate_target}
        self.slower = {side: 1 / rate for side, rate in self.faster.items()}
        drifts = {"initiator": c.drift_initiator, "target": c.drift_target}
        self.half_drift = {s: d * (TICK_S / 2) if np.any(d) else None for s, d in drifts.items()}
        self.tx_delay = {"initiator": c.tx_delay_initiator * scale, "target": c.tx_delay_target * scale}
        rx_delay = {"initiator": c.rx_delay_initiator * scale, "target": c.rx_delay_target * scale}
        self.rx_late = {side: c.late * scale + delay for side, delay in rx_delay.items()}
        # A stamp shows what a frame left late by and what it was seen late by together, and nothing else shows either:
        # one draw a frame has the distribution of two. (What that does to a later departure, by motion, drift or a
        # clock's noise, is below a part in 10^7 of it.)
        self.noise_std = {
            sender: np.hypot(c.tx_std * self.slower[sender] * self.faster[receiver], c.rx_std) * scale
            for sender, receiver in (SIDES, SIDES[::-1])
        }
        self.reply = {"at once": c.at_once * scale, "scheduled": c.scheduled * scale}
        self.carrier_ppm = c.carrier_sign * (c.rate_initiator - c.rate_target) * 1e6 + c.carrier_bias_ppm
        self.carrier_sign = c.carrier_sign
        self.carrier_std_ppm, self.detour = c.carrier_std_ppm, c.detour_s * scale
        # What a clock's phase gathers in a tick, in ticks.
        self.white = {"initiator": c.white_initiator * scale**0.5, "target": c.white_target * scale**0.5}
        self.moving = bool(np.any(c.flight_rate))


@dataclass(frozen=True, slots=True)
class _Draws:
    """Standard draws for one piece; None where the conditions need none."""

    frames: list[Floats] | None
    carrier: Floats | None
    phase: dict[str, Floats] | None
    detour: Floats | None
    clocks: dict[str, list[Floats]] | None


class _Wander:
    """The phase of a clock whose rate has white noise, in ticks, at one instant after another."""

    def __init__(self, white: Floats, steps: list[Floats]) -> None:
        """Begin at zero when first asked; `steps` are standard normal, one an instant."""
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
    """The named streams that an engine draws from, one after the other in the order of exchanges."""

    def __init__(self, protocol: RangingProtocol, c: Conditions, seed: int) -> None:
        numbers = range(len(protocol.messages))
        noisy = np.any(c.tx_std) or np.any(c.rx_std)
        self._frames = [stream(seed, "frame noise", k) for k in numbers] if noisy else None
        self._carrier = stream(seed, "skew reading", 2) if c.carrier_std_ppm else None
        self._phase = {side: stream(seed, "counter phase", side) for side in SIDES} if c.quantize else None
        self._hit = stream(seed, "multipath") if c.multipath else None
        white = np.any(c.white_initiator) or np.any(c.white_target)
        self._clocks = {side: stream(seed, "clock noise", side) for side in SIDES} if white else None
        self._instants = len(numbers) + 2
        self._share = c.multipath

    def draw(self, count: int) -> _Draws:
        """Draw for the next `count` exchanges."""
        detour = None
        if self._hit is not None:
            hit = self._hit.random(count)
            # What is left of a uniform draw below a threshold is uniform again: one draw decides both.
            detour = np.where(hit < self._share, -np.log(np.maximum(hit / self._share, 1e-300)), 0.0)
        return _Draws(
            [g.standard_normal(count) for g in self._frames] if self._frames else None,
            self._carrier.standard_normal(count) if self._carrier else None,
            {side: g.random(count) * DELAYED_TX_GRID for side, g in self._phase.items()} if self._phase else None,
            detour,
            {side: [g.standard_normal(count) for _ in range(self._instants)] for side, g in self._clocks.items()}
            if self._clocks
            else None,
        )


def _execute(protocol: RangingProtocol, c: _Ticks, draws: _Draws) -> Floats:
    """Return range errors in metres of one piece."""
    stamps: dict[str, Floats] = {}
    flights: list[Floats] = []
    wander = {side: _Wander(c.white[side], steps) for side, steps in draws.clocks.items()} if draws.clocks else None
    carrier_noise: Floats | float = 0.0
    path = c.way if draws.detour is None else c.way + draws.detour * c.detour
    for k, message in enumerate(protocol.messages):
        sender = message.sender
        receiver = SIDES[1 - SIDES.index(sender)]
        printed = _transmission(message, stamps, c, draws)
        departure = (printed - c.tx_delay[sender]) * c.slower[sender]
        half = c.half_drift[sender]
        if half is not None:
            departure -= half * departure**2
        if wander is not None:
            if k == 1:
                carrier_noise = _carrier_ppm(wander, departure)
            departure = departure - wander[sender].at(departure)
        flight = c.flight + c.flight_rate * departure if c.moving else c.flight
        arrival = departure + (path if not c.moving else path + c.flight_rate * departure)
        seen = arrival * c.faster[receiver]
        half = c.half_drift[receiver]
        if half is not None:
            seen += half * arrival**2
        if wander is not None:
            seen += wander[receiver].at(arrival)
        seen += c.rx_late[receiver]
        if draws.frames is not None:
            seen += draws.frames[k] * c.noise_std[sender]
        if draws.phase is not None:
            phase = draws.phase[receiver]
            seen += phase
            np.rint(seen, out=seen)
            seen -= phase
        stamps[f"tx{k + 1}"], stamps[f"rx{k + 1}"] = printed, seen
        flights.append(flight)
    spans = _intervals(protocol, stamps, c, draws, carrier_noise)
    truth = (flights[0] + flights[1]) / 2
    return np.asarray((protocol.flight_ticks(spans) - truth) * METRES_PER_TICK)


def _transmission(message: ProtocolMessage, stamps: dict[str, Floats], c: _Ticks, draws: _Draws) -> Floats:
    """Return the printed transmit stamp, in ticks since the start: the poll's is near nought."""
    due = stamps[message.after] + c.reply[message.timing] if message.after else np.zeros_like(c.flight)
    if draws.phase is None:
        return due
    # The counter shows `phase` at the start; delayed transmissions begin on its grid.
    phase = draws.phase[message.sender]
    due = due + phase
    if message.timing == "scheduled":
        return np.asarray(np.floor(due / DELAYED_TX_GRID) * DELAYED_TX_GRID + ANTENNA_DELAY_TICKS - phase)
    latency = due - ANTENNA_DELAY_TICKS
    return np.asarray(np.ceil(latency / DELAYED_TX_GRID) * DELAYED_TX_GRID + ANTENNA_DELAY_TICKS - phase)


def _carrier_ppm(wander: dict[str, _Wander], departure: Floats) -> Floats:
    """Return what the clocks' noise adds to the carrier integrator's reading of a frame, over its preamble."""
    span = RATE_SPAN_S / TICK_S
    begun = {side: path.at(departure - span) for side, path in wander.items()}
    gained = {side: path.at(departure) - begun[side] for side, path in wander.items()}
    return np.asarray((gained["initiator"] - gained["target"]) / span * 1e6)


def _intervals(
    protocol: RangingProtocol, stamps: dict[str, Floats], c: _Ticks, draws: _Draws, carrier_noise: Floats | float
) -> Intervals:
    carrier = c.carrier_ppm + c.carrier_sign * carrier_noise
    if draws.carrier is not None:
        carrier = carrier + draws.carrier * c.carrier_std_ppm
    spans = {name: stamps[later] - stamps[earlier] for name, (later, earlier) in interval_stamps(protocol).items()}
    return Intervals(**({"dt53": c.flight, "dt64": c.flight} | spans), carrier_ppm=carrier)
