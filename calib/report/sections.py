"""The sections of a report: a table of functions that return blocks, given `Results`.

A section returns its blocks with its heading, or an empty list. A new section is a function and a row of `SECTIONS`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from math import isfinite, isnan, nan
from pathlib import Path
from typing import Any, Final

import numpy as np

from calib import figures
from calib.calibration.document import pair_name, reading_provenance
from calib.calibration.model import known_facts
from calib.calibration.model import pair_rows as offset_rows
from calib.errors import BadInputError
from calib.evaluation.statistics import CORRECTION_STAGES, pair_rows
from calib.report import error_sections
from calib.report.results import Results
from calib.report.verdict import capitalized, undetermined_delays, verdict
from calib.spread import TWO_SIDED_95
from calib.surveys.figures import board_figure
from calib.surveys.result import SurveyedArrangement
from uwblink.pages.blocks import Block, Document, Heading, Listing, Picture, Table, Text

Section = Callable[[Results], list[Block]]
"""A function that returns the blocks of a section with its heading; an empty list if it does not apply."""


def of_recordings(section: Section) -> Section:
    """Return a section that is empty for results without recordings."""
    return lambda results: section(results) if results.recordings else []


def _verdict(results: Results) -> list[Block]:
    without_truth = (
        "These results were not compared with true distances. If a recording has true distances, evaluate the "
        "calibration on it: the report of that evaluation contains this section as well."
    )
    return [*verdict(results), Text(_summary(results) if results.recordings else without_truth, "lead")]


def _summary(results: Results) -> str:
    """Return a summary of the errors, in a few sentences."""
    group, where = results.evaluation.overall, ""
    if results.fit is not None:
        where = " of the tests" if results.tests else " of the recordings it was fitted from"
        where = " that were held out from a second fit" if results.part else where
    stages = [getattr(group, stage) for stage in CORRECTION_STAGES]
    medians, means = (
        f"{100 * raw:+.1f} cm (raw) to {100 * delays:+.1f} cm (delays corrected) and {100 * full:+.1f} cm (fully "
        "corrected)"
        for raw, delays, full in ([one.median_m for one in stages], [one.mean_m for one in stages])
    )
    return (
        f"Over {group.raw.n} ranges{where} the median error goes from {medians}. The mean, which contains the "
        f"reflections that remain, goes from {means}; the standard "
        f"deviation from {100 * group.raw.std_m:.1f} to {100 * group.full.std_m:.1f} cm, its robust estimate from "
        f"{100 * group.raw.robust_std_m:.1f} to {100 * group.full.robust_std_m:.1f} cm. "
        f"{100 * (1 - group.rejected):.1f} % of the corrected ranges are within the bounds of noise (95 % "
        f"without reflections), with a mean of {100 * group.accepted.mean_m:+.1f} cm and a standard deviation of "
        f"{100 * group.accepted.std_m:.1f} cm; the other {100 * group.rejected:.1f} % are mostly reflected ranges, "
        f"which a calibration cannot correct and a filter's gate rejects."
    )


def _warnings(results: Results) -> list[Block]:
    warnings = [
        *results.warnings,
        "no tests were given: the figures below are of the fitted recordings"
        if results.fit is not None and not results.tests
        else "",
        "no tests were given: errors below are those of a second fit on held-out parts of the recordings; on another "
        "day they are larger"
        if results.part is not None
        else "",
        *(
            # A remedy may end with lines of a file, which no full stop may follow.
            f"{name}: {one.fault}. {capitalized(one.evidence)}. {capitalized(one.remedy)}"
            for name, one in results.findings
        ),
    ]
    return [Text(f"Warning: {sentence}", "warning") for sentence in warnings if sentence]


def _recordings(results: Results) -> list[Block]:
    """Return a table with a row per recording, with the first 12 digits of the SHA-256 of the files of its name."""
    digests: dict[str, list[str]] = {}
    for path, digest in results.origin.files.items():
        digests.setdefault(Path(path).name, []).append(digest[:12])
    tested = "test" if results.part is None else "held out"
    uses = [("fit", r) for r in results.training] + [(tested, r) for r in results.tests]
    header = ["recording", "use", "ranges", "seconds", "tags", "pairs", "protocol", "left out", "SHA-256"]
    rows = [
        [
            r.source,
            use,
            str(len(r)),
            f"{(r.time_ns.max() - r.time_ns.min()) * 1e-9:.0f}",
            ", ".join(map(str, r.tags())),
            str(len(pair_rows(r))),
            ", ".join(sorted(set(np.unique(r.protocol).tolist()))),
            ", ".join(f"{n} {why}" for why, n in r.excluded.items()) or "none",
            " or ".join(digests.get(r.source, ["in memory"])),
        ]
        for use, r in uses
    ]
    return [Heading("What was recorded"), Table(header, rows)]


@reading_provenance()
def _foundations(results: Results) -> list[Block]:
    """Return the facts that a fit used instead of known distances; an empty list if distances were known."""
    provenance = results.calibration.provenance
    if provenance.get("recipe") == "survey":
        return [Heading("Known facts"), *_of_survey(provenance)]
    summary = known_facts(provenance)
    if not summary:
        return []
    facts, off = provenance["geometry"], provenance.get("distance_std_m")

    def names(key: str) -> str:
        return ", ".join(map(str, facts.get(key) or [])) or "none"

    rows = [
        ["moving bodies", names("moving")],
        ["positions known for", f"{float(facts.get('known_s', 0.0)):.1f} s"],
        ["anchors at given positions", names("anchors_given")],
        ["anchors at estimated positions", names("anchors_sought")],
        ["attitudes from", str(facts.get("attitudes", "nowhere"))],
        ["measured distances", str(facts.get("distances", 0))],
        ["heights of", names("heights")],
        ["standard error of estimated distances", f"{100 * off:.1f} cm" if isinstance(off, int | float) else ""],
        ["undetermined", str(provenance.get("undetermined_text", ""))],
    ]
    return [
        Heading("Known facts"),
        Text(f"No true distance was known: {summary}. Trajectories were estimated together with the delays."),
        Table(["fact", "value"], [row for row in rows if row[1]], words=True),
    ]


def _of_survey(made: Any) -> list[Block]:
    def counted(count: int, what: str) -> str:
        return f"{count or 'no'} {what}{'s' * (count != 1)}"

    geometry = made["geometry"]
    beside = [
        counted(int(geometry.get("known_distances", 0)), "known distance"),
        counted(int(geometry.get("known_positions", 0)), "known position"),
        counted(len(made.get("fixed_ns", {})), "known delay"),
    ]
    blocks: list[Block] = [
        Text(
            f"No true distance was known. {counted(int(made['pairs']), 'mean range')} of pairs in "
            f"{counted(len(geometry['arrangements']), 'arrangement')} of boards that stood still determine positions "
            f"and delays, together with {', '.join(beside)}. A pair has a constant error of "
            f"{100 * float(geometry['pair_error_m']):.1f} "
            f"cm in an arrangement; {float(geometry['freedom']):.0f} degrees of freedom are left."
        )
    ]
    surveyed = [SurveyedArrangement.from_dict(row) for row in made.get("surveyed", [])]
    if not surveyed:
        return blocks
    rows = [
        [one.name, ", ".join(str(board.tag) for board in one.boards), one.known or "nothing", _within(one), one.frame]
        for one in surveyed
    ]
    caption = (
        "Positions of the boards from above, with 95 % ellipses; small ellipses are drawn dashed and ten times as "
        "large."
    )
    header = ["arrangement", "boards", "known shape", "uncertainty of positions (95 %)", "frame"]
    blocks += [Table(header, rows, words=True), Picture("places", partial(board_figure, surveyed), caption)]
    reflected = [
        [row["arrangement"], pair_name(row["between"]), f"{100 * row['longer_m']:+.0f}", f"{100 * row['chance']:.0f} %"]
        for row in made.get("reflected", [])
    ]
    if reflected:
        blocks += [
            Text("Pairs that are, or may be, reflected; they have less weight:"),
            Table(["arrangement", "pair", "longer by (cm)", "probability"], reflected),
        ]
    return blocks


def _within(one: SurveyedArrangement) -> str:
    """Return the half interval of the least known position of an arrangement's boards, in words."""
    far = [board.within_m for board in one.boards if board.determined]
    return f"± {100 * max(far):.1f} cm" if far else "undetermined"


def _determined(results: Results) -> list[Block]:
    """Return whether the pairs determine all delays, and the settings of the fit."""
    if results.fit is None:
        return []
    calibration, pairs = results.calibration, pair_rows(results.trained)
    good = f"Yes: the {len(pairs)} pairs of {len(results.trained.tags())} tags determine all delays."
    answer = f"No: {undetermined_delays(results)}." if undetermined_delays(results) else good
    counts = [int(np.count_nonzero(rows)) for rows in pairs.values()]
    changed = calibration.provenance.get("settings", {})
    settings = f" Settings: {', '.join(f'{name} = {value}' for name, value in changed.items())}." if changed else ""
    return [
        Heading("Are the delays determined?"),
        Text(
            f"{answer} The rarest pair has {min(counts)} ranges, the most frequent {max(counts)}. The fit "
            f"{results.fit.message}, with the {calibration.loss} loss at a scale of {calibration.scale_ns:.3f} ns; its "
            f"standard errors are a {calibration.provenance.get('standard_errors', 'sandwich')}, so persistent "
            f"errors do not count as independent." + settings
        ),
        Text(
            "The parts of a delay in transmission and reception cannot be determined from stamps of free-running "
            "clocks, not even with overheard exchanges, because a shift of a tag's clock changes both. If both are "
            "needed, 0.44 of a delay is transmission and 0.56 reception by convention."
        ),
    ]


def _delays(results: Results) -> list[Block]:
    """Return delays with intervals, and planted and overheard delays if there are any."""
    calibration, heard = results.calibration, results.heard
    of_pairs: list[Block] = []
    if calibration.pair_constants:
        rows = [list(row) for row in offset_rows(calibration)]
        of_pairs = [Table(["pair", "ranges too long by (cm)", "interval"], rows)]
    if calibration.pair_offsets or len(calibration.sides) == len(calibration.delays_ns):
        return [Heading("Antenna delays"), *of_pairs]
    planted = results.planted if results.recordings else None
    truth: dict[str, Any] = (results.trained.planted or {}).get("delays_ns", {}) if planted else {}
    known = {int(tag): float(delay) for tag, delay in truth.items()}
    shift = planted.shift_ns if planted else 0.0
    delays = {tag: delay for tag, delay in sorted(calibration.delays_ns.items()) if tag not in calibration.sides}
    half = {tag: TWO_SIDED_95 * calibration.delays_std_ns.get(tag, nan) for tag in delays}
    unknown = {tag: "not stated" if isnan(one) else "undetermined" for tag, one in half.items() if not isfinite(one)}
    errors_ns = planted.delay_error_ns if planted else {}
    columns = {
        "tag": list(map(str, delays)),
        "delay (ns)": [f"{delay:+.4f}" for delay in delays.values()],
        "95 % from": [unknown.get(tag, f"{delay - half[tag]:+.4f}") for tag, delay in delays.items()],
        "to": ["" if tag in unknown else f"{delay + half[tag]:+.4f}" for tag, delay in delays.items()],
        "planted, same gauge (ns)": [f"{known[tag] + shift:+.4f}" if tag in known else "" for tag in delays],
        "difference (ps)": [f"{1e3 * errors_ns[tag]:+.1f}" if tag in errors_ns else "" for tag in delays],
        "by listeners (ns)": [f"{heard[tag].delay_ns:+.4f}" if tag in heard else "" for tag in delays],
        "± 1 std": [f"{heard[tag].std_ns:.4f}" if tag in heard else "" for tag in delays],
    }
    columns = {name: cells for name, cells in columns.items() if any(cells)}
    table = Table(list(columns), list(map(list, zip(*columns.values(), strict=True))))
    caption = "Antenna delays with their 95 % intervals" + (", and planted delays in the same gauge." if known else ".")
    draw = partial(figures.single_figure, partial(figures.delays, calibration, known, shift))
    blocks = [Heading("Antenna delays"), *of_pairs, table, Picture("delays", draw, caption)]
    if planted:
        differs = (
            f" The bias curve differs from the planted one by {1e3 * planted.curve_rms_m:.1f} mm rms over these "
            f"ranges, the whole correction of a range by {1e3 * planted.correction_rms_m:.1f} mm."
            if isfinite(planted.curve_rms_m)
            else ""
        )
        text = (
            "A constant of the bias curve and a common shift of all delays cannot be distinguished: planted delays, "
            f"and the planted curve below, are shown after moving {shift:+.4f} ns from the curve to the delays."
            f"{differs}"
        )
        blocks.append(Text(text, "note"))
    return blocks


def _provenance(results: Results) -> list[Block]:
    """Return the origin of the report and of its calibration."""
    origin, provenance = results.origin, results.calibration.provenance
    known = {
        "report": origin.made,
        "version": origin.version,
        "command": origin.command,
        "distances": known_facts(provenance),
    }
    known |= {path: f"SHA-256 {digest}" for path, digest in origin.files.items()}
    rows = [[name, text] for name, text in known.items() if text]
    # Other sections show surveyed boards and reflected pairs as tables and figures.
    rest = {key: value for key, value in provenance.items() if key not in ("surveyed", "reflected")}
    return [Heading("Provenance"), Table(["of", "what"], rows, words=True), Listing(json.dumps(rest, indent=1))]


SECTIONS: Final[dict[str, Section]] = {
    "verdict": _verdict,
    "warnings": _warnings,
    "recordings": of_recordings(_recordings),
    "foundations": _foundations,
    "determined": _determined,
    "delays": _delays,
    "curves": error_sections.curves,
    "patterns": error_sections.patterns,
    "before and after": of_recordings(error_sections.before_after),
    "outliers": of_recordings(error_sections.outliers),
    "localization": error_sections.localization,
    "over time": of_recordings(error_sections.over_time),
    "provenance": _provenance,
}
"""The sections of a report, in order; `register_report_section` adds to it."""


def register_report_section(name: str, section: Section, *, before: str = "provenance") -> None:
    """Add a section to the reports of campaigns and of evaluations, above the section called `before`.

    `section` is a function that takes the `Results` (or a `Campaign`, which is a subclass) and returns a list of
    blocks (`calib.report`: `Heading`, `Text`, `Table`, `Picture`, `Listing`) for the HTML page and the PDF. It is not
    called for results without recordings. Raises `BadInputError` if the name exists, if `before` does not, and if
    `section` is not a function.

    >>> import calib
    >>> from calib.report import Heading, Text
    >>> def weather(campaign):
    ...     return [Heading("Weather"), Text(f"Dry, for all {len(campaign.judged)} ranges.")]
    >>> calib.register_report_section("weather", weather, before="outliers")

    Remove it again:

    >>> from calib.report.sections import SECTIONS
    >>> del SECTIONS["weather"]
    """
    if name in SECTIONS:
        raise BadInputError(f"a section {name!r} already exists; choose another name", parameter="name")
    if before not in SECTIONS:
        raise BadInputError(f"found {before!r}, allowed: {', '.join(SECTIONS)}", parameter="before")
    if not callable(section):
        raise BadInputError(f"found {section!r}, expected a function of a campaign", parameter="section")

    below = list(SECTIONS)[list(SECTIONS).index(before) :]
    SECTIONS[name] = of_recordings(section)
    for one in below:
        SECTIONS[one] = SECTIONS.pop(one)


def document(results: Results, title: str) -> Document:
    """Return a report; raises `BadInputError` if the function of a section does not return blocks."""
    blocks: list[Block] = []
    for name, section in SECTIONS.items():
        found: object = section(results)
        if not isinstance(found, list) or not all(isinstance(block, Block) for block in found):
            raise BadInputError(
                f"report section {name!r}: returned {found!r:.60}, expected a list of blocks "
                "(Heading, Text, Table, Picture or Listing)"
            )
        blocks += found
    return Document(title, blocks, results.origin.sentence())
