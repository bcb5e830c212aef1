"""Names the fault in a recording, with the evidence and the remedy.

Each examination is a row of the table of checks (`calib.checks.table`). Those that suspect the truth (poses, lever
arms, ids, clocks) work by trial: they undo the suspected fault, and if the ranges then agree better with the distances,
it was there; of several, the one that explains most.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from calib.checks import clocks, geometry, offsets, pairs, reflected, stamps, surveys, units
from calib.checks.recording_view import Looked, RecordingView, chosen, looked_at
from calib.checks.table import BETWEEN, CHECKS, GEOMETRY, GROSS, LEVEL, RADIO, ROWS, STRUCTURE, SURVEYS
from calib.data.sources import Data, each, opened
from calib.findings import Check, Finding
from uwblink.recording.distances import distances_m
from uwblink.recording.target_reports import differences, repeated_rows, single_reports
from uwblink.twr import raw_range


def examine(data: Data | Iterable[Data]) -> list[Finding]:
    """Return what is wrong with a recording, the gravest first: each fault with its evidence and what to do about it.

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
        between = BETWEEN.findings(offsets.compared(views, LEVEL), LEVEL)
        # What moved between two recordings is no fault of either one.
        moved = any(finding.fault == offsets.MOVED_ANCHOR for finding in between)
        findings = [one for one in findings if not (moved and one.fault == geometry.ELSEWHERE)] + between
    if views and len(views) == len(recordings) and all(view.standing for view in views):
        findings += SURVEYS.findings(surveys.surveyed(recordings), LEVEL)
    return sorted(findings, key=lambda finding: ORDER.index(finding.fault))


def _run(checks: Sequence[Check], view: RecordingView) -> list[Finding]:
    return [finding for check in checks for finding in check.findings(check.look(view), LEVEL)]


def _examined(data: Data) -> tuple[list[Finding], RecordingView | None]:
    """Return what is wrong with one recording, and the recording without its impossible rows."""
    with opened(data) as (name, source):
        looked = looked_at(source)
        marked = tuple(getattr(source, "arrangements", ()))
    if not looked.count:
        return [Finding(EMPTY, "the recording holds no exchanges", "record or import some", 0.0)], None
    view = replace(_admitted(name, looked), arrangements=marked)
    for check in GROSS:
        if gross := check.findings(check.look(view), LEVEL):
            return gross, None
    findings = _run(ROWS, view)
    bad = stamps.impossible(view)
    if bad.all():
        return findings, None
    view = chosen(view, ~bad)
    if units.POWER in {finding.fault for finding in findings}:
        unknown = np.full(len(view.exchanges), np.nan)
        view = replace(view, exchanges=replace(view.exchanges, fpp1_dbm=unknown, fpp2_dbm=unknown))
    # Only stamps that make sense can say something about poses, and only right poses something about radios.
    findings += _best(view) or _run(RADIO, view)
    findings += _run(STRUCTURE, view)
    found = {finding.fault for finding in findings}
    implied = set[str]().union(*(follows for fault, follows in IMPLIED if fault in found))
    return [finding for finding in findings if finding.fault not in implied], view


def _best(view: RecordingView) -> list[Finding]:
    """Return the fault of poses and lever arms that explains most of the errors."""
    seen = [(check, [one for one in check.look(view) if one.p_value < LEVEL]) for check in GEOMETRY]
    check, best = max(seen, key=lambda one: sum(fault.gain for fault in one[1]))
    return check.findings(best, LEVEL)


def _admitted(name: str, looked: Looked) -> RecordingView:
    both, poses, tags = looked.exchanges, looked.poses, looked.tags
    again = repeated_rows(both)
    both = both[~again]
    reports = single_reports(both)
    e = reports.exchanges
    with np.errstate(all="ignore"):
        raw = raw_range(e)
    truth, posed = e.truth_m, False
    if len(poses):
        by_poses = distances_m(poses, tags, e.initiator, e.target, e.time_ns)
        given = np.isfinite(truth)
        # Tables with places of antennas bring both, which are then the same.
        apart = np.abs(truth - by_poses)[given & np.isfinite(by_poses)]
        posed = not given.any() or (len(apart) > 0 and float(np.median(apart)) < SAME_M)
        truth = by_poses if posed else truth
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
        posed=posed,
        doubled=int(np.count_nonzero(again)),
    )


EMPTY: Final = "empty"
SAME_M: Final = 0.001
"""Distances that are written down and those of the poses are the same if they differ by rounding."""

ORDER: Final = (EMPTY, *(fault for check in CHECKS for fault in check.remedies))
CHANGED: Final = {offsets.OPEN, reflected.MANY, reflected.LASTING}
IMPLIED: Final = (
    # Where nothing moves, every pair has one distance and one power, and the one explains the other.
    (pairs.STATIC, {pairs.CONFOUNDED}),
    (geometry.ELSEWHERE, {offsets.OPEN}),
    (offsets.MOVED, CHANGED),
    (offsets.DRIFTED, CHANGED),
    (offsets.ASTRAY, {*CHANGED, offsets.MOVED, offsets.DRIFTED}),
    (clocks.LEFT, {*CHANGED, offsets.ASTRAY}),
    (clocks.WRONG_SIGN, {*CHANGED, offsets.ASTRAY}),
    (units.POWER, {"no powers"}),
    (units.REPORTED, {"corrupted exchanges"}),
)
"""What follows from a fault and is not told beside it."""

GROSS_FAULTS: Final = {fault for check in GROSS for fault in check.remedies}
