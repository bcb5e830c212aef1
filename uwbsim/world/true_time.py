"""True time: an integer count of sub-ticks, 1024 to a device tick (15.3 fs, 4.6 um of flight)."""

from __future__ import annotations

from typing import Final

from uwblink.ticks import TICKS_PER_SECOND

SUBTICKS: Final = 1024
SUBTICKS_PER_SECOND: Final = SUBTICKS * TICKS_PER_SECOND
