"""What can be wrong with poses and lever arms: each suspicion is tried by undoing it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from typing import Final

import numpy as np

from calib.doctor.base import Finding, RecordingView, spread_m
from uwblink.errors import ImportTableError
from uwblink.recording.distances import distances_m
from uwblink.recording.schema import Poses, Tag
from uwblink.recording.time_offset import find_offset

MUCH_BETTER: Final = 0.6
"""A suspected fault was there when undoing it shrinks the spread below this share of what it was."""
LARGEST_OFFSET_S: Final = 3.0


def pose_clock(view: RecordingView) -> Iterator[Finding]:
    """Poses whose clock is off by up to a few seconds."""
    if not len(view.poses):
        return
    try:
        found = find_offset(view.exchanges, view.poses, view.tags, within_s=LARGEST_OFFSET_S)
    except ImportTableError:
        return
    shift_s = found.offset_ns * 1e-9
    moved = distances_m(
        view.poses, view.tags, view.exchanges.initiator, view.exchanges.target,
        view.exchanges.time_ns - found.offset_ns,
    )  # fmt: skip
    before, after = spread_m(view), spread_m(view, moved)
    if abs(shift_s) > 0.03 and after < 0.9 * before:
        yield Finding(
            "pose time offset",
            f"with the poses {shift_s:+.3f} s later the ranges' spread is {100 * after:.1f} cm instead of "
            f"{100 * before:.1f} cm",
            f"shift the poses: uwblink poses ... --offset {shift_s:.3f}",
            0.9,
        )


def _trials(view: RecordingView) -> Iterator[tuple[Finding, Poses, list[Tag]]]:
    """Suspected faults of geometry, each with poses and tags as they would be without it."""
    bodies = sorted({tag.body for tag in view.tags})
    for body in bodies:
        mine = [tag for tag in view.tags if tag.body == body]
        if any(any(tag.lever_arm_m) for tag in mine):
            turned = [
                replace(t, lever_arm_m=(-t.lever_arm_m[0], -t.lever_arm_m[1], -t.lever_arm_m[2])) if t in mine else t
                for t in view.tags
            ]
            yield (
                Finding("lever arm sign", f"of body {body}", f"change the sign of the lever arms of body {body}", 0.85),
                view.poses,
                turned,
            )
        for a, b in combinations(mine, 2):
            arms = {a.tag: b.lever_arm_m, b.tag: a.lever_arm_m}
            swapped = [replace(t, lever_arm_m=arms.get(t.tag, t.lever_arm_m)) for t in view.tags]
            yield (
                Finding("swapped tag ids", f"of tags {a.tag} and {b.tag}", f"exchange tags {a.tag} and {b.tag}", 0.85),
                view.poses,
                swapped,
            )
    q = view.poses.quaternion
    if len(q):
        yield (
            Finding("wxyz quaternion", "of the poses", "quaternions are w x y z: reorder the columns to x y z w", 0.9),
            replace(view.poses, quaternion=q[:, [1, 2, 3, 0]]),
            view.tags,
        )


def geometry(view: RecordingView) -> Iterator[Finding]:
    """Try every suspected fault of geometry; of those that explain the ranges, the one that does so best."""
    if not len(view.poses) or np.isfinite(view.exchanges.truth_m).any():
        return
    e = view.exchanges
    before = spread_m(view)
    best: tuple[float, Finding] | None = None
    for finding, poses, tags in _trials(view):
        after = spread_m(view, distances_m(poses, tags, e.initiator, e.target, e.time_ns))
        # One body of several, or one pair of tags, is a share of all ranges: compare what it can change.
        if after < _needed(finding.fault) * before and (best is None or after < best[0]):
            best = after, finding
    if best:
        after, finding = best
        evidence = (
            f"{finding.evidence}: undone, the ranges' spread is {100 * after:.1f} cm instead of {100 * before:.1f} cm"
        )
        yield replace(finding, evidence=evidence)


def _needed(fault: str) -> float:
    return 0.85 if fault in ("lever arm sign", "swapped tag ids") else MUCH_BETTER
