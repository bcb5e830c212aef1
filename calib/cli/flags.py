"""The flags that stand for parameters: errors and remedies speak of parameters, and the command line of flags."""

from __future__ import annotations

import re
from typing import Final

FLAGS: Final = {
    "fixed_ns": "--fix",
    "groups": "--group",
    "scale_ns": "--scale",
    "reference_power_dbm": "--reference-power",
}
"""Parameters whose flag is called otherwise; all others are spelt alike, with dashes."""


def with_flags(text: str) -> str:
    """Return a text with flags for the parameters in backticks: `minimum_norm` becomes --minimum-norm."""
    return re.sub(r"`([a-z_]+)`", lambda found: flag(found[1]), text)


def flag(parameter: str) -> str:
    """Return the flag of a parameter."""
    return FLAGS.get(parameter, f"--{parameter.replace('_', '-')}")
