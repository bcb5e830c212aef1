"""What can be wrong with who ranges with whom, and how bodies move."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from calib.doctor.base import Finding, RecordingView, pair_ids
from calib.estimation.identifiability import identifiable_directions, square_of
from uwblink.recording.summary import failures_by_pair
from uwblink.twr import delay_weights

STATIC: Final = "static data"


def pairs(view: RecordingView) -> Iterator[Finding]:
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
        yield Finding(
            "too few pairs",
            f"the pairs do not determine the delays of tags {groups}",
            "record three tags that all range with each other, or pin a known delay with `fixed_ns`",
            0.99,
        )


def silent(view: RecordingView) -> Iterator[Finding]:
    """A tag whose exchanges nearly all fail, where those of others do not."""
    e = view.exchanges
    failed = failures_by_pair(view.faults)
    for tag in sorted({t.tag for t in view.tags}):
        bad = sum(n for pair, n in failed.items() if tag in pair)
        done = int(np.count_nonzero((e.initiator == tag) | (e.target == tag)))
        others = len(e) + sum(failed.values()) - bad - done
        if bad > 20 and bad > 3 * done and others:
            yield Finding(
                "dead or deaf tag",
                f"tag {tag} took part in {done} exchanges, {bad} failed",
                f"check power, antenna and USB of tag {tag}",
                0.9,
            )


def still(view: RecordingView) -> Iterator[Finding]:
    """Tags that keep their distances."""
    pair = pair_ids(view.exchanges)
    good = np.isfinite(view.truth_m)
    spans = [float(np.ptp(view.truth_m[good & (pair == p)])) for p in np.unique(pair[good])]
    if spans and max(spans) < 0.1:
        yield Finding(
            STATIC,
            f"no distance changes by more than {100 * max(spans):.0f} cm",
            "move the tags while recording, so that powers and reflections vary",
            0.9,
        )


def no_truth(view: RecordingView) -> Iterator[Finding]:
    """Exchanges without a true distance."""
    known = float(np.mean(np.isfinite(view.truth_m)))
    if known < 0.5 and not view.standing:
        yield Finding(
            "no true distances",
            f"{100 * known:.0f} % of the exchanges have one: poses are missing or do not cover the recording",
            "add motion capture with uwblink poses, or measured distances in gt_range_m; without any, survey boards "
            "that stood still, and fit moving ones with the truth from ranges",
            0.95,
        )
