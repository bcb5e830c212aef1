"""The table of checks, each with its question, statistic, distribution on sound data and remedies; and examinations.

Checks of geometry suspect the true distances (poses, lever arms, ids, clocks), and work by trial: they undo the
suspected fault, and if the ranges then agree better with the distances, it was there; of several, the one that explains
most.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, Final

import numpy as np
from threadpoolctl import threadpool_limits

from calib.checks import columns, geometry, residuals
from calib.checks.recording_view import RecordingView, view_of
from calib.data.sources import Data, each, opened
from calib.errors import UnanswerableError
from calib.findings import BUDGET, CERTAIN, OF_A_FIT, Candidate, Check, Finding
from calib.surveys.knowledge import Knowledge
from calib.surveys.network import NARROWEST_DB, in_dbm
from calib.surveys.recordings import read_surveys
from calib.surveys.result import SurveyResult
from calib.surveys.survey import survey


def surveyed(recordings: list[Data]) -> Iterator[Candidate]:
    """Yield what a survey of recordings finds wrong: with what is known, with places, with powers.

    The survey itself has judged: what it says is not tested again.
    """
    contradictions: tuple[Finding, ...] = ()
    found: SurveyResult | None = None
    try:
        given = read_surveys(recordings, Knowledge())
        contradictions, lifted = given.findings, given.means.lifted
        if np.isfinite(lifted).all() and (lifted > 0).all() and np.ptp(in_dbm(lifted)) < NARROWEST_DB:
            yield Candidate(
                "powers that hardly vary",
                f"mean powers of pairs lie within {np.ptp(in_dbm(lifted)):.1f} dB, and a curve over power needs "
                f"{NARROWEST_DB:g}",
            )
        found = survey(recordings, regardless=True)
    except UnanswerableError as error:
        yield Candidate("survey determines nothing", str(error))
    yield from (Candidate(one.fault, one.evidence) for one in (found.contradictions if found else contradictions))
    if not found:
        return
    made, second = found.calibration.provenance, found.second_best
    if made["undetermined"]:
        who = ", ".join(map(str, made["undetermined"][0]))
        yield Candidate("delays that a survey leaves open", f"the arrangements do not determine the delays of {who}")
    likely = [f"{one.first}-{one.second} in {one.arrangement}" for one in found.reflected if one.chance > 0.5]
    if len(likely) > 0.1 * made["pairs"]:
        evidence = f"{len(likely)} of {made['pairs']} pairs are believed to be reflected: {', '.join(likely)}"
        yield Candidate("many reflected pairs", evidence)
    if second is not None and second.ambiguous:
        evidence = f"{second.arrangement}: boards {', '.join(map(str, second.tags))} could as well be elsewhere"
        yield Candidate("two solutions of a survey", evidence)


OVER_STRETCHES: Final = "Student's t over 16 stretches of time"
OVER_BLOCKS: Final = "Student's t, variances by stretches of time"

CHECKS: Final = (
    Check(
        "reading",
        "Do differences of arrival fit the places of their anchors, in unit and sign?",
        "growth with the true differences, outside of 0.75 to 1.35", CERTAIN,
        {"wrong differences of arrival": "correct their map or the places of anchors, and import them again"},
        columns.arrivals,
    ),
    Check(
        "reading",
        "Does the recording hold exchanges?",
        "number of exchanges", CERTAIN,
        {
            "empty": "record or import some",
            "differences alone": "`calib fit --use receptions --delays-only` tests their errors",
        },
        columns.empty,
    ),
    Check(
        "reading",
        "Do double-sided exchanges have a third message?",
        "share without one, above a half", CERTAIN,
        {"single-sided data taken for double-sided": 'import again with protocol = "ss"'},
        columns.single_as_double,
    ),
    Check(
        "reading",
        "Does a frame last as long as frames do?",
        "longest leg, shorter than a frame as ticks and not as ns", CERTAIN,
        {"unit slip": 'the stamps are nanoseconds, not ticks: import again with [units] stamps = "ns"'},
        columns.ticks,
    ),
    Check(
        "reading",
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
        "reading",
        "Do the stamps make ranges as the recording says?",
        "share of possible ranges by another protocol or width", CERTAIN,
        {
            "another protocol": "import again with {settings}",
            "timestamp width": "import again with bits = {bits}",
        },
        columns.another,
    ),
    Check(
        "rows",
        "Are more rows damaged than one in a thousand?",
        "count of impossible rows", "binomial",
        {
            "corrupted exchanges": "a robust fit leaves them out; check cables and USB load, and decode the recording "
            "again if it has bytes",
            "impossible stamps": "check that their columns are in the right order, with all digits, and of this "
            "protocol; import again",
        },
        columns.corrupted,
    ),
    Check(
        "rows",
        "Do initiators' stamps of 40 bits follow the times?",
        "count of jumps by one time among those to another time and back", "binomial",
        {"recordings mixed by their times": "import each recording, or the parts before and after the clock was set, "
         "separately"},
        columns.mixed,
    ),
    Check(
        "rows",
        "Are poses as frequent as motion needs?",
        "a quarter of what a pose is off the line between its neighbours, above 2 cm", CERTAIN,
        {"rare poses": "export poses at a higher rate, or move slowly; true distances are wrong by about as much"},
        columns.rare_poses,
    ),
    Check(
        "rows",
        "Is each exchange there once?",
        "rows with all stamps of another", CERTAIN,
        {"doubled exchanges": "import one log of each exchange; what is said here counts each once"},
        columns.doubled,
    ),
    Check(
        "rows",
        "Do both reports of an exchange agree?",
        "reports that differ", CERTAIN,
        {"contradicting reports": "look at the cables and ports of the two boards; what a damaged line says is not "
         "known"},
        columns.contradicting,
    ),
    Check(
        "rows",
        "Does a tag range with itself?",
        "exchanges with one tag at both ends", CERTAIN,
        {"a tag with itself": "import again with other columns for from_id and to_id; a fit leaves these exchanges "
         "out"},
        columns.with_itself,
    ),
    Check(
        "rows",
        "Does a tag fail in more than half of its exchanges, and more than others?",
        "count of failures", "binomial, for all tags",
        {"dead or deaf tag": "check power, antenna and USB of tag {tag}"},
        columns.silent,
    ),
    Check(
        "rows",
        "Are powers dBm at an antenna?",
        "median outside of -140 to -30 dBm", CERTAIN,
        {"unit of the powers": "{factor}, and import again"},
        columns.powers,
    ),
    Check(
        "geometry",
        "Do poses fit better more than 30 ms earlier or later?",
        "log of the spread before over after", OVER_STRETCHES,
        {"pose time offset": "shift the poses: uwblink poses ... --offset {shift}"},
        geometry.pose_clock,
    ),
    Check(
        "geometry",
        "Do other lever arms or quaternions fit better?",
        "log of the spread before over after, the best trial", f"{OVER_STRETCHES}, for all trials",
        {
            "lever arm sign": "change the sign of the lever arms of body {body}",
            "lever arm unit": "multiply the lever arms of body {body} by {length}",
            "wxyz quaternion": "quaternions are w x y z: reorder the columns to x y z w",
            "inverse quaternion": "quaternions turn the world into the body: change the signs of x y z",
            "wrong lever arm": "measure the lever arm of {name}, in the frame of its body; these ranges give{line}",
            "body stands elsewhere": "check the frame and the origin of the poses of {name} and of the others",
        },
        geometry.geometry,
    ),
    Check(
        "geometry",
        "Are tags at places of others, or anchors more than 5 cm elsewhere?",
        "log of the spread before over after, tags assigned to places; displacement that ranges ask for",
        f"{OVER_STRETCHES}, for all exchanges; F(3, 9), variances by stretches of time, for all anchors",
        {
            "swapped tag ids": "{remedy}",
            "anchor stands elsewhere": "measure the place of {body} again, and see whose number it has; these ranges "
            "give{lines}"
        },
        geometry.anchors,
    ),
    Check(
        "radio",
        "Do ranges follow the true distances within 30 cm?",
        "mean absolute error of a pair, its median aside", f"{OVER_STRETCHES}, for all pairs",
        {
            "ranges that do not follow the distances": "see whether numbers of anchors belong to other places, and "
            "times to another clock; or whether a wall stands between these tags"
        },
        residuals.astray,
    ),
    Check(
        "radio",
        "Do errors follow the clocks' skew?",
        "slope over the carriers' readings above 0.5, or ranges by who initiates above 5 cm",
        "normal, or Student's t among pairs",
        {"skew in single-sided ranges": "{more}", "carrier readings with the wrong sign": "{more}"},
        residuals.skew,
    ),
    Check(
        "radio",
        "Do all pairs of a tag shift by more than 2 cm at one time, and no others?",
        "mean shift at the best of 47 times, and all tags", OVER_BLOCKS,
        {
            "delay changed mid-flight": "look for a loose antenna or another voltage on tag {tag}; calibrate the "
            "two parts apart",
            "delay drifts": "{readings}let tag {tag} warm up, see to its supply; calibrate short parts apart",
        },
        residuals.changed_delays,
    ),
    Check(
        "radio",
        "Is a pair more than 4 cm off what delays of tags explain, and places of anchors not?",
        "a pair's own offset, the largest; places beside it (F)", f"{OVER_BLOCKS}, for all pairs",
        {
            "pairs that do not close": "look for a wall or a body between these two, and at their lever arms and "
            "places; record the pair anew, or fit with `constants` pair",
            "places that do not close": "measure the places of anchors again, all from one point; these ranges "
            "give{lines}",
        },
        residuals.closures,
    ),
    Check(
        "radio",
        "Are more than 15 % of the ranges reflected, or of one tag 15 % more than of others, or do reflections last?",
        "share of ranges that are 12 cm long; long ranges after long ones",
        f"{OVER_STRETCHES}; binomial, for all tags or pairs",
        {
            "reflections": "{more}",
            "reflections that last": "such ranges do not average out within a spell: record for many spells, move "
            "walls, bodies or antennas",
        },
        residuals.reflections,
    ),
    Check(
        "structure",
        "Do carriers and stamps call the same clocks faster?",
        "slope of the one over the other below -0.5", "normal",
        {
            "swapped roles": "initiator and target (ids, powers and skews) are exchanged, or the readings have the "
            "other sign: change it on import"
        },
        columns.swapped_roles,
    ),
    Check(
        "structure",
        "Are reported ranges those of the stamps, in metres?",
        "median of their ratio", CERTAIN,
        {
            "speed of light in vacuum": "nothing for a fit, which uses the stamps; multiply reported ranges by 0.9997 "
            "before using them",
            "unit of the reported ranges": 'nothing for a fit, which uses stamps; else import again with [units] '
            'distance = "{unit}"',
        },
        columns.reported,
    ),
    Check(
        "structure",
        "Were carriers read where one reply is all that there is?",
        "single-sided exchanges without", CERTAIN,
        {
            "single-sided without carrier readings": "range in both directions of every pair, so that half of the "
            "skew's sign is the other way; or record the carrier integrator, or use double-sided ranging"
        },
        columns.unread,
    ),
    Check(
        "structure",
        "Do carriers' readings scatter by more than 1.5 ppm?",
        "log of the median pair's scatter", "normal",
        {
            "carrier readings that say little": "do not correct single-sided ranges with them; see to their unit and "
            "register"
        },
        columns.carriers,
    ),
    Check(
        "structure",
        "Do the pairs determine all delays?",
        "null space of the design", CERTAIN,
        {
            "too few pairs": "nothing if ranges stay between these sides; else record three tags that all range with "
            "each other, or pin a known delay with `fixed_ns`"
        },
        columns.undetermined,
    ),
    Check(
        "structure",
        "Does any distance change by 10 cm?",
        "largest change", CERTAIN,
        {"static data": "move the tags while recording, so that powers and reflections vary"},
        columns.still,
    ),
    Check(
        "structure",
        "Does distance explain more than 90 % of the power?",
        "share of variance between distances, noise of readings aside (variance inflation of 10)", CERTAIN,
        {
            "power confounded with distance": "turn the antennas while recording; until then the curve may hold "
            "what belongs to distance, and `delays_only` fits none"
        },
        columns.confounded,
    ),
    Check(
        "structure",
        "Were powers measured, and are true distances known?",
        "share of exchanges with one, below a half", CERTAIN,
        {
            "no powers": "import powers as fpp1 and fpp2; without them only delays can be fitted, by `delays_only`",
            "no true distances": "add motion capture with uwblink poses, or measured distances in gt_range_m; without "
            "any, survey boards that stood still, and fit moving ones with the truth from ranges",
        },
        columns.missing,
    ),
    Check(
        "between",
        "Did an anchor or a delay change between recordings?",
        "displacement of an anchor; mean change of a tag's pairs above 2 cm", f"as above; {OVER_BLOCKS}, for all tags",
        {
            "anchor moved between recordings": "measure the place of {body} anew, and fit recordings apart until then",
            "delay changed between recordings": "was the antenna of tag {tag} touched, or its board replaced? "
            "calibrate the recordings apart",
        },
        residuals.compared,
    ),
    Check(
        "survey",
        "What does a survey of standing boards contradict?",
        "contradictions of the survey, which has tested them", CERTAIN,
        {
            "board moved within an arrangement": "record that arrangement again, or end it before",
            "arrangement not as it is said to be": "put the boards straight, or record without `known`",
            "wrong known distance": "measure it again, antenna to antenna, or leave it out",
            "exchanged labels": "look at the labels of these two boards",
            "survey determines nothing": "make the arrangements that calib plan advises",
            "delays that a survey leaves open": "make another arrangement, or tape a distance: calib plan says which",
            "many reflected pairs": "put boards where they see each other, away from walls and metal",
            "two solutions of a survey": "tape a distance that tells them apart, and give it as known",
            "powers that hardly vary": "make arrangements with nearer and farther boards, or take the curve of another "
            "calibration (`curve_from`)",
        },
        surveyed,
    ),
)  # fmt: skip

FINDING_LEVEL: Final = (BUDGET - OF_A_FIT) / sum(not check.certain for check in CHECKS)
"""p-value below which a candidate is a finding: checks have equal shares of the budget, beside that of a fit."""

OF_PAIRS: Final = {"pairs that do not close", "places that do not close", "reflections", "reflections that last"}
IMPLIED: Final = {
    # Where nothing moves, every pair has one distance and one power, and the one explains the other.
    "static data": {"power confounded with distance"},
    "anchor stands elsewhere": {"pairs that do not close"},
    "delay changed mid-flight": OF_PAIRS,
    "delay drifts": OF_PAIRS,
    "ranges that do not follow the distances": {*OF_PAIRS, "delay changed mid-flight", "delay drifts"},
    "skew in single-sided ranges": {*OF_PAIRS, "ranges that do not follow the distances"},
    "carrier readings with the wrong sign": {*OF_PAIRS, "ranges that do not follow the distances"},
    "recordings mixed by their times": {*OF_PAIRS, "ranges that do not follow the distances"},
    "rare poses": {*OF_PAIRS, "ranges that do not follow the distances"},
    "unit of the powers": {"no powers"},
    "unit of the reported ranges": {"corrupted exchanges"},
}
"""Faults that follow from a fault, and are not reported beside it."""


# Small matrices: several threads make them slower, and the last digits another.
@threadpool_limits.wrap(limits=1, user_api="blas")  # type: ignore[untyped-decorator]  # it has no types
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
        between = _run("between", views, FINDING_LEVEL)
        # What moved between two recordings is no fault of either one.
        moved = any(finding.fault == "anchor moved between recordings" for finding in between)
        findings = [one for one in findings if not (moved and one.fault == "anchor stands elsewhere")] + between
    if views and len(views) == len(recordings) and all(view.standing for view in views):
        findings += _run("survey", recordings)
    order = [fault for check in CHECKS for fault in check.remedies]
    return sorted(findings, key=lambda finding: order.index(finding.fault))


def _run(stage: str, *given: Any) -> list[Finding]:
    return [
        found for check in CHECKS if check.stage == stage for found in check.findings(check.look(*given), FINDING_LEVEL)
    ]


def _examined(view: RecordingView) -> tuple[list[Finding], RecordingView | None]:
    """Return what is wrong with one recording, and the recording without its impossible rows, if that can be used."""
    for check in CHECKS:
        # With such a fault, the other numbers of a recording mean something else.
        if check.stage == "reading" and (misread := check.findings(check.look(view), FINDING_LEVEL)):
            return misread, None
    findings = _run("rows", view)
    bad = columns.impossible(view)
    # The rest may be possible by chance.
    if bad.mean() >= 0.5:
        return findings, None
    view = view.chosen(~bad)
    if any(finding.fault == "unit of the powers" for finding in findings):
        unknown = np.full(len(view.exchanges), np.nan)
        view = replace(view, ranges=replace(view.ranges, fpp1_dbm=unknown, fpp2_dbm=unknown))
    # Only stamps that make sense can say something about poses, and only right poses something about radios.
    findings += _best(view) or _run("radio", view)
    findings += _run("structure", view)
    implied = set[str]().union(*(IMPLIED.get(finding.fault, ()) for finding in findings))
    return [finding for finding in findings if finding.fault not in implied], view


def _best(view: RecordingView) -> list[Finding]:
    """Return the fault of poses and lever arms that explains most of the errors."""
    tried = [check for check in CHECKS if check.stage == "geometry"]
    seen = [(check, [one for one in check.look(view) if one.p_value < FINDING_LEVEL]) for check in tried]
    check, best = max(seen, key=lambda one: sum(fault.gain for fault in one[1]))
    return check.findings(best, FINDING_LEVEL)
