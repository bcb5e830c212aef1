"""Names the fault in a recording, with the evidence and the remedy.

Each examination looks for one fault. Those that suspect the truth (poses, lever arms, ids, clocks) work by trial: they
undo the suspected fault, and if the ranges then agree much better with the distances, it was there. The unit of
agreement is the robust spread of errors after each pair's own median, which neither delays nor a few outliers move.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from calib.doctor import (
    anchors,
    clocks,
    closures,
    geometry,
    pairs,
    protocols,
    radio,
    reflected,
    several,
    steps,
    surveys,
    timestamps,
)
from calib.doctor.base import Finding, RecordingView, chosen
from calib.doctor.long_recordings import Looked, looked_at
from calib.sources import Data, each, opened
from uwblink.recording.distances import distances_m
from uwblink.recording.target_reports import differences, single_reports
from uwblink.twr import raw_range


def examine(data: Data | Iterable[Data]) -> list[Finding]:
    """Return what is wrong with a recording, the surest first: each fault with its evidence and what to do about it.

    `data` is the path of a recording, an open `Recording`, or anything with `exchanges`, `poses` and `tags`, or several
    of those, which are then compared, too; ranges alone do not say enough. Recordings of arrangements without poses are
    surveyed, all together. Rows that cannot be are set aside before anything else is judged, and what would only follow
    from a graver fault is not looked for. Of a recording with more than 160,000 exchanges about so many are looked at,
    in 40 stretches over all of its time. Raises what
    `Recording.open` raises.

    >>> import calib
    >>> [finding.fault for finding in calib.examine(calib.sample_flight())]
    []
    """
    views, findings = [], list[Finding]()
    recordings = each(data)
    for number, one in enumerate(recordings):
        found, view = _examined(one)
        name = f"{view.name if view else number + 1}: " if len(recordings) > 1 else ""
        findings += [replace(finding, evidence=name + finding.evidence) for finding in found]
        if view is not None and not {finding.fault for finding in found} & GROSS_FAULTS:
            views.append(view)
    if len(views) > 1:
        between = list(several.compared(views))
        # What moved between two recordings is no fault of either one.
        moved = any(finding.fault == several.MOVED_ANCHOR for finding in between)
        findings = [one for one in findings if not (moved and one.fault == anchors.ELSEWHERE)] + between
    if views and len(views) == len(recordings) and all(view.standing for view in views):
        findings += surveys.surveyed(recordings)
    return sorted(findings, key=lambda f: -f.confidence)


def _examined(data: Data) -> tuple[list[Finding], RecordingView | None]:
    """Return what is wrong with one recording, and the recording without its impossible rows."""
    with opened(data) as (name, source):
        looked = looked_at(source)
        marked = tuple(getattr(source, "arrangements", ()))
    if not looked.count:
        return [Finding("empty", "the recording holds no exchanges", "record or import some", 1.0)], None
    view = replace(_admitted(name, looked), arrangements=marked)
    findings: list[Finding] = []
    for examination in GROSS:
        findings += examination(view)
        if findings:
            return findings, None
    bad = timestamps.impossible(view)
    findings += timestamps.corrupted(view, bad)
    if bad.all():
        return [*findings, *timestamps.with_itself(view)], None
    whole, view = view, chosen(view, ~bad)
    # Only stamps that make sense can say something about poses, and only right poses something about radios.
    suspected = [finding for examination in GEOMETRY for finding in examination(view)]
    if not suspected:
        suspected = [finding for examination in RADIO for finding in examination(view)]
    findings += suspected
    for always in STRUCTURE:
        findings += always(whole if always in OF_ALL_ROWS else view)
    found = {finding.fault for finding in findings}
    # Where nothing moves, every pair has one distance and one power, and the one explains the other.
    implied = {radio.CONFOUNDED, closures.OPEN} if pairs.STATIC in found else set[str]()
    if anchors.ELSEWHERE in found:
        implied |= {closures.OPEN}
    if steps.MOVED in found or steps.DRIFTED in found or clocks.LEFT in found or clocks.WRONG_SIGN in found:
        implied |= {closures.OPEN, reflected.MANY, reflected.LASTING}
    return [finding for finding in findings if finding.fault not in implied], view


def _admitted(name: str, looked: Looked) -> RecordingView:
    both, poses, tags = looked.exchanges, looked.poses, looked.tags
    reports = single_reports(both)
    e = reports.exchanges
    with np.errstate(all="ignore"):
        raw = raw_range(e)
    truth = e.truth_m
    if not np.isfinite(truth).any() and len(poses):
        truth = distances_m(poses, tags, e.initiator, e.target, e.time_ns)
    told = tuple(", ".join(differences(both, a, b)) for a, b in reports.differing.tolist())
    return RecordingView(
        name=name,
        exchanges=e,
        poses=poses,
        tags=tags,
        faults=looked.faults,
        raw_m=raw,
        truth_m=truth,
        reported_twice=reports.repeated,
        contradictions=told,
    )


Examination = Callable[[RecordingView], Iterator[Finding]]
GROSS: Final[tuple[Examination, ...]] = (timestamps.single_as_double, timestamps.units, protocols.another)
GROSS_FAULTS: Final = {"single-sided data taken for double-sided", "unit slip", "timestamp width", "another protocol"}
GEOMETRY: Final[tuple[Examination, ...]] = (geometry.pose_clock, geometry.geometry, anchors.anchors)
RADIO: Final[tuple[Examination, ...]] = (clocks.skew, steps.moved_delay, closures.closures, reflected.reflections)
STRUCTURE: Final[tuple[Examination, ...]] = (
    timestamps.swapped_roles,
    timestamps.speed_of_light,
    timestamps.contradicting,
    timestamps.with_itself,
    clocks.unread,
    clocks.carriers,
    pairs.pairs,
    pairs.silent,
    pairs.still,
    radio.confounded,
    radio.unpowered,
    pairs.no_truth,
)
OF_ALL_ROWS: Final = (timestamps.contradicting, timestamps.with_itself, pairs.silent)
