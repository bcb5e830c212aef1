"""Analytical mean and variance of a protocol's error (docs/theory.md, "Predicting a protocol").

The mean is the protocol's formula at the intervals that exchanges without noise have; the variance propagates the
errors of stamps through the formula to first order. Both come from the protocol's row, for as many states of the world
at once as there are; `predict_state` describes a single one.

In a fleet of n tags there are exchanges pair by pair, broadcasts in turn, and tags that only listen to broadcasts.
Broadcasts are double-sided exchanges whose replies wait for slots. A listener k has the difference of arrival of the
frames of i and j as rx_k(j) - rx_k(i) - K (tx_j - rx_j(i)) - d_ij/c, where K is the rate of its clock relative to j's
between them, from three frames of j (`uwblink.receptions`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from uwblink.arrays import Floats
from uwblink.protocols.table import PROTOCOLS, RangingProtocol
from uwblink.ticks import METRES_PER_TICK, SPEED_OF_LIGHT, TICK_S, TX_SHARE
from uwbsim.errors import ParameterError
from uwbsim.protocols.conditions import SIDES, Conditions, Stamps, calibrated, chosen, exchange, intervals_of
from uwbsim.scenario.ranging import TURNAROUND_S, broadcast_s, exchange_costs
from uwbsim.settings import State
from uwbsim.world.clocks import RATE_SPAN_S


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictedErrors:
    """Errors of ranges, (n,) each: their mean in metres, and the parts of their variance in square metres by cause."""

    mean_m: Floats
    parts_m2: dict[str, Floats]

    @property
    def variance_m2(self) -> Floats:
        """Return the total variance."""
        return np.asarray(np.sum([*self.parts_m2.values()], axis=0))

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
    mean = exchange(protocol, c)
    readings = mean.stamps | {"carrier": mean.carrier_ppm}

    def flight(**errors: float) -> Floats:
        """Return the flight in ticks where readings have some errors, by their names."""
        read = readings | {name: readings[name] + error for name, error in errors.items()}
        return protocol.flight_ticks(intervals_of(protocol, read, read["carrier"]))

    # The formulas are smooth over thousands of ticks, and over ppm.
    steps = {name: 1.0 if name == "carrier" else 16.0 for name in readings}
    slopes = {name: (flight(**{name: h}) - flight(**{name: -h})) / (2 * h) for name, h in steps.items()}
    squares = {end: sum(slopes[name] ** 2 for name in mean.stamps if name.startswith(end)) for end in ("tx", "rx")}
    # A detour of all messages lengthens the two flights of the first round trip; the formulas hold it to the same
    # precision as the flight itself.
    p, detour = c.multipath, c.detour_s * SPEED_OF_LIGHT
    return PredictedErrors(
        mean_m=np.asarray((flight() - mean.truth) * METRES_PER_TICK + p * detour),
        parts_m2={
            "transmit noise": squares["tx"] * (c.tx_std * SPEED_OF_LIGHT) ** 2,
            "receive noise": squares["rx"] * (c.rx_std * SPEED_OF_LIGHT) ** 2,
            "whole ticks": np.asarray(squares["rx"] * METRES_PER_TICK**2 / 12 * c.quantize),
            "carrier integrator": (slopes["carrier"] * c.carrier_std_ppm * METRES_PER_TICK) ** 2,
            "clocks": _white_clocks(protocol, slopes, mean, c) * SPEED_OF_LIGHT**2,
            "multipath": np.full(len(c), p * (2 - p) * detour**2),
        },
    )


def _white_clocks(protocol: RangingProtocol, slopes: dict[str, Floats], mean: Stamps, c: Conditions) -> Floats:
    """Return the variance of the flight in square seconds by white noise of the clocks' rates.

    The phase at an instant is the integral of the noise until then, so the noise of a time interval has the sum of the
    slopes of all later readings as its weight: the variance is h^2 times the integral of the squared weight. The
    carrier integrator reads the mean rate over the preamble of the second message.
    """
    # The derivative of the flight by the phase gained during the preamble.
    gain, preamble = (
        c.carrier_sign * slopes["carrier"] * 1e6 * TICK_S / RATE_SPAN_S,
        mean.leave[1] - RATE_SPAN_S / TICK_S,
    )
    total = np.zeros(len(c))
    for side, white, sign in zip(SIDES, c.white, (1, -1), strict=True):
        read = [(preamble, -sign * gain), (mean.leave[1], sign * gain)]
        for k, message in enumerate(protocol.messages):
            name, time = ("tx", mean.leave[k]) if message.sender == side else ("rx", mean.arrive[k])
            read.append((time, slopes[f"{name}{k + 1}"]))
        read.sort(key=lambda pair: float(pair[0][0]))
        after = np.cumsum([slope for _, slope in reversed(read)], axis=0)[::-1]
        gaps = np.diff([time for time, _ in read], axis=0) * TICK_S
        total += white**2 * np.sum(after[1:] ** 2 * np.maximum(gaps, 0), axis=0)
    return total


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Prediction:
    """The predicted error of a raw range in one state: `bias_m`, `std_m`, `variance_m2`, and in ps of time of flight.

    `parts_m` are the standard deviations in metres by each cause alone.

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
        """Return one line per figure, in cm."""
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
    """Predict bias and standard deviation of a raw range analytically, and the parts of the latter.

    Raises `ParameterError` for an unknown protocol.

    >>> import uwbsim
    >>> found = uwbsim.predict_state(uwbsim.State(protocol="ss", skew_ppm=2.0, reply_delay_us=1000.0, rx_noise_ps=0.0))
    >>> round(found.bias_m, 3)  # half of skew times reply times the speed of light
    0.3
    """
    (protocol,) = chosen([q.protocol], "protocol")
    found = predict(protocol, conditions_of_state(q, protocol))
    bias, variance = found.pooled()
    # A state has neither noise of clocks nor multipath.
    parts = {name: part for name, part in found.parts_m2.items() if name not in ("clocks", "multipath")}
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


def conditions_of_state(q: State, protocol: RangingProtocol) -> Conditions:
    """Return a state as conditions (1,) of exchanges of a protocol; raises what `predict_state` raises."""
    # The target's reply is the scheduled message where there is no third one, or where both replies are equal.
    timings = [message.timing for message in protocol.messages]
    target_waits, final_at_once = timings[1] == "scheduled", timings[1:] == ["scheduled", "at once"]
    if q.final_delay_us is not None and target_waits and not final_at_once:
        what = "has no third message" if len(timings) < 3 else "has equal delays of reply and third message"
        raise ParameterError(
            f"{protocol.name} {what}; remove it, and give the delay of the reply", parameter="final_delay_us"
        )
    # The boards' firmware waits by default 1500 of its own microseconds (512/499.2 us), and a step of its clock.
    final_us = 1538.7 if q.final_delay_us is None else q.final_delay_us
    scheduled = q.reply_delay_us if target_waits else final_us
    at_once = final_us if final_at_once else q.reply_delay_us
    skew, aggregate = np.array([0.5e-6, -0.5e-6]), np.array([q.delay_initiator_ns, q.delay_target_ns])
    return Conditions.single(
        flight=q.distance_m / SPEED_OF_LIGHT,
        flight_rate=q.speed_mps / SPEED_OF_LIGHT,
        rate=q.skew_ppm * skew,
        drift=q.drift_ppm_per_s * skew,
        tx_std=q.tx_noise_ps * 1e-12,
        rx_std=q.rx_noise_ps * 1e-12,
        tx_delay=TX_SHARE * 1e-9 * aggregate,
        rx_delay=(TX_SHARE - 1) * 1e-9 * aggregate,
        at_once=at_once * 1e-6,
        scheduled=scheduled * 1e-6,
        carrier_bias_ppm=q.carrier_bias_ppm,
        carrier_std_ppm=q.carrier_noise_ppm,
        quantize=q.whole_ticks,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetFigures:
    """One way of ranging in a fleet: a protocol, "broadcast" or "tdoa"; errors in metres, durations in seconds.

    Errors are those of a calibrated range, or difference of arrival: `std_m` by noise, `rmse_m` with the bias by skew
    and motion. `air_s` and `radio_on_s` are the durations per range for which frames are on the air, and for which all
    radios send or receive; of "tdoa" per difference, and for a listener, of which there may be any number. `update_hz`
    is how often a second every pair ranges, or a listener has the differences of all anchors: as frames and replies
    allow, one after the other.

    >>> import uwbsim
    >>> [one.method for one in uwbsim.predict_fleet(uwbsim.State(), 4)]
    ['ss', 'ss-cfo', 'ds', 'ds-alt', 'ds-sym', 'broadcast', 'tdoa']
    """

    method: str
    title: str
    tags: int
    std_m: float
    rmse_m: float
    air_s: float
    radio_on_s: float
    update_hz: float

    def to_dict(self) -> dict[str, Any]:
        """Return the figures as a row of a table."""
        return asdict(self)


def predict_fleet(q: State, tags: int) -> list[FleetFigures]:
    """Predict errors and rates of a fleet of `tags` tags, or of as many anchors with listeners, by each way of ranging.

    The state's `reply_delay_us` is that of replies at once, also between broadcasts, and `final_delay_us` that of
    scheduled messages, which single-sided responses are. Raises `ParameterError` for a number out of range.

    >>> import uwbsim
    >>> found = {one.method: one for one in uwbsim.predict_fleet(uwbsim.State(), 10)}
    >>> round(found["broadcast"].update_hz / found["ds"].update_hz)
    25
    """
    if not 2 <= tags <= 254:
        raise ParameterError(f"found {tags}, expected 2 to 254", parameter="tags")
    return fleet_figures(calibrated(conditions_of_state(q, PROTOCOLS["ds"])), list(PROTOCOLS.values()), tags, 128)


def fleet_figures(
    c: Conditions, protocols: Sequence[RangingProtocol], tags: int, preamble_symbols: int
) -> list[FleetFigures]:
    """Predict the ways of ranging under conditions (n,) without antenna delays and bias by power."""
    scheduled, at_once = float(np.median(c.scheduled)), float(np.median(c.at_once))
    pairs, frame = tags * (tags - 1) / 2, broadcast_s(tags, preamble_symbols)
    slot = frame + at_once
    ways = []
    for row in protocols:
        cost, error = exchange_costs(row, preamble_symbols, scheduled, at_once), predict(row, c)
        std_m, rmse_m = float(np.mean(error.variance_m2)) ** 0.5, error.mean_of(1) ** 0.5
        round_s = pairs * (cost["duration_s"] + TURNAROUND_S)
        ways.append((row.name, row.title, std_m, rmse_m, cost["air_s"], cost["radio_on_s"], round_s))
    # All distances of two slots, of which an exchange has the shorter replies; at least one state for each.
    c = c[np.arange(max(len(c), tags - 1)) % len(c)]
    apart = 1 + np.arange(len(c)) % (tags - 1)
    reply = slot * np.minimum(apart, tags - apart)
    # Frames before and after give the rate between them, which drift does not change.
    error = predict(PROTOCOLS["ds"], c.with_columns(at_once=reply, scheduled=tags * slot, drift=0.0 * c.drift))
    of_ranges, of_differences = broadcast_variances_m2(c, reply, tags * slot)
    range_m2 = float(np.mean(of_ranges + error.parts_m2["multipath"]))
    std_m, rmse_m = range_m2**0.5, float(np.mean(error.mean_m**2) + range_m2) ** 0.5
    difference_m = float(np.mean(of_differences)) ** 0.5
    each, listening = tags * frame / pairs, tags * frame / (tags - 1)
    title = "Broadcasts in turn, every pair double-sided"
    ways.append(("broadcast", title, std_m, rmse_m, each, tags * each, tags * slot))
    title = f"Differences of arrival from {tags} anchors that broadcast"
    ways.append(("tdoa", title, difference_m, difference_m, listening, listening, tags * slot))
    return [
        FleetFigures(
            method=m, title=t, tags=tags, std_m=std, rmse_m=rmse, air_s=air, radio_on_s=on, update_hz=1 / round_s
        )
        for m, t, std, rmse, air, on, round_s in ways
    ]


def broadcast_variances_m2(c: Conditions, reply_s: Floats | float, round_s: Floats | float) -> tuple[Floats, Floats]:
    """Return variances of ranges and of differences of arrival (n,) in square metres: first order in errors of stamps.

    `reply_s` is from the frame of i to that of j, `round_s` between frames of j; r is their ratio. The rate of the
    clocks comes from the frames of j before, in and after the exchange, whose errors count by r (1 + r)/2, 1 - r^2 and
    r (1 - r)/2, together 1 - 3/2 r^2 (1 - r^2). Both errors of i's frame count in a range, at i and j; a difference has
    two receptions of it, so that its transmission cancels. White noise of both clocks is integrated over these frames.
    """
    r = np.asarray(reply_s) / round_s
    of_j = 1 - 1.5 * r**2 * (1 - r**2)
    clocks = (c.white**2).sum(axis=0) * reply_s * (1 - r**2) * (1 - r / 2)
    rx, tx = c.rx_std**2 + TICK_S**2 / 12 * c.quantize, c.tx_std**2
    ranges, differences = ((rx + tx) * (1 + of_j) + clocks) / 4, rx * (2 + of_j) + tx * of_j + clocks
    return np.asarray(ranges * SPEED_OF_LIGHT**2), np.asarray(differences * SPEED_OF_LIGHT**2)
