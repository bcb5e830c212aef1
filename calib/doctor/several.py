"""What changed between recordings of the same boards: anchors that were moved, delays that became others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Final

import numpy as np

from calib.doctor.anchors import displaced, standing
from calib.doctor.base import Finding, RecordingView
from calib.doctor.levels import levels, medians, variance_of_sum
from calib.doctor.steps import AGREE, FEWEST_PAIRS, LARGEST_M, SURELY
from uwblink.arrays import Floats
from uwblink.ticks import SPEED_OF_LIGHT

MOVED_ANCHOR: Final = "anchor moved between recordings"
OTHER_DELAY: Final = "delay changed between recordings"
APART_M: Final = 0.08
SMALLEST_M: Final = 0.04
FEWEST_COMMON: Final = 3


def compared(views: Sequence[RecordingView]) -> Iterator[Finding]:
    """Yield what differs between recordings, each compared with the one before it."""
    moved = {view.name: {one.body: one.away_m for one in displaced(view)} for view in views}
    for first, second in pairwise(views):
        bodies = _moved(first, second, moved)
        for body, away in bodies.items():
            yield Finding(
                MOVED_ANCHOR,
                f"{body} stands {np.linalg.norm(away):.2f} m elsewhere ({away[0]:+.2f} {away[1]:+.2f} {away[2]:+.2f} m"
                f") in {second.name} than in {first.name}, by its ranges and the places that the recordings give it",
                f"measure the place of {body} anew, and fit recordings apart until then",
                0.85,
            )
        known = {*bodies, *moved[first.name], *moved[second.name]}
        tags = {tag.tag for view in (first, second) for tag in view.tags if tag.body in known}
        yield from _other_delays(first, second, tags)


def _moved(first: RecordingView, second: RecordingView, moved: dict[str, dict[str, Floats]]) -> dict[str, Floats]:
    """Return the anchors of both recordings whose places differ, by how much."""
    found = {}
    for body in sorted(set(standing(first)) & set(standing(second))):
        places = [
            np.median(view.poses.position_m[view.poses.body == body], axis=0) + moved[view.name].get(body, np.zeros(3))
            for view in (first, second)
        ]
        if np.linalg.norm(places[1] - places[0]) > APART_M and any(body in moved[v.name] for v in (first, second)):
            found[body] = places[1] - places[0]
    return found


def _other_delays(first: RecordingView, second: RecordingView, but: set[int]) -> Iterator[Finding]:
    """Yield tags all of whose pairs read otherwise, beside what all tags of both recordings share."""
    change = _changes(first, second)
    tags = sorted({tag for ends in change for tag in ends} - but)
    if len(tags) < FEWEST_COMMON:
        return
    while len(tags) >= FEWEST_COMMON:
        known = {ends: value for ends, value in change.items() if set(ends) <= set(tags)}
        sizes = {tag: _of_tag(tag, known) for tag in tags}
        sure = {tag: found for tag, found in sizes.items() if found is not None}
        if not sure:
            return
        tag = max(sure, key=lambda t: abs(sure[t][1]))
        size, _ = sure[tag]
        yield Finding(
            OTHER_DELAY,
            f"ranges of tag {tag} are {100 * size:+.1f} cm longer in {second.name} than in {first.name} "
            f"({2e9 * abs(size) / SPEED_OF_LIGHT:.2f} ns in its delay), all its pairs alike, others are not",
            f"was the antenna of tag {tag} touched, or its board replaced? calibrate the recordings apart",
            0.8,
        )
        tags.remove(tag)


def _changes(first: RecordingView, second: RecordingView) -> dict[tuple[int, int], tuple[float, float]]:
    """Return by how much the level of each common pair changed, and its variance, the same power taken off in both."""
    both = _joined(first, second)
    known = levels(both)
    if known is None:
        return {}
    late = known.rows >= len(first.exchanges)
    found = {}
    for pair, ends in enumerate(known.ends.tolist()):
        parts = [known.pair == pair, known.pair == pair]
        parts = [parts[0] & ~late, parts[1] & late]
        if min(np.count_nonzero(part) for part in parts) < 20:
            continue
        level = [medians(known.rest[part], np.zeros(np.count_nonzero(part), np.int64), 1)[0] for part in parts]
        variance = sum(
            1.6 * variance_of_sum(known.clipped[part], known.time_s[part]) / np.count_nonzero(part) for part in parts
        )
        found[ends[0], ends[1]] = (float(level[1] - level[0]), float(variance))
    return found


def _joined(first: RecordingView, second: RecordingView) -> RecordingView:
    """Return the exchanges of both as one recording, the second after the first."""
    a, b = first.exchanges, second.exchanges
    later = int(a.time_ns.max() - b.time_ns.min()) + 1_000_000_000
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(a, name), getattr(b, name) + (later if name == "time_ns" else 0)])
        for name in ("time_ns", "initiator", "target", "fpp1_dbm", "fpp2_dbm")
    }
    size = len(a) + len(b)
    whole = replace(a[np.zeros(size, dtype=np.int64)], **columns)
    return replace(
        first,
        exchanges=whole,
        raw_m=np.concatenate([first.raw_m, second.raw_m]),
        truth_m=np.concatenate([first.truth_m, second.truth_m]),
    )


def _of_tag(tag: int, change: dict[tuple[int, int], tuple[float, float]]) -> tuple[float, float] | None:
    """Return a tag's own change and how many standard errors it is, None where its or other pairs say otherwise."""
    mine = np.array([value for ends, value in change.items() if tag in ends])
    rest = np.array([value for ends, value in change.items() if tag not in ends])
    if len(mine) < FEWEST_PAIRS or not len(rest):
        return None
    base = float(np.median(rest[:, 0]))
    weight = 1 / mine[:, 1]
    size = float(np.average(mine[:, 0], weights=weight)) - base
    sure = size * float(np.sqrt(weight.sum()))
    alike = np.all(np.abs(mine[:, 0] - base - size) < AGREE * abs(size))
    quiet = abs(float(np.median(np.abs(rest[:, 0] - base)))) < AGREE * abs(size)
    if abs(sure) < SURELY or not SMALLEST_M < abs(size) < LARGEST_M or not (alike and quiet):
        return None
    return size, sure
