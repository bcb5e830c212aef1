"""The table of checks, each with its question, statistic, distribution on sound data and remedies; `examine` runs it.

Checks of geometry test the true distances (poses, lever arms, ids, clocks) by trial: they undo a suspected fault, and
report it if the ranges then agree better with the distances; of several faults, the one that explains most is reported.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, Final

import numpy as np
from threadpoolctl import threadpool_limits

from calib.checks import columns, geometry, residuals
from calib.checks.recording_view import RecordingView, view_of
from calib.data.sources import Data, each, fingerprint_of, opened, refuse_repeated
from calib.errors import UnanswerableError
from calib.findings import BUDGET, CERTAIN, OF_A_FIT, REMEDIES, Candidate, Check, Finding
from calib.surveys.knowledge import Knowledge
from calib.surveys.network import NARROWEST_DB, in_dbm
from calib.surveys.recordings import read_surveys
from calib.surveys.result import SurveyResult
from calib.surveys.survey import HYPOTHESES, survey


def surveyed(recordings: list[Data]) -> Iterator[Candidate]:
    """Yield the faults that a survey of recordings finds in known facts, positions and powers.

    The survey has tested these itself, so they are not tested again.
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
        evidence = f"{len(likely)} of {made['pairs']} pairs are probably reflected: {', '.join(likely)}"
        yield Candidate("many reflected pairs", evidence)
    if second is not None and second.ambiguous:
        evidence = f"{second.arrangement}: boards {', '.join(map(str, second.tags))} have a second possible position"
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
        "Are durations of exchanges long enough for frames?",
        "longest leg; a fault if too short for a frame as ticks, but not as ns", CERTAIN,
        {"unit slip": 'the stamps are nanoseconds, not ticks: import again with [units] stamps = "ns"'},
        columns.ticks,
    ),
    Check(
        "reading",
        "Are true distances and ranges in one unit?",
        "spread of ranges minus true distances; a fault if mm, cm, in or ft halve it", CERTAIN,
        {
            "unit of the poses": "divide x y z of the poses by {many} and add them again (uwblink poses); "
            'or import again with [units] distance = "{unit}" if the table contains them',
            "unit of the true distances": 'import again with [units] distance = "{unit}", or divide gt_range_m by '
            "{many}",
            "unit of the ranges": 'import again with [units] distance = "{unit}"',
        },
        columns.lengths,
    ),
    Check(
        "reading",
        "Do the stamps give possible ranges with the protocol and counter width of the recording?",
        "share of possible ranges with another protocol or width", CERTAIN,
        {
            "another protocol": "import again with {settings}",
            "timestamp width": "import again with bits = {bits}",
        },
        columns.another,
    ),
    Check(
        "rows",
        "Is more than one row in a thousand damaged?",
        "count of impossible rows", "binomial",
        {
            "corrupted exchanges": "nothing for a fit, which leaves them out; check cables and USB load, and decode "
            "the recording again if it contains bytes",
            "impossible stamps": "check that the columns are in the right order, have all digits, and belong to this "
            "protocol; import again",
        },
        columns.corrupted,
    ),
    Check(
        "rows",
        "Do initiators' 40-bit stamps agree with the times of the exchanges?",
        "number of equal jumps among those to another time and back", "binomial",
        {"recordings mixed by their times": "import each recording separately, and separate the parts before and "
        "after the clock was set"},
        columns.mixed,
    ),
    Check(
        "rows",
        "Are poses frequent enough for the motion?",
        "a quarter of a pose's deviation from the line between its neighbours, above 2 cm", CERTAIN,
        {"rare poses": "export poses at a higher rate, or move slowly; true distances have about this error"},
        columns.rare_poses,
    ),
    Check(
        "rows",
        "Is each exchange recorded only once?",
        "rows with the same stamps as another row", CERTAIN,
        {"doubled exchanges": "import one log of each exchange; other findings count each exchange once"},
        columns.doubled,
    ),
    Check(
        "rows",
        "Do both reports of an exchange agree?",
        "number of differing reports", CERTAIN,
        {"contradicting reports": "check the cables and ports of the two boards; damaged lines cannot be repaired"},
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
        "Do more than half of a tag's exchanges fail, and more than those of others?",
        "number of failures", "binomial, for all tags",
        {"dead or deaf tag": "check power, antenna and USB of tag {tag}"},
        columns.silent,
    ),
    Check(
        "rows",
        "Are powers in dBm at an antenna?",
        "median; a fault outside -140 to -30 dBm", CERTAIN,
        {"unit of the powers": "{factor}, and import again"},
        columns.powers,
    ),
    Check(
        "geometry",
        "Do ranges agree better with poses or true distances that are more than 30 ms earlier or later?",
        "log of the ratio of spreads before and after the shift; without poses the slope of errors over speeds",
        f"{OVER_STRETCHES}; {OVER_BLOCKS}",
        {
            "pose time offset": "shift the poses: uwblink poses ... --offset {shift}",
            "time offset of true distances": "add {shift} s to the clock of the system that measured the true "
            "distances, and import again",
        },
        geometry.pose_clock,
    ),
    Check(
        "geometry",
        "Do errors grow with the true distances by more than 0.5 %?",
        "slope of errors over true distances; reflections of far ranges may cause a part of it", OVER_BLOCKS,
        {
            "scale of true distances": "check the calibration of motion capture or the tape; measure a long distance "
            "again",
            "scale of true distances or reflections": "measure a long distance again; if it is right, record in the "
            "open",
        },
        geometry.scale,
    ),
    Check(
        "geometry",
        "Do errors spread twice as widely while the poses of a body repeat?",
        "log of the ratio of spreads while poses repeat for 0.5 s and at other times", OVER_STRETCHES,
        {"frozen poses": "motion capture lost the body: delete the poses that repeat the one before, and add the poses "
         "again (uwblink poses); ranges in such gaps are left out"},
        geometry.frozen_poses,
    ),
    Check(
        "geometry",
        "Do ranges agree better with other lever arms or quaternions?",
        "log of the ratio of spreads before and after, of the best trial", f"{OVER_STRETCHES}, for all trials",
        {
            "lever arm sign": "change the sign of the lever arms of body {body}",
            "lever arm unit": "multiply the lever arms of body {body} by {length}",
            "wxyz quaternion": "quaternions are w x y z: reorder the columns to x y z w",
            "inverse quaternion": "quaternions turn the world into the body: change the signs of x y z",
            "wrong lever arm": "measure the lever arm of {name} in the frame of its body; the ranges give{line}",
            "attitudes in another frame": "{remedy}",
            "body stands elsewhere": "check that the poses of {name} have the same frame and origin as the others",
        },
        geometry.geometry,
    ),
    Check(
        "geometry",
        "Are tags exchanged, or anchors more than 5 cm away from their given positions?",
        "log of the ratio of spreads before and after an assignment of tags to positions; displacement of an anchor",
        f"{OVER_STRETCHES}, for all exchanges; F(3, 9), variances by stretches of time, for all anchors",
        {
            "swapped tag ids": "{remedy}",
            "anchor stands elsewhere": "measure the position of {body} again, and check its id; the ranges give{lines}"
        },
        geometry.anchors,
    ),
    Check(
        "radio",
        "Do ranges agree with true distances within 30 cm?",
        "mean absolute deviation of a pair's errors from their median", f"{OVER_STRETCHES}, for all pairs",
        {
            "ranges that do not follow the distances": "check ids and positions of anchors, and the clock of the "
            "times; or there is a wall between these tags"
        },
        residuals.unrelated_ranges,
    ),
    Check(
        "radio",
        "Do errors depend on clock skew?",
        "slope of errors over carrier readings, above 0.5; or difference of ranges by initiator, above 5 cm",
        "normal, or Student's t among pairs",
        {"skew in single-sided ranges": "{more}", "carrier readings with the wrong sign": "{more}"},
        residuals.skew,
    ),
    Check(
        "radio",
        "Do ranges of all pairs of one tag and no others, or of all tags, change by more than 2 cm?",
        "mean shift, the largest of 47 times and all tags", OVER_BLOCKS,
        {
            "delay changed mid-flight": "check antenna and supply voltage of tag {tag}; calibrate the two parts "
            "separately",
            "all delays change": "let all boards warm up before a recording; if temperatures are recorded, "
            "`calib fit` corrects for them",
            "delay drifts": "{readings}let tag {tag} warm up, check its supply; calibrate short parts separately",
        },
        residuals.changed_delays,
    ),
    Check(
        "radio",
        "Does a pair have an offset of more than 4 cm that neither delays of tags nor positions of anchors explain?",
        "largest offset of a pair; displacements of anchors as the alternative (F)", f"{OVER_BLOCKS}, for all pairs",
        {
            "pairs that do not close": "look for a wall or a body between the two tags, and check their lever arms "
            "and positions; record the pair again, or fit with `constants` pair",
            "places that do not close": "measure the positions of the anchors again, all from one point; the ranges "
            "give{lines}",
        },
        residuals.closures,
    ),
    Check(
        "radio",
        "Are more than 15 % of the ranges reflected, or those of one tag 15 % more often than others, or do "
        "reflections last?",
        "share of ranges that are 12 cm too long; long ranges that follow long ranges",
        f"{OVER_STRETCHES}; binomial, for all tags or pairs",
        {
            "reflections": "{more}",
            "reflections that last": "with motion capture, check the lever arms, because wrong ones look alike; "
            "reflections do not average out while they last: record for longer, or move walls, bodies or antennas",
        },
        residuals.reflections,
    ),
    Check(
        "structure",
        "Do carrier readings and stamps agree about which clocks are faster?",
        "slope of carrier readings over stamps, below -0.5", "normal",
        {
            "swapped roles": "initiator and target (ids, powers and skews) are exchanged, or the readings have the "
            "wrong sign: correct it on import"
        },
        columns.swapped_roles,
    ),
    Check(
        "structure",
        "Do reported ranges in metres agree with the stamps?",
        "median of their ratio", CERTAIN,
        {
            "speed of light in vacuum": "nothing for a fit, which uses the stamps; multiply reported ranges by 0.9997 "
            "before using them",
            "unit of the reported ranges": 'nothing for a fit, which uses the stamps; for other uses import again '
            'with [units] distance = "{unit}"',
        },
        columns.reported,
    ),
    Check(
        "structure",
        "Do single-sided exchanges have carrier readings?",
        "number of single-sided exchanges without readings", CERTAIN,
        {
            "single-sided without carrier readings": "let both tags of every pair initiate, so that the effect of "
            "skew cancels; or record the carrier integrator, or use double-sided ranging"
        },
        columns.unread,
    ),
    Check(
        "structure",
        "Do carrier readings scatter by more than 1.5 ppm?",
        "log of the median pair's scatter", "normal",
        {
            "carrier readings that say little": "do not correct single-sided ranges with them; check their unit and "
            "register"
        },
        columns.carriers,
    ),
    Check(
        "structure",
        "Do the pairs determine all delays?",
        "null space of the design", CERTAIN,
        {
            "too few pairs": "nothing if only ranges between these sides are corrected; otherwise record three tags "
            "that all range with each other, or set a known delay with `fixed_ns`"
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
        "share of the variance of power that distance explains, without the noise of readings (variance inflation of "
        "10)", CERTAIN,
        {
            "power confounded with distance": "turn the antennas while recording; without this the curve may contain "
            "effects of distance, or fit without a curve by `delays_only`"
        },
        columns.confounded,
    ),
    Check(
        "structure",
        "Were powers measured, and are true distances known?",
        "share of exchanges with one, below a half", CERTAIN,
        {
            "no powers": "import powers as fpp1 and fpp2; without them only delays can be fitted, by `delays_only`",
            "no true distances": "add motion capture with uwblink poses, or measured distances in gt_range_m; "
            "without true distances use calib survey for boards that stand still, and calib fit --truth ranges for "
            "moving ones",
        },
        columns.missing,
    ),
    Check(
        "between",
        "Did an anchor or a delay change between recordings?",
        "displacement of an anchor; mean change of a tag's pairs above 2 cm", f"as above; {OVER_BLOCKS}, for all tags",
        {
            "anchor moved between recordings": "measure the position of {body} again, and fit the recordings "
            "separately until then",
            "delay changed between recordings": "check whether the antenna of tag {tag} was touched or its board "
            "replaced; calibrate the recordings separately",
        },
        residuals.between_recordings,
    ),
    Check(
        "survey",
        "Does a survey of boards that stand still contradict the known facts?",
        "contradictions that the survey found by its own tests", CERTAIN,
        {
            **{fault: REMEDIES[fault] for fault in ("board moved within an arrangement", *HYPOTHESES)},
            **{fault: REMEDIES[fault] for fault in ("delays that a survey leaves open", "two solutions of a survey")},
            "survey determines nothing": "record the arrangements that calib plan survey proposes",
            "many reflected pairs": "place the boards in line of sight of each other, away from walls and metal",
            "powers that hardly vary": "record arrangements with nearer and farther boards, or use the curve of "
            "another calibration (`curve_from`)",
        },
        surveyed,
    ),
)  # fmt: skip

FINDING_LEVEL: Final = (BUDGET - OF_A_FIT) / sum(not check.certain for check in CHECKS)
"""p-value below which a candidate is a finding: the checks share one half of the budget equally, the checks of a fit
have the other."""

OF_PAIRS: Final = {"pairs that do not close", "places that do not close", "reflections", "reflections that last"}
IMPLIED: Final = {
    # If nothing moves, every pair has one distance and one power, so distance explains power.
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
"""Faults that are consequences of another fault, and are not reported together with it."""


# Small matrices: several threads are slower, and change the last digits.
@threadpool_limits.wrap(limits=1, user_api="blas")  # type: ignore[untyped-decorator]  # it has no types
def examine(data: Data | Iterable[Data]) -> list[Finding]:
    """Return the faults of a recording, the most serious first, each with its evidence and remedy.

    `data` is the path of a recording, an open `Recording`, or anything with `exchanges`, `poses` and `tags`, or several
    of those, which are then also compared with each other; `Ranges` are not enough. Recordings of arrangements without
    poses are surveyed together. Impossible rows are left out before the other checks, and consequences of a more
    serious fault are not reported. Of a longer recording about 160,000 exchanges are examined, in 40 stretches over all
    of its time. Raises the errors of `Recording.open`, and `BadInputError` if two recordings hold the same exchanges.

    >>> import calib
    >>> [finding.fault for finding in calib.examine(calib.sample_flight())]
    []
    """
    recordings, views, findings = each(data), list[RecordingView](), list[Finding]()
    contents = list[tuple[str, str]]()
    for one in recordings:
        with opened(one) as (name, source):
            whole = view_of(name, source)
        e = whole.exchanges
        contents += [(name, fingerprint_of(e.time_ns, e.range_m))] if len(e) else []
        refuse_repeated(contents)
        found, view = _examine_recording(whole)
        prefix = f"{name}: " if len(recordings) > 1 else ""
        findings += [replace(finding, evidence=prefix + finding.evidence) for finding in found]
        views += [view] if view else []
    if len(views) > 1:
        between = _run_stage("between", views, FINDING_LEVEL)
        # Changes between two recordings are not faults of either one.
        moved = any(finding.fault == "anchor moved between recordings" for finding in between)
        findings = [one for one in findings if not (moved and one.fault == "anchor stands elsewhere")] + between
    if views and len(views) == len(recordings) and all(view.standing for view in views):
        findings += _run_stage("survey", recordings)
    order = [fault for check in CHECKS for fault in check.remedies]
    return sorted(findings, key=lambda finding: order.index(finding.fault))


def _run_stage(stage: str, *given: Any) -> list[Finding]:
    return [
        found for check in CHECKS if check.stage == stage for found in check.findings(check.look(*given), FINDING_LEVEL)
    ]


def _examine_recording(view: RecordingView) -> tuple[list[Finding], RecordingView | None]:
    """Return the faults of one recording, and the recording without its impossible rows, if it can be used."""
    for check in CHECKS:
        # With such a fault, the other numbers of a recording have another meaning.
        if check.stage == "reading" and (misread := check.findings(check.look(view), FINDING_LEVEL)):
            return misread, None
    findings = _run_stage("rows", view)
    bad = columns.impossible(view)
    # The remaining rows may be possible only by chance.
    if bad.mean() >= 0.5:
        return findings, None
    view = view.chosen(~bad)
    if any(finding.fault == "unit of the powers" for finding in findings):
        unknown = np.full(len(view.exchanges), np.nan)
        view = replace(view, ranges=replace(view.ranges, fpp1_dbm=unknown, fpp2_dbm=unknown))
    # Checks of poses need sound stamps, and checks of radios need sound poses.
    findings += _best_geometry_fault(view) or _run_stage("radio", view)
    findings += _run_stage("structure", view)
    implied = set[str]().union(*(IMPLIED.get(finding.fault, ()) for finding in findings))
    return [finding for finding in findings if finding.fault not in implied], view


def _best_geometry_fault(view: RecordingView) -> list[Finding]:
    """Return the fault of poses or lever arms that explains most of the errors."""
    tried = [check for check in CHECKS if check.stage == "geometry"]
    seen = [(check, [one for one in check.look(view) if one.p_value < FINDING_LEVEL]) for check in tried]
    check, best = max(seen, key=lambda one: sum(fault.gain for fault in one[1]))
    return check.findings(best, FINDING_LEVEL)
