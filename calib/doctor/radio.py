"""Powers that say nothing beside distances."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from calib.calibration.power_curves import ALPHA_DBM, lifted_power
from calib.doctor.base import Finding, RecordingView
from calib.estimation.confounding import explained_by_distance

CONFOUNDED: Final = "power confounded with distance"


def confounded(view: RecordingView) -> Iterator[Finding]:
    """Power that is a function of distance and nothing else lets the curve learn distance."""
    e = view.exchanges
    lifted = lifted_power(e.fpp1_dbm, e.fpp2_dbm, "mean-of-lifted", ALPHA_DBM)
    share = explained_by_distance(lifted, view.truth_m)
    if share is not None:
        yield Finding(
            CONFOUNDED,
            f"distance explains {100 * share:.0f} % of the power's variance",
            "turn the antennas while recording; until then the curve may hold what belongs to distance, and "
            "`delays_only` fits none",
            0.8,
        )
