"""What a ranging protocol is: its messages and its formulas, in one row."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from uwblink.arrays import Floats
from uwblink.protocols.formulas import Intervals

Role = Literal["initiator", "target"]


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
