"""Settings of predictions, for Python and for the command line, and their checks."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any, Final

from uwblink.settings import setting
from uwbsim.errors import ParameterError

FROM_ZERO: Final = (0.0, math.inf)


def protocol_names() -> Iterable[str]:
    """Return the names of all protocols, also those of installed distributions."""
    from uwblink import PROTOCOLS  # it would load NumPy for the help of commands

    return PROTOCOLS


@dataclass(frozen=True, slots=True, kw_only=True)
class State:
    """One state of the world to predict ranges in; `protocol` is a name or a row of `PROTOCOLS`.

    The skew is that of the initiator's clock relative to the target's, shared by both equally. `reply_delay_us` is the
    target's reply (dt32), `final_delay_us` the third message's delay (dt53), None for that of the boards, 1538.7; a
    protocol without a third message, or whose third message waits as long as the reply ("ds-sym"), takes none. An
    aggregate antenna delay is split 0.44 to 0.56 between transmission and reception, which changes nothing. Raises
    `ParameterError` for a number out of range.

    >>> from uwbsim import State
    >>> State(protocol="ss", skew_ppm=4.0).reply_delay_us
    300.0
    """

    protocol: Any = setting(  # a name or a RangingProtocol
        "ds",
        "Protocol by its name.",
        kind=str,
        names=("ss", "ss-cfo", "ds", "ds-alt", "ds-sym"),
        more=protocol_names,
    )
    skew_ppm: float = setting(0.0, "Skew of the initiator's clock relative to the target's.", rich_help_panel="Tags")
    reply_delay_us: float = setting(
        300.0, "Delay of the target's reply (dt32).", bounds=FROM_ZERO, rich_help_panel="Timing"
    )
    final_delay_us: float | None = setting(
        None,
        "Delay of the third message (dt53; only ds, ds-alt); by default 1538.7.",
        bounds=(1.0, math.inf),  # a third message that follows at once would not tell the clocks' rates
        rich_help_panel="Timing",
    )
    distance_m: float = setting(5.0, "Distance.", bounds=FROM_ZERO, rich_help_panel="Tags")
    speed_mps: float = setting(0.0, "Speed at which the distance grows.", rich_help_panel="Tags")
    drift_ppm_per_s: float = setting(0.0, "Change of the relative skew.", rich_help_panel="Tags")
    tx_noise_ps: float = setting(
        0.0, "Standard deviation of transmit stamps.", bounds=FROM_ZERO, rich_help_panel="Noise"
    )
    rx_noise_ps: float = setting(
        150.0, "Standard deviation of receive stamps.", bounds=FROM_ZERO, rich_help_panel="Noise"
    )
    carrier_noise_ppm: float = setting(
        0.2, "Standard deviation of the carrier integrator's reading.", bounds=FROM_ZERO, rich_help_panel="Noise"
    )
    carrier_bias_ppm: float = setting(0.0, "Bias of the carrier integrator's reading.", rich_help_panel="Noise")
    delay_initiator_ns: float = setting(
        0.0, "Antenna delay of the initiator; a positive one shortens ranges.", rich_help_panel="Tags"
    )
    delay_target_ns: float = setting(
        0.0, "Antenna delay of the target; a positive one shortens ranges.", rich_help_panel="Tags"
    )
    whole_ticks: bool = setting(False, "Round stamps to ticks of 15.65 ps.", rich_help_panel="Noise")

    def __post_init__(self) -> None:
        """Check the numbers; the protocol is checked where it is used."""
        for one in fields(self):
            name, value = one.name, getattr(self, one.name)
            least, _ = one.metadata["bounds"] or (-math.inf, math.inf)
            if name in ("protocol", "whole_ticks") or value is None:
                continue
            if not isinstance(value, int | float) or not abs(value) < 1e9:
                raise ParameterError(f"found {value}, expected a number below 1e+09", parameter=name)
            if value < least:
                raise ParameterError(f"found {value:g}, expected {least:g} or more", parameter=name)
