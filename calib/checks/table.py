"""The table of checks: each one's question, statistic, distribution on sound data, and remedies."""

from __future__ import annotations

from typing import Final

from calib.checks import clocks, columns, geometry, offsets, pairs, reflected, surveys
from calib.findings import BUDGET, CERTAIN, OF_A_FIT, Check

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
            columns.POSES: "divide x y z of the poses by {many}, add them again: uwblink poses ... --from FILE; or "
            'import again with [units] distance = "{unit}" where the table has them',
            columns.TRUTH: 'import again with [units] distance = "{unit}", or divide gt_range_m by {many}',
            columns.RANGES: 'import again with [units] distance = "{unit}"',
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
        {geometry.ELSEWHERE: "measure the place of {body} again, and see whose number it has"},
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
            "bodies or antennas{advice}",
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
            clocks.BLIND: "range in both directions of every pair, so that half of the skew's sign is the other way; "
            "or record the carrier integrator, or use double-sided ranging"
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
        "Were powers measured?",
        "share of exchanges with one, below a half", CERTAIN,
        {
            "no powers": "import powers as fpp1 and fpp2; without them only delays can be fitted, by `delays_only`",
        },
        pairs.unpowered,
    ),
    Check(
        "Are true distances known?",
        "share of exchanges with one, below a half", CERTAIN,
        {
            "no true distances": "add motion capture with uwblink poses, or measured distances in gt_range_m; without "
            "any, survey boards that stood still, and fit moving ones with the truth from ranges"
        },
        pairs.no_truth,
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
