"""What can be wrong with poses and lever arms: each suspicion is tried by undoing it.

Where poses and arms are right, undoing what was not done makes ranges agree worse with them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from typing import Final

import numpy as np

from calib.doctor.base import RecordingView, spread_m
from calib.doctor.checks import Seen, narrower
from uwblink.errors import ImportTableError
from uwblink.recording.distances import distances_m, find_offset
from uwblink.recording.schema import Poses, Tag

LARGEST_OFFSET_S: Final = 3.0
SMALLEST_OFFSET_S: Final = 0.03
"""Host times of ranges are as late as USB makes them, and poses as a camera's exposure and network."""

LONGEST_ARM_M: Final = 1.0
"""Robots that carry these boards are smaller; longer arms may be in another unit."""


def pose_clock(view: RecordingView) -> Iterator[Seen]:
    """Poses whose clock is off by up to a few seconds."""
    if not len(view.poses):
        return
    try:
        found = find_offset(view.exchanges, view.poses, view.tags, within_s=LARGEST_OFFSET_S)
    except ImportTableError:
        return
    shift_s = found.offset_ns * 1e-9
    e = view.exchanges
    moved = distances_m(view.poses, view.tags, e.initiator, e.target, e.time_ns - found.offset_ns)
    if abs(shift_s) > SMALLEST_OFFSET_S:
        p_value, gain = narrower(view, view.error_m, view.raw_m - moved)
        told = (
            f"with the poses {shift_s:+.3f} s later the ranges' spread is {100 * spread_m(view, moved):.1f} cm instead "
            f"of {100 * spread_m(view):.1f} cm"
        )
        yield Seen("pose time offset", told, p_value, {"shift": f"{shift_s:.3f}"}, gain)


def _trials(view: RecordingView) -> Iterator[tuple[Seen, Poses, list[Tag]]]:
    """Suspected faults of geometry, each with poses and tags as they would be without it."""
    bodies = sorted({tag.body for tag in view.tags})
    for body in bodies:
        mine = [tag for tag in view.tags if tag.body == body]
        if any(any(tag.lever_arm_m) for tag in mine):
            yield Seen("lever arm sign", f"of body {body}", words={"body": body}), view.poses, _scaled(view, mine, -1.0)
        if any(np.linalg.norm(tag.lever_arm_m) > LONGEST_ARM_M for tag in mine):
            for unit, length in (("mm", 0.001), ("cm", 0.01), ("in", 0.0254)):
                seen = Seen("lever arm unit", f"of body {body} in {unit}", words={"body": body, "length": length})
                yield seen, view.poses, _scaled(view, mine, length)
        for a, b in combinations(mine, 2):
            arms = {a.tag: b.lever_arm_m, b.tag: a.lever_arm_m}
            swapped = [replace(t, lever_arm_m=arms.get(t.tag, t.lever_arm_m)) for t in view.tags]
            seen = Seen("swapped tag ids", f"of tags {a.tag} and {b.tag}", words={"a": a.tag, "b": b.tag})
            yield seen, view.poses, swapped
    q = view.poses.quaternion
    if len(q):
        yield Seen("wxyz quaternion", "of the poses"), replace(view.poses, quaternion=q[:, [1, 2, 3, 0]]), view.tags


def _scaled(view: RecordingView, mine: list[Tag], factor: float) -> list[Tag]:
    """Return all tags, with the lever arms of some times a factor."""
    arms = [(t, factor if t in mine else 1.0) for t in view.tags]
    return [replace(t, lever_arm_m=(f * t.lever_arm_m[0], f * t.lever_arm_m[1], f * t.lever_arm_m[2])) for t, f in arms]


def geometry(view: RecordingView) -> Iterator[Seen]:
    """Try every suspected fault of geometry; of those that explain the ranges, the one that does so best."""
    if not view.posed:
        return
    e = view.exchanges
    before = spread_m(view)
    best: Seen | None = None
    trials = list(_trials(view))
    for seen, poses, tags in trials:
        truth = distances_m(poses, tags, e.initiator, e.target, e.time_ns)
        p_value, gain = narrower(view, view.error_m, view.raw_m - truth, tried=len(trials))
        if p_value < 1 and (best is None or gain > best.gain):
            told = (
                f"{seen.evidence}: undone, the ranges' spread is {100 * spread_m(view, truth):.1f} cm instead of "
                f"{100 * before:.1f} cm"
            )
            best = replace(seen, evidence=told, p_value=p_value, gain=gain)
    if best:
        yield best
