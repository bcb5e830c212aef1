"""Ranging protocols: messages and formulas of a protocol, the table of protocols, and checks of registered ones.

A formula maps `Intervals` of n exchanges to the time of flight in ticks (n,), or to its derivatives by the antenna
delays of both tags, a pair of weights (n,) without a unit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from uwblink.arrays import Floats
from uwblink.errors import ArgumentError
from uwblink.plugins import Registry, check_row, is_text

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


def single_sided_flight(t: Intervals) -> Floats:
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


def _own_rows() -> tuple[RangingProtocol, ...]:
    poll, reply = ProtocolMessage("initiator", "", "at once"), ProtocolMessage("target", "rx1", "at once")
    delayed, last = replace(reply, timing="scheduled"), ProtocolMessage("initiator", "rx2", "scheduled")
    return (
        RangingProtocol("ss", "SS-TWR", (poll, delayed), single_sided_flight, half_delays),
        RangingProtocol(
            "ss-cfo",
            "SS-TWR, corrected with the carrier integrator",
            (poll, delayed),
            carrier_corrected,
            carrier_delays,
        ),
        RangingProtocol(
            "ds",
            "DS-TWR, third message from the target",
            (poll, reply, ProtocolMessage("target", "tx2", "scheduled")),
            double_sided,
            double_sided_delays,
        ),
        RangingProtocol(
            "ds-alt",
            "DS-TWR, third message from the initiator",
            (poll, reply, last),
            alternative,
            alternative_delays,
        ),
        RangingProtocol(
            "ds-sym",
            "DS-TWR, third message from the initiator, equal replies",
            (poll, delayed, last),
            alternative,
            alternative_delays,
        ),
    )


ON_BOARDS: Final = ("ds", "ss")
"""The protocols that the boards' firmware executes."""


def check_protocol(row: RangingProtocol) -> None:
    """Raise `ArgumentError` for a protocol that cannot be simulated, recorded and calibrated; says what is wrong.

    Its messages are two or three, of the order that the stamps of a recording have; and its formulas, tried on two
    exchanges without noise or skew, find the time of flight exactly, and take an antenna delay on either side out.
    """
    formula = (callable, "a function of Intervals")
    is_messages = (
        lambda found: isinstance(found, tuple) and all(isinstance(m, ProtocolMessage) for m in found),
        "a tuple of ProtocolMessage",
    )
    title = (is_text, "what pages call it")
    fields = {"title": title, "messages": is_messages, "flight_ticks": formula, "delay_weights": formula}
    check_row("protocol", RangingProtocol, fields, row)
    _check_messages(row)
    _check_formulas(row)


def _check_messages(row: RangingProtocol) -> None:
    """Raise `ArgumentError` for messages that are not two or three, in the order that a recording has stamps for."""
    where = f"protocol {row.name!r}: messages"
    # Who may send each message, and after which stamp: that is what dt41 to dt64 are made of.
    course = ([("initiator", "")], [("target", "rx1")], [("target", "tx2"), ("initiator", "rx2")])
    if not 2 <= len(row.messages) <= 3:
        raise ArgumentError(
            f"{where}: found {len(row.messages)}, expected 2 or 3: a recording has six stamps of three messages for "
            f"an exchange, and a round trip needs two messages"
        )
    for number, (message, allowed) in enumerate(zip(row.messages, course, strict=False), start=1):
        if (message.sender, message.after) not in allowed or message.timing not in ("at once", "scheduled"):
            choices = " or ".join(f"from the {sender} after {after or 'nothing'}" for sender, after in allowed)
            raise ArgumentError(f"{where}: {number}: found {message}, expected {choices}, at once or scheduled")


def _check_formulas(row: RangingProtocol) -> None:
    """Raise `ArgumentError` for formulas that are not exact for exchanges without noise, or leave antenna delays in."""
    where, tried = f"protocol {row.name!r}", np.array([1000.0, 4000.0])
    for delays in ((0.0, 0.0), (64.0, 0.0), (0.0, 64.0)):
        spans = _tried(tried, row.third_sender, delays)
        try:
            flight = np.asarray(row.flight_ticks(spans), dtype=np.float64)
            first, second = np.asarray(row.delay_weights(spans), dtype=np.float64)
            corrected = flight + first * delays[0] + second * delays[1]
        except Exception as error:
            raise ArgumentError(f"{where}: its formulas fail on an exchange without noise: {error!r:.200}") from error
        if not flight.shape == first.shape == second.shape == tried.shape:
            raise ArgumentError(
                f"{where}: its formulas return shapes {flight.shape} and {(first.shape, second.shape)} for two "
                "exchanges, expected (2,) each"
            )
        # 1e-2 ticks is 0.05 mm; what second order leaves of the delay tried, in the project's own rows, is 2e-5.
        if not np.allclose(corrected, tried, rtol=0, atol=1e-2):
            culprit = "delay_weights leave" if any(delays) else "flight_ticks finds"
            raise ArgumentError(
                f"{where}: {culprit} {corrected[0]:.6g} ticks for an exchange without noise of {tried[0]:g} "
                f"ticks" + (f", with antenna delays of {delays[0]:g} and {delays[1]:g}" * any(delays))
            )


def _tried(flight: Floats, third: str | None, delays: tuple[float, float]) -> Intervals:
    """Return the intervals of two exchanges between equal clocks, with the aggregate delay of each side in them."""
    i, j = delays
    reply, final = np.array([2e7, 9.8e7]), np.array([9.8e7, 3e7])
    if third == "initiator":
        legs = final + i, 2 * flight + final - j
    else:
        legs = (final, final) if third else (np.zeros(2), np.zeros(2))
    return Intervals(2 * flight + reply - i, reply + j, *legs, np.zeros(2))


PROTOCOLS: Final[Registry[RangingProtocol]] = Registry("protocol", "uwbcal.protocols", _own_rows(), check_protocol)
"""Protocols by name: the project's, those of `register_protocol`, and those of installed distributions."""


def register_protocol(row: RangingProtocol, *, replace: bool = False) -> None:
    """Add a protocol to `PROTOCOLS`, for simulation, recording, calibration and comparison.

    `replace` puts it in place of one registered before. Raises `ArgumentError` for a name that is taken, for messages
    that a recording has no place for, and for formulas that are not exact without noise.

    >>> import numpy as np, uwblink
    >>> from uwblink import ProtocolMessage, RangingProtocol
    >>> poll = ProtocolMessage("initiator", "", "at once")
    >>> reply = ProtocolMessage("target", "rx1", "scheduled")
    >>> mine = RangingProtocol(
    ...     "my-ss", "SS-TWR of mine", (poll, reply),
    ...     flight_ticks=lambda t: (t.dt41 - t.dt32) / 2,
    ...     delay_weights=lambda t: (np.full_like(t.dt41, 0.5), np.full_like(t.dt41, 0.5)),
    ... )
    >>> uwblink.register_protocol(mine)
    >>> "my-ss" in uwblink.PROTOCOLS
    True
    >>> uwblink.PROTOCOLS.remove("my-ss")
    """
    PROTOCOLS.register(row, replace=replace)


def single_sided() -> tuple[str, ...]:
    """Return the names of the protocols of two messages."""
    return tuple(row.name for row in PROTOCOLS.values() if row.third_sender is None)


def is_single_sided(name: str) -> bool:
    """Return whether a protocol has two messages; one of the project's own is known without looking for others."""
    return name in PROTOCOLS and PROTOCOLS[name].third_sender is None
