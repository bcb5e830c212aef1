"""The rows of docs/accuracy.md on impulse responses: detection of detours, in simulated rooms and in a real flight."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.fidelity_errors import PREDICTED, TUNED, Row
from benchmarks.nlos import DETOUR_M, RESPONSE, RISE, ROOMS, SHARED, of_real_flight, of_room, published_error_m


def detour_rows() -> list[Row]:
    """Return how well impulse responses indicate detours: in simulated rooms of the geometric channel, and in a real
    flight.
    """
    rooms = [of_room(seed) for seed in ROOMS[:12]]
    late = np.concatenate([one.raw_m - one.truth_m for one in rooms]) > DETOUR_M
    simulated = np.concatenate([one.features for one in rooms])
    flight = of_real_flight(SHARED)
    real, known = flight.features, np.isfinite(flight.features[:, RISE])
    beyond = published_error_m(flight, SHARED) > DETOUR_M

    def told(found: NDArray[np.floating], column: int, digits: int) -> str:
        return ", ".join(f"{v:.{digits}f}" for v in np.nanquantile(found[:, column], (0.05, 0.25, 0.5, 0.75, 0.95)))

    both = "the MILUV flight among obstacles; rooms of the geometric channel"
    return [
        (
            f"total less first-path power of responses (dB), five quantiles: {both}",
            told(real, RESPONSE, 1),
            told(simulated, RESPONSE, 1),
            TUNED,
        ),
        (
            "rise time of their first paths (taps), the same",
            told(real, RISE, 1),
            told(simulated, RISE, 1),
            PREDICTED,
        ),
        (
            "their ranges more than 30 cm too long",
            f"{np.sum(beyond[known])} of {np.sum(known)}",
            f"{100 * late.mean():.0f} %",
            PREDICTED,
        ),
    ]
