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

from calib.checks import clocks, columns, geometry, offsets, pairs, reflected, surveys
from calib.checks.recording_view import RecordingView, view_of
from calib.checks.table import BETWEEN, CHECKS, GEOMETRY, GROSS, LEVEL, RADIO, ROWS, STRUCTURE, SURVEYS
from calib.data.sources import Data, each, opened
from calib.findings import Check, Finding


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
    recordings, views, findings = each(data), list[RecordingView](), list[Finding]()
    for one in recordings:
        with opened(one) as (name, source):
            whole = view_of(name, source)
        found, view = _examined(whole)
        prefix = f"{name}: " if len(recordings) > 1 else ""
        findings += [replace(finding, evidence=prefix + finding.evidence) for finding in found]
        views += [view] if view else []
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


def _examined(view: RecordingView) -> tuple[list[Finding], RecordingView | None]:
    """Return what is wrong with one recording, and the recording without its impossible rows, if that can be used."""
    if not len(view.exchanges):
        return [Finding(EMPTY, "the recording holds no exchanges", "record or import some", 0.0)], None
    for check in GROSS:
        if gross := check.findings(check.look(view), LEVEL):
            return gross, None
    findings = _run(ROWS, view)
    bad = columns.impossible(view)
    if bad.all():
        return findings, None
    view = view.chosen(~bad)
    if columns.POWER in {finding.fault for finding in findings}:
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


EMPTY: Final = "empty"
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
    (columns.POWER, {"no powers"}),
    (columns.REPORTED, {"corrupted exchanges"}),
)
"""What follows from a fault and is not told beside it."""
