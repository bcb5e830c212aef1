"""The rows of docs/accuracy.md on responses: what tells a detour, in simulated rooms and in a real flight."""

from __future__ import annotations

import numpy as np
from sklearn.metrics import roc_auc_score

from benchmarks.fidelity_errors import DATA, PREDICTED, TUNED, Row
from benchmarks.nlos import DETOUR_M, HELD_OUT, TRAINING, auc, classifier, of_real_flight, of_rooms
from uwblink.arrays import Bools, Floats


def detour_rows() -> list[Row]:
    """Return what responses tell of detours: in simulated rooms of the geometric channel, and in the real flight."""
    model = classifier().fit(*of_rooms(TRAINING))
    rooms, late = of_rooms(HELD_OUT)
    real, residual = of_real_flight(DATA)
    beyond = residual > DETOUR_M

    def told(found: Floats, column: int, digits: int) -> str:
        return ", ".join(f"{v:.{digits}f}" for v in np.quantile(found[:, column], (0.05, 0.25, 0.5, 0.75, 0.95)))

    def alone(found: Floats, detours: Bools) -> str:
        return ", ".join(f"{roc_auc_score(detours, found[:, column]):.2f}" for column in range(2))

    both = "the MILUV flight among obstacles; rooms of the geometric channel"
    return [
        (
            f"total less first-path power of responses (dB), five quantiles: {both}",
            told(real, 0, 1),
            told(rooms, 0, 1),
            TUNED,
        ),
        ("rise time of their first paths (taps), the same", told(real, 1, 0), told(rooms, 1, 0), PREDICTED),
        (
            "their ranges more than 30 cm too long",
            f"{np.sum(beyond)} of {len(beyond)}",
            f"{100 * late.mean():.0f} %",
            PREDICTED,
        ),
        (
            "AUC for these of a logistic regression on both, trained in other simulated rooms",
            f"{auc(model, real, beyond):.2f}",
            f"{auc(model, rooms, late):.2f}",
            PREDICTED,
        ),
        ("AUC of each alone", alone(real, beyond), alone(rooms, late), PREDICTED),
    ]
