"""Mean and variance of a protocol's error without simulating it (docs/theory.md, "Predicting a protocol").

The mean is the protocol's formula at the intervals that exchanges without noise have; the variance propagates the
errors of stamps through the formula to first order. Both come from the protocol's row, for as many states of the world
at once as there are; `predict_state` describes a single one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from uwblink.arrays import Floats
from uwblink.protocols.rows import Intervals, RangingProtocol
from uwblink.ticks import ANTENNA_DELAY_TICKS, DELAYED_TX_GRID, METRES_PER_TICK, SPEED_OF_LIGHT, TICK_S
from uwbsim.errors import ParameterError
from uwbsim.protocols.conditions import Conditions, chosen, interval_stamps
from uwbsim.scenario.devices import TX_SHARE
from uwbsim.world.clocks import RATE_SPAN_S


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictedErrors:
    """Errors of ranges, (n,) each: their mean in metres, and the parts of their variance in square metres."""

    mean_m: Floats
    transmit_m2: Floats
    receive_m2: Floats
    quantization_m2: Floats
    carrier_m2: Floats
    clock_m2: Floats
    multipath_m2: Floats

    @property
    def variance_m2(self) -> Floats:
        """Return the whole variance."""
        radio = self.transmit_m2 + self.receive_m2 + self.quantization_m2 + self.carrier_m2
        return radio + self.clock_m2 + self.multipath_m2

    def pooled(self) -> tuple[float, float]:
        """Return mean and variance over all states together: the variance has the spread of the means in it."""
        return float(np.mean(self.mean_m)), float(np.mean(self.variance_m2) + np.var(self.mean_m))

    def mean_of(self, count: float) -> float:
        """Return the mean squared error, in square metres, of the mean of `count` ranges in one state, over all states.

        Noise averages away with their number. What a state does to the mean (skew in single-sided ranging, an
        obstacle) is the same in each of them, and stays.
        """
        return float(np.mean(self.mean_m**2) + np.mean(self.variance_m2) / count)


def predict(protocol: RangingProtocol, c: Conditions) -> PredictedErrors:
    """Predict the error of a protocol under conditions (n,)."""
    spans, (leave, arrive) = _noiseless(protocol, c)
    truth = ((arrive[0] - leave[0] + arrive[1] - leave[1]) / 2 - c.excess) / TICK_S
    slopes = dict(_slopes(protocol, spans))
    stamps = _by_stamp(protocol, slopes)
    squares = {kind: _sum_of_squares(stamps, kind) for kind in ("tx", "rx")}
    # A detour of all messages lengthens the two flights of the first round trip; the formulas hold it to the same
    # precision as the flight itself.
    p, detour = c.multipath, c.detour_s * SPEED_OF_LIGHT
    flight = protocol.flight_ticks(spans) - truth
    return PredictedErrors(
        mean_m=np.asarray(flight * METRES_PER_TICK + p * detour),
        transmit_m2=np.asarray(squares["tx"] * (c.tx_std * SPEED_OF_LIGHT) ** 2),
        receive_m2=np.asarray(squares["rx"] * (c.rx_std * SPEED_OF_LIGHT) ** 2),
        quantization_m2=np.asarray(squares["rx"] * METRES_PER_TICK**2 / 12 * c.quantize),
        carrier_m2=np.asarray((slopes["carrier_ppm"] * c.carrier_std_ppm * METRES_PER_TICK) ** 2),
        clock_m2=_white_clocks(protocol, slopes, stamps, leave, arrive, c) * SPEED_OF_LIGHT**2,
        multipath_m2=np.full(len(c), p * (2 - p) * detour**2),
    )


def _noiseless(protocol: RangingProtocol, c: Conditions) -> tuple[Intervals, tuple[list[Floats], list[Floats]]]:
    """Return the intervals of exchanges without noise in ticks, and true seconds at which messages leave and arrive.

    From true durations: what a clock reads of one is its length times 1 + rate, plus half of drift times the difference
    of squares of its ends; what antennas and power add to stamps comes on top.
    """
    ticks = 1 / TICK_S
    tx = {"initiator": c.tx_delay_initiator, "target": c.tx_delay_target}
    rx = {"initiator": c.rx_delay_initiator + c.late, "target": c.rx_delay_target + c.late}
    rate = {"initiator": c.rate_initiator, "target": c.rate_target}
    drift = {"initiator": c.drift_initiator, "target": c.drift_target}
    replies = [_reply_s(protocol, k, c) for k in range(1, len(protocol.messages))]
    # True instants at the antennas, from the departure of the poll.
    leave = [np.zeros(len(c))]
    way = c.flight + c.excess
    arrive = [way]
    for k, message in enumerate(protocol.messages[1:], start=1):
        side, before = message.sender, message.after
        since = arrive[k - 1] if before.startswith("rx") else leave[k - 1]
        # The printed reply runs from stamp to stamp; at the antenna it is shorter by what antenna and power add.
        added = tx[side] - (rx[side] if before.startswith("rx") else tx[side])
        true = (replies[k - 1] - added) / (1 + rate[side])
        leave.append(since + true)
        arrive.append(leave[k] + way + c.flight_rate * leave[k])

    def stamp(name: str) -> tuple[str, Floats, Floats]:
        """Return whose stamp it is, its true time, and what antenna and power add to it."""
        k, sent = int(name[2]) - 1, name.startswith("tx")
        side = protocol.messages[k].sender
        if sent:
            return side, leave[k], tx[side]
        other = "target" if side == "initiator" else "initiator"
        return other, arrive[k], rx[other]

    spans = {"dt53": np.ones(len(c)), "dt64": np.ones(len(c))}
    for name, ends in interval_stamps(protocol).items():
        (owner, later, added), (_, earlier, early) = map(stamp, ends)
        true = (1 + rate[owner]) * (later - earlier) + drift[owner] / 2 * (later**2 - earlier**2)
        spans[name] = (true + added - early) * ticks
    carrier = c.carrier_sign * (c.rate_initiator - c.rate_target) * 1e6 + c.carrier_bias_ppm
    return Intervals(**spans, carrier_ppm=carrier), (leave, arrive)


def _reply_s(protocol: RangingProtocol, k: int, c: Conditions) -> Floats:
    """Return the reply before message k, as printed, on average over where the counter's grid happens to lie."""
    scheduled = protocol.messages[k].timing == "scheduled"
    reply = c.scheduled if scheduled else c.at_once
    if not c.quantize:
        return reply
    # A grid that is rounded down, and the boards' antenna delay on top; or rounded up, to where they want to be.
    half = DELAYED_TX_GRID / 2 * TICK_S
    return reply - half + ANTENNA_DELAY_TICKS * TICK_S if scheduled else reply + half


def _slopes(protocol: RangingProtocol, spans: Intervals) -> Iterator[tuple[str, Floats]]:
    """Yield the derivative of the flight by each interval, and by the carrier's ppm."""
    for name in ("dt41", "dt32", "dt53", "dt64", "carrier_ppm"):
        # The formulas are smooth over thousands of ticks, and over ppm.
        step = 16.0 if name != "carrier_ppm" else 1.0
        value = getattr(spans, name)
        up, down = (protocol.flight_ticks(replace(spans, **{name: value + s})) for s in (step, -step))
        yield name, np.asarray((up - down) / (2 * step))


def _by_stamp(protocol: RangingProtocol, slopes: dict[str, Floats]) -> dict[str, Floats]:
    """Return the derivative of the flight by the error of each stamp."""
    found: dict[str, Floats] = {}
    for interval, (later, earlier) in interval_stamps(protocol).items():
        found[later] = found.get(later, 0.0) + slopes[interval]
        found[earlier] = found.get(earlier, 0.0) - slopes[interval]
    return found


def _white_clocks(
    protocol: RangingProtocol,
    slopes: dict[str, Floats],
    stamps: dict[str, Floats],
    leave: list[Floats],
    arrive: list[Floats],
    c: Conditions,
) -> Floats:
    """Return the variance of the flight in square seconds that white noise of the clocks' rates leaves.

    The phase at an instant is what the clock has gathered until then, so a span of time weighs with the sum of the
    slopes of all that is read after it: h^2 times the integral of its square. The carrier integrator reads the mean
    rate over the preamble of the second message.
    """
    # How the flight changes with what the phase gains during the preamble.
    gain = c.carrier_sign * slopes["carrier_ppm"] * 1e6 * TICK_S / RATE_SPAN_S
    total = np.zeros(len(c))
    for side, white, sign in (("initiator", c.white_initiator, 1), ("target", c.white_target, -1)):
        read = [(leave[1] - RATE_SPAN_S, -sign * gain), (leave[1], sign * gain)]
        for k, message in enumerate(protocol.messages):
            name, time = ("tx", leave[k]) if message.sender == side else ("rx", arrive[k])
            read.append((time, stamps.get(f"{name}{k + 1}", np.zeros(len(c)))))
        read.sort(key=lambda pair: float(pair[0][0]))
        after = np.cumsum([slope for _, slope in reversed(read)], axis=0)[::-1]
        gaps = np.diff([time for time, _ in read], axis=0)
        total += white**2 * np.sum(after[1:] ** 2 * np.maximum(gaps, 0), axis=0)
    return total


def _sum_of_squares(stamps: dict[str, Floats], kind: str) -> Floats:
    return np.asarray(sum(slope**2 for name, slope in stamps.items() if name.startswith(kind)))


@dataclass(frozen=True, slots=True, kw_only=True)
class State:
    """One state of the world to predict ranges in; `protocol` is a name or a row of `PROTOCOLS`.

    The skew is that of the initiator's clock relative to the target's, shared by both equally. `reply_delay_us` is the
    target's reply (dt32), `final_delay_us` the third message's delay (dt53), None for that of the boards, 1538.7; a
    protocol without a third message, or whose third message waits as long as the reply ("ds-sym"), takes none. An
    aggregate antenna delay is split 0.44 to 0.56 between transmission and reception, which changes nothing.

    >>> from uwbsim import State
    >>> State(protocol="ss", skew_ppm=4.0).reply_delay_us
    300.0
    """

    protocol: str | RangingProtocol = "ds"
    skew_ppm: float = 0.0
    reply_delay_us: float = 300.0
    final_delay_us: float | None = None
    distance_m: float = 5.0
    speed_mps: float = 0.0
    drift_ppm_per_s: float = 0.0
    tx_noise_ps: float = 0.0
    rx_noise_ps: float = 150.0
    carrier_noise_ppm: float = 0.2
    carrier_bias_ppm: float = 0.0
    delay_initiator_ns: float = 0.0
    delay_target_ns: float = 0.0
    whole_ticks: bool = False


def _check(q: State) -> None:
    not_negative = ("reply_delay_us", "distance_m", "tx_noise_ps", "rx_noise_ps", "carrier_noise_ppm")
    for field in fields(q):
        value = getattr(q, field.name)
        if field.name in ("protocol", "whole_ticks") or value is None:
            continue
        if not isinstance(value, int | float) or not abs(value) < 1e9:
            raise ParameterError(f"found {value}, expected a number below 1e+09", parameter=field.name)
        if field.name in not_negative and value < 0:
            raise ParameterError(f"found {value:g}, expected 0 or more", parameter=field.name)
    # A third message that follows at once leaves nothing to tell the clocks' rates from.
    if q.final_delay_us is not None and q.final_delay_us < 1.0:
        raise ParameterError(f"found {q.final_delay_us:g}, expected at least 1", parameter="final_delay_us")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Prediction:
    """What a raw range in one state errs by: `bias_m`, `std_m`, `variance_m2`, and in ps of the time of flight.

    `parts_m` is the standard deviation in metres that each cause alone leaves.

    >>> import uwbsim
    >>> print(uwbsim.predict_state(uwbsim.State(protocol="ss", skew_ppm=2.0)))
    SS-TWR
      bias                       +8.9916 cm
      standard deviation          3.1788 cm
        of transmit noise         0.0000 cm
        of receive noise          3.1788 cm
        of whole ticks            0.0000 cm
        of carrier integrator     0.0000 cm
    """

    protocol: str
    title: str
    bias_m: float
    std_m: float
    variance_m2: float
    bias_ps: float
    std_ps: float
    parts_m: dict[str, float]

    def __repr__(self) -> str:
        """Return a line a figure, in cm."""
        lines = [
            self.title,
            f"  bias                    {100 * self.bias_m:+10.4f} cm",
            f"  standard deviation      {100 * self.std_m:10.4f} cm",
            *(f"    of {name:19s}{100 * part:10.4f} cm" for name, part in self.parts_m.items()),
        ]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return what `uwbsim predict --json` prints."""
        return asdict(self)


def predict_state(q: State) -> Prediction:
    """Return bias and standard deviation of a raw range without simulating any, and the parts of the latter.

    Raises `ParameterError` for a number that cannot be, and for an unknown protocol.

    >>> import uwbsim
    >>> found = uwbsim.predict_state(uwbsim.State(protocol="ss", skew_ppm=2.0, reply_delay_us=1000.0, rx_noise_ps=0.0))
    >>> round(found.bias_m, 3)  # half of skew times reply times the speed of light
    0.3
    """
    (protocol,) = chosen([q.protocol], "protocol")
    _check(q)
    # The target's reply is the scheduled message where there is no third one, or where both replies are equal.
    timings = [message.timing for message in protocol.messages]
    target_waits, final_at_once = timings[1] == "scheduled", timings[1:] == ["scheduled", "at once"]
    if q.final_delay_us is not None and target_waits and not final_at_once:
        what = "has no third message" if len(timings) < 3 else "waits as long with its third message as with its reply"
        text = f"{protocol.name} {what}; leave it out, and give that of the reply"
        raise ParameterError(text, parameter="final_delay_us")
    # The boards' firmware waits by default 1500 of its own microseconds (512/499.2 us), and a step of its clock.
    final_us = 1538.7 if q.final_delay_us is None else q.final_delay_us
    scheduled = q.reply_delay_us if target_waits else final_us
    at_once = final_us if final_at_once else q.reply_delay_us
    conditions = Conditions.single(
        flight=q.distance_m / SPEED_OF_LIGHT,
        flight_rate=q.speed_mps / SPEED_OF_LIGHT,
        rate_initiator=q.skew_ppm * 0.5e-6,
        rate_target=-q.skew_ppm * 0.5e-6,
        drift_initiator=q.drift_ppm_per_s * 0.5e-6,
        drift_target=-q.drift_ppm_per_s * 0.5e-6,
        tx_std=q.tx_noise_ps * 1e-12,
        rx_std=q.rx_noise_ps * 1e-12,
        tx_delay_initiator=TX_SHARE * 1e-9 * q.delay_initiator_ns,
        rx_delay_initiator=(TX_SHARE - 1) * 1e-9 * q.delay_initiator_ns,
        tx_delay_target=TX_SHARE * 1e-9 * q.delay_target_ns,
        rx_delay_target=(TX_SHARE - 1) * 1e-9 * q.delay_target_ns,
        at_once=at_once * 1e-6,
        scheduled=scheduled * 1e-6,
        carrier_bias_ppm=q.carrier_bias_ppm,
        carrier_std_ppm=q.carrier_noise_ppm,
        quantize=q.whole_ticks,
    )
    found = predict(protocol, conditions)
    bias, variance = found.pooled()
    parts = {
        "transmit noise": found.transmit_m2,
        "receive noise": found.receive_m2,
        "whole ticks": found.quantization_m2,
        "carrier integrator": found.carrier_m2,
    }
    return Prediction(
        protocol=protocol.name,
        title=protocol.title,
        bias_m=bias,
        std_m=variance**0.5,
        variance_m2=variance,
        bias_ps=bias / SPEED_OF_LIGHT * 1e12,
        std_ps=variance**0.5 / SPEED_OF_LIGHT * 1e12,
        parts_m={name: float(part[0]) ** 0.5 for name, part in parts.items()},
    )
