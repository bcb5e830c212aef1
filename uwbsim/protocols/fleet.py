"""Ranging in a fleet of n tags: exchanges pair by pair, broadcasts in turn, and tags that only listen to broadcasts.

Everything is predicted. Broadcasts are double-sided exchanges whose replies wait for slots. A listener k has the
difference of arrival of the frames of i and j as rx_k(j) - rx_k(i) - K (tx_j - rx_j(i)) - d_ij/c, where K is the rate
of its clock relative to j's between them, from three frames of j (`uwblink.receptions`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from uwblink.arrays import Floats
from uwblink.protocols.table import PROTOCOLS, RangingProtocol
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S
from uwbsim.errors import ParameterError
from uwbsim.protocols.conditions import Conditions, calibrated
from uwbsim.protocols.prediction import State, conditions_of_state, predict
from uwbsim.scenario.ranging import TURNAROUND_S, broadcast_s, exchange_costs


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
    """Predict what a fleet of `tags` tags, or of as many anchors and any listeners, gets by each way of ranging.

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
