"""Device time of the DW1000: ticks, wrap-around, and the speed of light that goes with them.

A tick is 1/(128 x 499.2 MHz) = 15.65 ps (DW1000 User Manual 2.10, section 7.2.8). The chip counts
40 bits (17.2 s); the boards print the low 32 bits (67.2 ms).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from uwblink.arrays import Ints

TICKS_PER_SECOND: Final = 128 * 499_200_000
TICK_S: Final = 1.0 / TICKS_PER_SECOND
"""Stamps count 128ths of a chip at 499.2 MHz (DW1000 User Manual 2.10, section 7.2.8)."""

SPEED_OF_LIGHT: Final = 299_702_547.0
"""Metres per second in air, the constant of the boards' firmware."""

METRES_PER_TICK: Final = TICK_S * SPEED_OF_LIGHT

COUNTER_BITS: Final = 40
REPORT_BITS: Final = 32
"""Of the chip's stamps, and of those that boards print (firmware wire format, 1.2)."""

ANTENNA_DELAY_TICKS: Final = 16_436
"""Transmit and receive antenna delay configured on every board (firmware wire format, 2.2)."""

TX_SHARE: Final = 0.44
"""Share of an aggregate antenna delay that is the transmitter's; the receiver has the rest (Decawave APS014, section 2;
the code of the ICRA 2023 authors)."""

DELAYED_TX_GRID: Final = 512
"""A delayed transmission starts on a multiple of this many raw ticks (User Manual, section 3.3)."""

UUS_TICKS: Final = 65_536
"""Ticks in one UWB microsecond (512/499.2 us), the unit of the boards' response delay."""


def elapsed(later: ArrayLike, earlier: ArrayLike, bits: int = REPORT_BITS) -> Ints:
    """Ticks from `earlier` to `later` on one counter of `bits` bits, in [0, 2**bits).

    The only place where stamps are subtracted: correct as long as less than one wrap lies between.
    """
    difference = np.asarray(later, dtype=np.int64) - np.asarray(earlier, dtype=np.int64)
    return np.asarray(difference & np.int64((1 << bits) - 1), dtype=np.int64)
