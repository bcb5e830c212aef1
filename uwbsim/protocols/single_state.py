"""One state of the world put in words, and what a protocol makes of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, Final

from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.errors import ParameterError
from uwbsim.protocols.comparison import chosen
from uwbsim.protocols.conditions import Conditions
from uwbsim.protocols.prediction import predict

LARGEST: Final = 1e9
SHORTEST_US: Final = 1.0
"""A third message that follows at once leaves nothing to tell the clocks' rates from."""


@dataclass(frozen=True, slots=True)
class State:
    """What to predict; the skew is that of the initiator's clock relative to the target's, shared by both equally.

    An aggregate antenna delay is split 0.44 to 0.56 between transmission and reception, which changes nothing.
    """

    protocol: str
    skew_ppm: float
    reply_delay_us: float
    final_delay_us: float
    distance_m: float
    speed_mps: float
    drift_ppm_per_s: float
    tx_noise_ps: float
    rx_noise_ps: float
    carrier_noise_ppm: float
    carrier_bias_ppm: float
    delay_initiator_ns: float
    delay_target_ns: float
    whole_ticks: bool


def predict_state(q: State) -> dict[str, Any]:
    """Return bias and standard deviation of a range, in metres and as time of flight, and the parts of the latter.

    Raises `ParameterError` for a number that cannot be, and for an unknown protocol.
    """
    (protocol,) = chosen([q.protocol], "protocol")
    for field in fields(q):
        value = getattr(q, field.name)
        if isinstance(value, float) and not (math.isfinite(value) and abs(value) < LARGEST):
            raise ParameterError(field.name, f"found {value}, expected a number below {LARGEST:g}")
    if q.final_delay_us < SHORTEST_US:
        raise ParameterError("final_delay_us", f"found {q.final_delay_us:g}, expected at least {SHORTEST_US:g}")
    # The target's reply is the scheduled message where there is no third one, or where both replies are equal.
    timings = [message.timing for message in protocol.messages]
    target_waits = timings[1] == "scheduled"
    scheduled = q.reply_delay_us if target_waits else q.final_delay_us
    at_once = q.final_delay_us if timings[1:] == ["scheduled", "at once"] else q.reply_delay_us
    conditions = Conditions.single(
        flight=q.distance_m / SPEED_OF_LIGHT,
        flight_rate=q.speed_mps / SPEED_OF_LIGHT,
        rate_initiator=q.skew_ppm * 0.5e-6,
        rate_target=-q.skew_ppm * 0.5e-6,
        drift_initiator=q.drift_ppm_per_s * 0.5e-6,
        drift_target=-q.drift_ppm_per_s * 0.5e-6,
        tx_std=q.tx_noise_ps * 1e-12,
        rx_std=q.rx_noise_ps * 1e-12,
        tx_delay_initiator=0.44e-9 * q.delay_initiator_ns,
        rx_delay_initiator=-0.56e-9 * q.delay_initiator_ns,
        tx_delay_target=0.44e-9 * q.delay_target_ns,
        rx_delay_target=-0.56e-9 * q.delay_target_ns,
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
    return {
        "protocol": protocol.name,
        "title": protocol.title,
        "bias_m": bias,
        "std_m": variance**0.5,
        "variance_m2": variance,
        "bias_ps": bias / SPEED_OF_LIGHT * 1e12,
        "std_ps": variance**0.5 / SPEED_OF_LIGHT * 1e12,
        "parts_m": {name: float(part[0]) ** 0.5 for name, part in parts.items()},
    }
