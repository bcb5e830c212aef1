"""What changed between recordings of the same boards: anchors that were moved, delays that became others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, Final

import numpy as np

from calib.checks.geometry import Displaced, displaced, place_m, standing
from calib.checks.levels import DOF, OF_MEDIAN, levels, variance_of_sum
from calib.checks.recording_view import RecordingView
from calib.checks.steps import AGREE, FEWEST_OTHERS, FEWEST_PAIRS, LARGEST_M, TOLERANCE_M
from calib.findings import Candidate, exceeds
from uwblink.arrays import Floats
from uwblink.ticks import SPEED_OF_LIGHT

MOVED_ANCHOR: Final = "anchor moved between recordings"
OTHER_DELAY: Final = "delay changed between recordings"
APART_M: Final = 0.08
FEWEST_COMMON: Final = 3


def compared(views: Sequence[RecordingView], level: float) -> Iterator[Candidate]:
    """Yield what differs between recordings, each compared with the one before it; `level` is that of a check."""
    moved = {view.name: {one.body: one for one in displaced(view) if one.p_value < level} for view in views}
    for first, second in pairwise(views):
        bodies = _moved(first, second, moved)
        for body, (away, p_value) in bodies.items():
            yield Candidate(
                MOVED_ANCHOR,
                f"{body} stands {np.linalg.norm(away):.2f} m elsewhere ({away[0]:+.2f} {away[1]:+.2f} {away[2]:+.2f} m"
                f") in {second.name} than in {first.name}, by its ranges and the places that the recordings give it",
                p_value,
                {"body": body},
            )
        known = {*bodies, *moved[first.name], *moved[second.name]}
        tags = {tag.tag for view in (first, second) for tag in view.tags if tag.body in known}
        yield from _other_delays(first, second, tags)


def _moved(
    first: RecordingView, second: RecordingView, moved: dict[str, dict[str, Displaced]]
) -> dict[str, tuple[Floats, float]]:
    """Return the anchors of both recordings whose places differ, by how much, and the p-value."""
    found = {}
    for body in sorted(set(standing(first)) & set(standing(second))):
        places = [
            place_m(view, body) + (moved[view.name][body].away_m if body in moved[view.name] else np.zeros(3))
            for view in (first, second)
        ]
        known = [moved[view.name][body].p_value for view in (first, second) if body in moved[view.name]]
        if known and np.linalg.norm(places[1] - places[0]) > APART_M:
            found[body] = places[1] - places[0], min(known)
    return found


def _other_delays(first: RecordingView, second: RecordingView, but: set[int]) -> Iterator[Candidate]:
    """Yield tags all of whose pairs read otherwise, beside what all tags of both recordings share."""
    change = _changes(first, second)
    tags = sorted({tag for ends in change for tag in ends} - but)
    if len(tags) < FEWEST_COMMON:
        return
    while len(tags) >= FEWEST_COMMON:
        known = {ends: value for ends, value in change.items() if set(ends) <= set(tags)}
        sizes = {tag: _of_tag(tag, known) for tag in tags}
        sure = {tag: found for tag, found in sizes.items() if found is not None and found[1] < 1}
        if not sure:
            return
        tag = min(sure, key=lambda t: (sure[t][1], -abs(sure[t][0])))
        size, p_value = sure[tag]
        alike = "all its pairs alike" if sum(tag in ends for ends in known) > 1 else "its only pair"
        yield Candidate(
            OTHER_DELAY,
            f"ranges of tag {tag} are {100 * size:+.1f} cm longer in {second.name} than in {first.name} "
            f"({2e9 * abs(size) / SPEED_OF_LIGHT:.2f} ns in its delay), {alike}, others are not",
            p_value,
            {"tag": tag},
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
        level = [np.median(known.rest[part]) for part in parts]
        variance = sum(
            OF_MEDIAN * variance_of_sum(known.clipped[part], known.time_s[part]) / np.count_nonzero(part)
            for part in parts
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
    """Return a tag's own change and its p-value, None where its or other pairs say otherwise."""
    mine = np.array([value for ends, value in change.items() if tag in ends])
    rest = np.array([value for ends, value in change.items() if tag not in ends])
    if len(mine) < FEWEST_PAIRS and not (len(mine) and len(rest) >= FEWEST_OTHERS):
        return None
    if not len(rest):
        return None
    base = float(np.median(rest[:, 0]))
    weight = 1 / mine[:, 1]
    size = float(np.average(mine[:, 0], weights=weight)) - base
    alike = np.all(np.abs(mine[:, 0] - base - size) < AGREE * abs(size))
    quiet = abs(float(np.median(np.abs(rest[:, 0] - base)))) < AGREE * abs(size)
    if abs(size) > LARGEST_M or not (alike and quiet):
        return None
    # Either recording has a variance of its own; every tag was tried.
    tried = len({tag for ends in change for tag in ends})
    std = float(1 / np.sqrt(weight.sum()))
    return size, exceeds(size, std, 2 * DOF * len(mine), tolerance=TOLERANCE_M, tried=tried)
