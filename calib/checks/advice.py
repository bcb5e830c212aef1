"""Advice that was tried on the data it is given for."""

from __future__ import annotations

from typing import Final

import numpy as np

from calib.checks.recording_view import RecordingView
from calib.data.ranges import Ranges
from calib.errors import CalibError
from calib.estimator.known_distances import Recipe, fit_known_distances

CLEARLY: Final = 0.6
"""One loss is recommended over another when its halves disagree by no more than this share of the other's."""

MOST: Final = 12_000
"""Ranges that are fitted for a trial."""

FEWEST: Final = 1000
LOSSES: Final = ("mixture", "cauchy")


def advice_on_loss(view: RecordingView) -> str:
    """Return the loss under which two halves of these ranges agree better on the delays, as the end of a sentence.

    Says nothing where the ranges cannot be fitted, or the losses do alike.
    """
    apart = {loss: _halves_disagree_ps(view, loss) for loss in LOSSES}
    known = {loss: value for loss, value in apart.items() if value is not None}
    if len(known) < len(LOSSES):
        return ""
    best, other = sorted(known, key=lambda loss: known[loss])
    said = (
        f"tried: delays of odd and even stretches differ by {known[best]:.0f} ps with {best}, {known[other]:.0f} with "
        f"{other}"
    )
    if known[best] > CLEARLY * known[other]:
        return f" ({said}: no loss is better here)"
    return f"; fit with `loss` {best} ({said})"


def _halves_disagree_ps(view: RecordingView, loss: str) -> float | None:
    """Return by how much delays of alternating stretches of time differ, rms less what they share; None: no fit."""
    if len(view.exchanges) < FEWEST:
        return None
    e = view.exchanges
    ranges = Ranges.from_exchanges(e, view.truth_m)
    order = np.argsort(ranges.time_ns, kind="stable")
    order = order[:: max(len(order) // MOST, 1)]
    stretch = np.arange(len(order)) * 20 // max(len(order), 1)
    found = []
    try:
        for odd in (False, True):
            half = ranges[order[(stretch % 2 == 1) == odd]].usable()
            known = fit_known_distances(half, Recipe(loss=loss, fixed_ns={}, groups={}))
            found.append(dict(zip(known.model.tags, known.delays.tolist(), strict=True)))
    except CalibError:
        return None
    apart = np.array([found[0][tag] - found[1][tag] for tag in found[0] if tag in found[1]])
    return 1e3 * float(np.std(apart)) if len(apart) > 1 else None
