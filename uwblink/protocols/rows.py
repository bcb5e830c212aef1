"""What a ranging protocol is: its messages and its formulas, in one row.

A formula maps `Intervals` of n exchanges to ticks (n,), or to a pair of dimensionless weights (n,): the time of flight
from intervals, and what antenna delays do to it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from uwblink.arrays import Floats

Role = Literal["initiator", "target"]


@dataclass(frozen=True, slots=True)
class Intervals:
    """Durations of an exchange in ticks of the clock that measured them, float64, shape (n,).

    dt41 is the initiator's round trip, dt32 the target's reply; dt53 and dt64 are the third leg as its sender and its
    receiver count it, without meaning where there is no third message. `carrier_ppm` is how much faster than the
    target's the initiator's clock runs by its carrier integrator, on the response; NaN if unknown.
    """

    dt41: Floats
    dt32: Floats
    dt53: Floats
    dt64: Floats
    carrier_ppm: Floats


@dataclass(frozen=True, slots=True)
class ProtocolMessage:
    """One message of a protocol: who sends it, after which stamp, and on whose timing.

    `timing` is `"at once"` (as soon as the software gets there) or `"scheduled"` (a delayed
    transmission on the chip's 512-tick grid, a set number of UWB microseconds after the stamp).

    >>> import uwblink
    >>> uwblink.PROTOCOLS["ds"].messages[1]
    ProtocolMessage(sender='target', after='rx1', timing='at once')
    """

    sender: Role
    after: str
    timing: Literal["at once", "scheduled"]


@dataclass(frozen=True, slots=True)
class RangingProtocol:
    """A ranging protocol: its messages and its formulas, from which everything else follows.

    `flight_ticks` maps `Intervals` (n,) to the time of flight in ticks of the initiator's clock, (n,);
    `delay_weights` to the pair (d t_f/d d_i, d t_f/d d_j), (n,) each, by which a tag's aggregate antenna delay
    d = d_t - d_r enters the calibrated time of flight.

    >>> import uwblink
    >>> [(name, len(row.messages), row.third_sender) for name, row in uwblink.PROTOCOLS.items()][:3]
    [('ss', 2, None), ('ss-cfo', 2, None), ('ds', 3, 'target')]
    """

    name: str
    title: str
    messages: tuple[ProtocolMessage, ...]
    flight_ticks: Callable[[Intervals], Floats]
    delay_weights: Callable[[Intervals], tuple[Floats, Floats]]

    @property
    def third_sender(self) -> Role | None:
        """Who sends the third message; None where there are only two."""
        return self.messages[2].sender if len(self.messages) > 2 else None


def single_sided(t: Intervals) -> Floats:
    """ICRA 2023, eq. (1)."""
    return (t.dt41 - t.dt32) / 2


def carrier_corrected(t: Intervals) -> Floats:
    """ICRA 2023, eq. (1), with the reply rescaled by the clocks' ratio as the carrier integrator has it."""
    # Taken apart, so that what is left of two long times is not rounded twice.
    return (t.dt41 - t.dt32 - t.carrier_ppm * 1e-6 * t.dt32) / 2


def _clock_ratio(t: Intervals) -> Floats:
    with np.errstate(divide="ignore", invalid="ignore"):
        return t.dt64 / t.dt53


def double_sided(t: Intervals) -> Floats:
    """ICRA 2023, eq. (2): the target's reply is rescaled by K = dt64/dt53."""
    with np.errstate(invalid="ignore"):  # an infinite ratio of a reply of zero, as of stamps that are all the same
        return (t.dt41 - _clock_ratio(t) * t.dt32) / 2


def alternative(t: Intervals) -> Floats:
    """Neirynck, Luk, McLaughlin, WPNC 2016: (R1 R2 - D1 D2) / (R1 + R2 + D1 + D2)."""
    # R1 R2 - D1 D2 cancels twenty digits: with R = D + e it is D1 e2 + D2 e1 + e1 e2, which does
    # not cancel (e1 and e2 are near twice the flight time plus what the skew adds).
    e1 = t.dt41 - t.dt32
    e2 = t.dt64 - t.dt53
    numerator = t.dt32 * e2 + t.dt53 * e1 + e1 * e2
    with np.errstate(divide="ignore", invalid="ignore"):
        return numerator / (t.dt41 + t.dt64 + t.dt32 + t.dt53)


def half_delays(t: Intervals) -> tuple[Floats, Floats]:
    """Weights of SS-TWR: each delay is half in the time of flight."""
    half = np.full_like(t.dt41, 0.5)
    return half, half


def carrier_delays(t: Intervals) -> tuple[Floats, Floats]:
    """Weights of `carrier_corrected`: the reply, and with it the target's delay, is rescaled."""
    return np.full_like(t.dt41, 0.5), (1 + t.carrier_ppm * 1e-6) / 2


def double_sided_delays(t: Intervals) -> tuple[Floats, Floats]:
    """Weights of `double_sided`, ICRA 2023, section III: 1/2 and K/2."""
    return np.full_like(t.dt41, 0.5), _clock_ratio(t) / 2


def alternative_delays(t: Intervals) -> tuple[Floats, Floats]:
    """Weights of `alternative`: its derivatives by what each delay adds to a round trip and takes from a reply."""
    with np.errstate(divide="ignore", invalid="ignore"):
        total = t.dt41 + t.dt64 + t.dt32 + t.dt53
        return (t.dt64 + t.dt32) / total, (t.dt41 + t.dt53) / total
