"""The table of checks, each with its question, statistic, distribution on sound data and remedies; and examinations.

Each examination of a recording is a row of the table. Those that suspect the truth (poses, lever arms, ids, clocks)
work by trial: they undo the suspected fault, and if the ranges then agree better with the distances, it was there; of
several, the one that explains most.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from calib.checks import clocks, columns, geometry, offsets, pairs, reflected, surveys
from calib.checks.recording_view import RecordingView, view_of
from calib.data.sources import Data, each, opened
from calib.findings import BUDGET, CERTAIN, OF_A_FIT, Check, Finding

ALONE: Final = "Student's t over 16 stretches of time"
BLOCKS: Final = "Student's t, variances by stretches of time"

GROSS: Final = (
    Check(
        "Do double-sided exchanges have a third message?",
        "share without one, above a half", CERTAIN,
        {"single-sided data taken for double-sided": 'import again with protocol = "ss"'},
        columns.single_as_double,
    ),
    Check(
        "Does a frame last as long as frames do?",
        "longest leg, shorter than a frame as ticks and not as ns", CERTAIN,
        {"unit slip": 'the stamps are nanoseconds, not ticks: import again with [units] stamps = "ns"'},
        columns.ticks,
    ),
    Check(
        "Are true distances and ranges in one unit?",
        "spread of ranges less true distances, halved by mm, cm, in or ft", CERTAIN,
        {
            "unit of the poses": "divide x y z of the poses by {many}, add them again: uwblink poses ... --from FILE; "
            'or import again with [units] distance = "{unit}" where the table has them',
            "unit of the true distances": 'import again with [units] distance = "{unit}", or divide gt_range_m by '
            "{many}",
            "unit of the ranges": 'import again with [units] distance = "{unit}"',
        },
        columns.lengths,
    ),
    Check(
        "Do the stamps make ranges as the recording says?",
        "share of possible ranges by another protocol or width", CERTAIN,
        {
            "another protocol": "import again with {settings}",
            "timestamp width": "import again with bits = {bits}",
        },
        columns.another,
    ),
)  # fmt: skip

ROWS: Final = (
    Check(
        "Are more rows damaged than one in a thousand?",
        "count of impossible rows", "binomial",
        {
            "corrupted exchanges": "a robust fit leaves them out; check cables and USB load, and decode the recording "
            "again if it has bytes"
        },
        columns.corrupted,
    ),
    Check(
        "Is each exchange there once?",
        "rows with all stamps of another", CERTAIN,
        {"doubled exchanges": "import one log of each exchange; what is said here counts each once"},
        columns.doubled,
    ),
    Check(
        "Do both reports of an exchange agree?",
        "reports that differ", CERTAIN,
        {"contradicting reports": "look at the cables and ports of the two boards; what a damaged line says is not "
         "known"},
        columns.contradicting,
    ),
    Check(
        "Does a tag range with itself?",
        "exchanges with one tag at both ends", CERTAIN,
        {"a tag with itself": "import again with other columns for from_id and to_id; a fit leaves these exchanges "
         "out"},
        columns.with_itself,
    ),
    Check(
        "Does a tag fail in more than half of its exchanges, and more than others?",
        "count of failures", "binomial, for all tags",
        {"dead or deaf tag": "check power, antenna and USB of tag {tag}"},
        pairs.silent,
    ),
    Check(
        "Are powers dBm at an antenna?",
        "median outside of -140 to -30 dBm", CERTAIN,
        {columns.POWER: "{factor}, and import again"},
        columns.powers,
    ),
)  # fmt: skip

GEOMETRY: Final = (
    Check(
        "Do poses fit better more than 30 ms earlier or later?",
        "log of the spread before over after", ALONE,
        {"pose time offset": "shift the poses: uwblink poses ... --offset {shift}"},
        geometry.pose_clock,
    ),
    Check(
        "Do other lever arms or quaternions fit better?",
        "log of the spread before over after, the best trial", f"{ALONE}, for all trials",
        {
            "lever arm sign": "change the sign of the lever arms of body {body}",
            "lever arm unit": "multiply the lever arms of body {body} by {length}",
            "swapped tag ids": "exchange tags {a} and {b}",
            "wxyz quaternion": "quaternions are w x y z: reorder the columns to x y z w",
        },
        geometry.geometry,
    ),
    Check(
        "Does an anchor stand more than 5 cm elsewhere?",
        "displacement that ranges ask for", "F(3, 9), variances by stretches of time, for all anchors",
        {
            geometry.ELSEWHERE: "measure the place of {body} again, and see whose number it has; these ranges give "
            "position_m = {place}"
        },
        geometry.anchors,
    ),
)  # fmt: skip

RADIO: Final = (
    Check(
        "Do ranges follow the true distances within 30 cm?",
        "mean absolute error of a pair, its median aside", f"{ALONE}, for all pairs",
        {
            offsets.ASTRAY: "see whether numbers of anchors belong to other places, and times to another clock; or "
            "whether a wall stands between these tags"
        },
        offsets.astray,
    ),
    Check(
        "Do errors follow the clocks' skew?",
        "slope over the carriers' readings above 0.5, or ranges by who initiates above 5 cm",
        "normal, or Student's t among pairs", {clocks.LEFT: "{more}", clocks.WRONG_SIGN: "{more}"},
        clocks.skew,
    ),
    Check(
        "Do all pairs of a tag shift by more than 2 cm at one time, and no others?",
        "mean shift at the best of 60 times and all tags", BLOCKS,
        {
            offsets.MOVED: "look for a loose antenna or another voltage on tag {tag}; calibrate the two parts apart",
            offsets.DRIFTED: "let tag {tag} warm up, see to its supply; calibrate short parts apart",
        },
        offsets.changed_delays,
    ),
    Check(
        "Is a pair more than 4 cm off what delays of tags explain?",
        "a pair's own offset, the largest", f"{BLOCKS}, for all pairs",
        {
            offsets.OPEN: "look for a wall or a body between these two, and at their lever arms; record the pair "
            "anew, or fit with `constants` pair"
        },
        offsets.closures,
    ),
    Check(
        "Are more than a fifth of the ranges reflected, or of one tag more than of others, or do reflections last?",
        "share of long ranges; long ranges after long ones", f"{ALONE}; binomial, for all tags or pairs",
        {
            reflected.MANY: "{more}",
            reflected.LASTING: "such ranges do not average out within a spell: record for many spells, move walls, "
            "bodies or antennas",
        },
        reflected.reflections,
    ),
)  # fmt: skip

STRUCTURE: Final = (
    Check(
        "Do carriers and stamps call the same clocks faster?",
        "slope of the one over the other below -0.5", "normal",
        {
            "swapped roles": "initiator and target (ids, powers and skews) are exchanged, or the readings have the "
            "other sign: change it on import"
        },
        clocks.swapped_roles,
    ),
    Check(
        "Are reported ranges those of the stamps, in metres?",
        "median of their ratio", CERTAIN,
        {
            "speed of light in vacuum": "nothing for a fit, which uses the stamps; multiply reported ranges by 0.9997 "
            "before using them",
            columns.REPORTED: 'nothing for a fit, which uses stamps; else import again with [units] distance = '
            '"{unit}"',
        },
        columns.reported,
    ),
    Check(
        "Were carriers read where one reply is all that there is?",
        "single-sided exchanges without", CERTAIN,
        {
            "single-sided without carrier readings": "range in both directions of every pair, so that half of the "
            "skew's sign is the other way; or record the carrier integrator, or use double-sided ranging"
        },
        clocks.unread,
    ),
    Check(
        "Do carriers' readings scatter by more than 1.5 ppm?",
        "log of the median pair's scatter", "normal",
        {
            "carrier readings that say little": "do not correct single-sided ranges with them; see to their unit and "
            "register"
        },
        clocks.carriers,
    ),
    Check(
        "Do the pairs determine all delays?",
        "null space of the design", CERTAIN,
        {"too few pairs": "record three tags that all range with each other, or pin a known delay with `fixed_ns`"},
        pairs.pairs,
    ),
    Check(
        "Does any distance change by 10 cm?",
        "largest change", CERTAIN,
        {pairs.STATIC: "move the tags while recording, so that powers and reflections vary"},
        pairs.still,
    ),
    Check(
        "Does distance explain more than 90 % of the power?",
        "share of variance between distances, noise of readings aside (variance inflation of 10)", CERTAIN,
        {
            pairs.CONFOUNDED: "turn the antennas while recording; until then the curve may hold what belongs to "
            "distance, and `delays_only` fits none"
        },
        pairs.confounded,
    ),
    Check(
        "Were powers measured, and are true distances known?",
        "share of exchanges with one, below a half", CERTAIN,
        {
            "no powers": "import powers as fpp1 and fpp2; without them only delays can be fitted, by `delays_only`",
            "no true distances": "add motion capture with uwblink poses, or measured distances in gt_range_m; without "
            "any, survey boards that stood still, and fit moving ones with the truth from ranges",
        },
        pairs.missing,
    ),
)  # fmt: skip

BETWEEN: Final = Check(
    "Did an anchor or a delay change between recordings?",
    "displacement of an anchor; mean change of a tag's pairs above 2 cm", f"as above; {BLOCKS}, for all tags",
    {
        offsets.MOVED_ANCHOR: "measure the place of {body} anew, and fit recordings apart until then",
        offsets.OTHER_DELAY: "was the antenna of tag {tag} touched, or its board replaced? calibrate the recordings "
        "apart",
    },
    offsets.compared,
)  # fmt: skip

SURVEYS: Final = Check(
    "What does a survey of standing boards contradict?",
    "contradictions of the survey, which has tested them", CERTAIN, surveys.REMEDIES, surveys.surveyed,
)  # fmt: skip

CHECKS: Final = (*GROSS, *ROWS, *GEOMETRY, *RADIO, *STRUCTURE, BETWEEN, SURVEYS)
LEVEL: Final = (BUDGET - OF_A_FIT) / sum(not check.certain for check in CHECKS)
"""p-value below which a candidate is a finding: checks have equal shares of the budget, beside that of a fit."""

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
