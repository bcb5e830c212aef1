"""Inertial readings of a body, summed over short windows in the world's axes by its given attitudes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from uwblink.arrays import Floats

GRAVITY_M_S2: Final = 9.81


@dataclass(frozen=True, slots=True, kw_only=True)
class Inertial:
    """Windows of an accelerometer: they begin and end at `begin_s` and `end_s` (k,).

    `force_m_s2` (k, 3) is the mean specific force in the world's axes by the given attitudes, `turn` (k, 3, 3) their
    mean; `std_m_s2` is the noise of a mean. The gyroscope is in the attitudes: `drift` (j, 3, 3) is the integral of
    attitudes between the instants `drift_s` (j + 1,), by which a bias of it turns them.
    """

    begin_s: Floats
    end_s: Floats
    force_m_s2: Floats
    turn: Floats
    std_m_s2: float
