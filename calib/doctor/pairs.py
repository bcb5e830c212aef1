"""What can be wrong with who ranges with whom, and how bodies move."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.doctor.base import RecordingView, pair_ids
from calib.doctor.checks import Seen, more_often
from calib.estimator.identifiability import identifiable_directions, square_of
from uwblink.recording.summary import failures_by_pair
from uwblink.twr import delay_weights

STATIC: Final = "static data"
STILL_M: Final = 0.1
"""Distances that change by less are one distance: two wavelengths, over which power hardly varies."""

MOSTLY: Final = 0.5
"""A tag that answers half of the time is at the edge of its range, and no worse."""


def pairs(view: RecordingView) -> Iterator[Seen]:
    """Pairs that leave antenna delays undetermined."""
    e = view.exchanges
    with np.errstate(all="ignore"):
        first, second = delay_weights(e)
    good = np.isfinite(first) & np.isfinite(second)
    if not good.any():
        return
    tags = sorted({*e.initiator[good].tolist(), *e.target[good].tolist()})
    square, ends = square_of(tags, e.initiator[good], e.target[good], first[good], second[good])
    _, free = identifiable_directions(square, tags, ends)
    if free:
        groups = "; ".join(", ".join(map(str, group)) for group in free)
        yield Seen("too few pairs", f"the pairs do not determine the delays of tags {groups}")


def silent(view: RecordingView) -> Iterator[Seen]:
    """A tag whose exchanges nearly all fail, where those of others do not."""
    e = view.exchanges
    failed = failures_by_pair(view.faults)
    tags = sorted({t.tag for t in view.tags})
    for tag in sorted(tags, key=lambda tag: -sum(n for pair, n in failed.items() if tag in pair)):
        bad = sum(n for pair, n in failed.items() if tag in pair)
        done = int(np.count_nonzero((e.initiator == tag) | (e.target == tag)))
        # What fails with a dead tag is no fault of the other one.
        failed = {pair: n for pair, n in failed.items() if tag not in pair or bad <= done}
        others, others_bad = len(e) - done, sum(n for pair, n in failed.items() if tag not in pair)
        if others + others_bad:
            usual = max(MOSTLY, others_bad / (others + others_bad))
            p_value = more_often(bad, bad + done, usual, tried=len(tags))
            told = f"tag {tag} took part in {done} exchanges, {bad} failed"
            yield Seen("dead or deaf tag", told, p_value, {"tag": tag})


def standing_still(view: RecordingView) -> float | None:
    """Return the largest change of a pair's distance, metres, where none changes by more than `STILL_M`, else None."""
    pair = pair_ids(view.exchanges)
    good = np.isfinite(view.truth_m)
    spans = [float(np.ptp(view.truth_m[good & (pair == p)])) for p in np.unique(pair[good])]
    return max(spans) if spans and max(spans) < STILL_M else None


def still(view: RecordingView) -> Iterator[Seen]:
    """Tags that keep their distances."""
    span = standing_still(view)
    if span is not None:
        yield Seen(STATIC, f"no distance changes by more than {100 * span:.0f} cm")


def no_truth(view: RecordingView) -> Iterator[Seen]:
    """Exchanges without a true distance."""
    known = float(np.mean(np.isfinite(view.truth_m)))
    if known < 0.5 and not view.standing:
        yield Seen(
            "no true distances",
            f"{100 * known:.0f} % of the exchanges have one: poses are missing or do not cover the recording",
        )
