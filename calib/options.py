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
    return one_of("--loss", text, [*LOSSES, MIXTURE])


def lift_name(text: str) -> str:
    """Return a key of `LIFTS`."""
    return one_of("--lift", text, LIFTS)


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


def fixed_ns(texts: Iterable[str]) -> dict[int, float]:
    """Return pinned delays by tag from texts TAG=NS."""
    fixed: dict[int, float] = {}
    for text in texts:
        tag, equals, value = text.partition("=")
        try:
            delay = float(value)
        except ValueError:
            delay = math.nan
        if not (equals and tag.strip().isdecimal() and math.isfinite(delay)):
            raise BadInputError(f"--fix: found {text!r}, expected TAG=NS, as in 1=-0.36")
        if int(tag) in fixed:
            raise BadInputError(f"--fix: tag {int(tag)} is pinned twice")
        fixed[int(tag)] = delay
    return fixed


def one_of(option: str, text: str, allowed: Iterable[str]) -> str:
    """Return a word that is allowed; raises `BadInputError` that lists what is."""
    if text not in allowed:
        raise BadInputError(f"{option}: found {text!r}, allowed: {', '.join(allowed)}")
    return text
