"""What survey and plan share: units, how far delays are known without data, and how wide few data make intervals."""

from __future__ import annotations

from typing import Final

from calib.spread import TWO_SIDED_95
from calib.surveys.adjustment import PAIR_WORTH
from uwblink.ticks import SPEED_OF_LIGHT

DELAY_SCALE_NS: Final = 0.5
"""How far a delay is known without any data: devices of one design differ by that."""

M_PER_NS: Final = SPEED_OF_LIGHT * 1e-9


def widened(freedom: float) -> float:
    """Return by how much Student's 95 % quantile is more than the normal one: the spread of errors is estimated.

    What is known of that spread beforehand counts as a few degrees of freedom.
    """
    from scipy.special import stdtrit

    return float(stdtrit(max(freedom + PAIR_WORTH, 1.0), 0.975)) / TWO_SIDED_95
