"""One state of the world put in words, and what a protocol makes of it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any, Final

from uwblink.protocols.rows import RangingProtocol
from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.errors import ParameterError
from uwbsim.protocols.comparison import chosen
from uwbsim.protocols.conditions import Conditions
from uwbsim.protocols.prediction import predict
from uwbsim.units import PS, PS_PER_S, US

LARGEST: Final = 1e9
FINAL_DELAY_US: Final = 1538.7
"""What the boards' firmware waits by default: 1500 of its own microseconds (512/499.2 us), and a step of its clock."""

SHORTEST_US: Final = 1.0
"""A third message that follows at once leaves nothing to tell the clocks' rates from."""


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


NOT_NEGATIVE: Final = ("reply_delay_us", "distance_m", "tx_noise_ps", "rx_noise_ps", "carrier_noise_ppm")


def _check(q: State) -> None:
    for field in fields(q):
        value = getattr(q, field.name)
        if field.name in ("protocol", "whole_ticks") or value is None:
            continue
        if not isinstance(value, int | float) or not abs(value) < LARGEST:
            raise ParameterError(f"found {value}, expected a number below {LARGEST:g}", parameter=field.name)
        if field.name in NOT_NEGATIVE and value < 0:
            raise ParameterError(f"found {value:g}, expected 0 or more", parameter=field.name)
    if q.final_delay_us is not None and q.final_delay_us < SHORTEST_US:
        raise ParameterError(
            f"found {q.final_delay_us:g}, expected at least {SHORTEST_US:g}", parameter="final_delay_us"
        )


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
    final_us = FINAL_DELAY_US if q.final_delay_us is None else q.final_delay_us
    scheduled = q.reply_delay_us if target_waits else final_us
    at_once = final_us if final_at_once else q.reply_delay_us
    conditions = Conditions.single(
        flight=q.distance_m / SPEED_OF_LIGHT,
        flight_rate=q.speed_mps / SPEED_OF_LIGHT,
        rate_initiator=q.skew_ppm * 0.5e-6,
        rate_target=-q.skew_ppm * 0.5e-6,
        drift_initiator=q.drift_ppm_per_s * 0.5e-6,
        drift_target=-q.drift_ppm_per_s * 0.5e-6,
        tx_std=q.tx_noise_ps * PS,
        rx_std=q.rx_noise_ps * PS,
        tx_delay_initiator=0.44e-9 * q.delay_initiator_ns,
        rx_delay_initiator=-0.56e-9 * q.delay_initiator_ns,
        tx_delay_target=0.44e-9 * q.delay_target_ns,
        rx_delay_target=-0.56e-9 * q.delay_target_ns,
        at_once=at_once * US,
        scheduled=scheduled * US,
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
        bias_ps=bias / SPEED_OF_LIGHT * PS_PER_S,
        std_ps=variance**0.5 / SPEED_OF_LIGHT * PS_PER_S,
        parts_m={name: float(part[0]) ** 0.5 for name, part in parts.items()},
    )
