"""Powers that say nothing beside distances."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.calibration.power_curves import ALPHA_DBM, lifted_power
from calib.doctor.base import Finding, RecordingView
from calib.estimation.confounding import explained_by_distance
from calib.range_columns import measured_powers

CONFOUNDED: Final = "power confounded with distance"


def unpowered(view: RecordingView) -> Iterator[Finding]:
    """Exchanges without a first-path power at either end, of which no curve can be fitted."""
    e = view.exchanges
    known = float(np.mean(np.isfinite(measured_powers(e.fpp1_dbm)) | np.isfinite(measured_powers(e.fpp2_dbm))))
    if known < 0.5:
        yield Finding(
            "no powers",
            f"{100 * known:.0f} % of the exchanges have a first-path power",
            "import powers as fpp1 and fpp2; without them only delays can be fitted, by `delays_only`",
            0.95,
        )


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
