"""Checks the words and numbers of the command line before anything is read."""

from __future__ import annotations

import math
from collections.abc import Iterable

from calib.delays import LOSSES
from calib.errors import BadInputError
from calib.fit import MIXTURE
from calib.power import LIFTS


def loss_name(text: str) -> str:
    """Return a key of `LOSSES`, or the mixture."""
    return _one_of("--loss", text, [*LOSSES, MIXTURE])


def lift_name(text: str) -> str:
    """Return a key of `LIFTS`."""
    return _one_of("--lift", text, LIFTS)


def scale_ns(text: str) -> float | None:
    """Return the scale in nanoseconds, None for auto."""
    if text == "auto":
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise BadInputError(f"--scale: found {text!r}, expected auto or a positive number of ns")
    return value


def _one_of(option: str, text: str, allowed: Iterable[str]) -> str:
    if text not in allowed:
        raise BadInputError(f"{option}: found {text!r}, allowed: {', '.join(allowed)}")
    return text
