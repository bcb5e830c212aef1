"""The protocols by name: the project's own, those registered by a program, and those of other distributions."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from uwblink.errors import ArgumentError
from uwblink.plugins import NAME, Registry
from uwblink.protocols import formulas
from uwblink.protocols.checks import check_formulas, check_messages
from uwblink.protocols.rows import ProtocolMessage, RangingProtocol

_POLL = ProtocolMessage("initiator", "", "at once")

_OWN: Final = (
    RangingProtocol(
        "ss",
        "SS-TWR",
        (_POLL, ProtocolMessage("target", "rx1", "scheduled")),
        formulas.single_sided,
        formulas.half_delays,
    ),
    RangingProtocol(
        "ss-cfo",
        "SS-TWR, corrected with the carrier integrator",
        (_POLL, ProtocolMessage("target", "rx1", "scheduled")),
        formulas.carrier_corrected,
        formulas.carrier_delays,
    ),
    RangingProtocol(
        "ds",
        "DS-TWR, third message from the target",
        (_POLL, ProtocolMessage("target", "rx1", "at once"), ProtocolMessage("target", "tx2", "scheduled")),
        formulas.double_sided,
        formulas.double_sided_delays,
    ),
    RangingProtocol(
        "ds-alt",
        "DS-TWR, third message from the initiator",
        (_POLL, ProtocolMessage("target", "rx1", "at once"), ProtocolMessage("initiator", "rx2", "scheduled")),
        formulas.alternative,
        formulas.alternative_delays,
    ),
    RangingProtocol(
        "ds-sym",
        "DS-TWR, third message from the initiator, equal replies",
        (_POLL, ProtocolMessage("target", "rx1", "scheduled"), ProtocolMessage("initiator", "rx2", "scheduled")),
        formulas.alternative,
        formulas.alternative_delays,
    ),
)

ON_BOARDS: Final = ("ss", "ds")
"""The protocols that the boards' firmware executes."""


def check_protocol(row: RangingProtocol) -> None:
    """Raise `ArgumentError` for a protocol that cannot be simulated, recorded and calibrated; says what is wrong.

    Its messages are two or three, of the order that the stamps of a recording have; and its formulas, tried on two
    exchanges without noise or skew, find the time of flight exactly, and take an antenna delay on either side out.
    """
    if not isinstance(row, RangingProtocol):
        raise ArgumentError(f"protocol: found {row!r:.60}, expected a RangingProtocol")
    if not isinstance(row.name, str) or not NAME.fullmatch(row.name):
        raise ArgumentError(f"protocol: name: found {row.name!r:.60}, expected a word such as 'ds-alt'")
    if not isinstance(row.title, str) or not row.title:
        raise ArgumentError(f"protocol {row.name!r}: title: found {row.title!r:.60}, expected what pages call it")
    if not isinstance(row.messages, tuple) or not all(isinstance(m, ProtocolMessage) for m in row.messages):
        raise ArgumentError(
            f"protocol {row.name!r}: messages: found {row.messages!r:.60}, expected a tuple of ProtocolMessage"
        )
    check_messages(row)
    check_formulas(row)


PROTOCOLS: Final[Registry[RangingProtocol]] = Registry("protocol", "uwbcal.protocols", _OWN, check_protocol)
"""Protocols by name: the project's, those of `register_protocol`, and those of installed distributions."""


def register_protocol(row: RangingProtocol, *, replace: bool = False) -> None:
    """Add a protocol to `PROTOCOLS`: simulation, recording, calibration and comparison then know it by its name.

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


def third_from_target(names: Iterable[str]) -> list[str]:
    """Return those of some protocols whose third message the target sends.

    Others of other distributions are looked for only where one of the names is not known so far.
    """
    return [name for name in names if name in PROTOCOLS and PROTOCOLS[name].third_sender == "target"]
