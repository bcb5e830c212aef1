"""Monte Carlo of exchanges as NumPy columns, in pieces that fit into the cache: any protocol, from its row.

The same model as the event loop with its integer stamps (`uwbsim.simulation.timestamps`), in floats about the start of
an exchange, for exchanges that disturb no other. Noise comes from named streams, one a frame, so all protocols see the
same noise.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle
from typing import Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.protocols.table import ProtocolMessage, RangingProtocol
from uwblink.ticks import ANTENNA_DELAY_TICKS, DELAYED_TX_GRID, METRES_PER_TICK, TICK_S
from uwbsim.protocols.conditions import STATES, Conditions, intervals_of
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
    """Named streams of random numbers, drawn from in the order of exchanges; none where conditions need none."""

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
        # What is left of a uniform draw below a threshold is uniform again: one draw decides both.
        return np.where(hit < self._share, -np.log(np.maximum(hit / self._share, 1e-300)), 0.0)


def _execute(protocol: RangingProtocol, c: _Ticks, noise: _Noise) -> Floats:
    """Return range errors in metres of one piece."""
    stamps: dict[str, Floats] = {}
    flights: list[Floats] = []
    count, instants = len(c.flight), len(protocol.messages) + 2
    # A counter shows its phase at the start.
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
                carrier = carrier + c.carrier_sign * _carrier_ppm(wander, departure)
            departure = departure - wander[sender].at(departure)
        moved = c.flight_rate * departure if c.moving else 0.0
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
        carrier = carrier + noise.carrier.standard_normal(count) * c.carrier_std_ppm
    truth = (flights[0] + flights[1]) / 2
    return np.asarray((protocol.flight_ticks(intervals_of(protocol, stamps, carrier)) - truth) * METRES_PER_TICK)


def _transmission(message: ProtocolMessage, stamps: dict[str, Floats], c: _Ticks, phases: dict[str, Floats]) -> Floats:
    """Return the printed transmit stamp, in ticks since the start: the poll's is near nought."""
    due = stamps[message.after] + c.reply[message.timing] if message.after else np.zeros_like(c.flight)
    if not phases:
        return due
    # Transmissions begin on the grid of the counter; the software's latency runs to the antenna.
    # Boards round a scheduled transmission down to the grid of their counter, and send others at its next instant.
    due = due + phases[message.sender]
    slot = due // DELAYED_TX_GRID
    if message.timing == "at once":
        slot = np.ceil((due - ANTENNA_DELAY_TICKS) / DELAYED_TX_GRID)
    return np.asarray(slot * DELAYED_TX_GRID + ANTENNA_DELAY_TICKS - phases[message.sender])


def _carrier_ppm(wander: dict[str, _Wander], departure: Floats) -> Floats:
    """Return what the clocks' noise adds to the carrier integrator's reading of a frame, over its preamble."""
    span = RATE_SPAN_S / TICK_S
    begun = {side: path.at(departure - span) for side, path in wander.items()}
    gained = {side: path.at(departure) - begun[side] for side, path in wander.items()}
    return np.asarray((gained["initiator"] - gained["target"]) / span * 1e6)
