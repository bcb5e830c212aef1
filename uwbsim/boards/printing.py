"""How the boards print a number: four decimals, cut toward zero, with whatever their processor makes of the rest."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from uwblink.wire.fields import write_printed

LARGEST: Final = 2**31 - 1


def printed_float(value: float) -> bytes:
    """Return a four-byte float as the boards print it.

    They print its whole part as a 32-bit integer and four decimals beside it. A Cortex-M4 turns what does not fit
    into the nearest integer that does, and what is no number into 0; the fraction of such a value is 0.
    """
    single = float(np.float32(value)) if math.isfinite(value) else value
    if math.isnan(single):
        return b"0.0000"
    if abs(single) > LARGEST:
        return b"%d.0000" % (LARGEST if single > 0 else -LARGEST - 1)
    return write_printed(single)
