"""What stands in the report of a campaign, in order: a table of sections, which `register_report_section` adds to."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from calib.errors import BadInputError
from calib.report import error_sections, sections
from calib.report.blocks import Block, Document, Heading, Text
from calib.report.campaign import Campaign
from calib.report.localization_section import localization
from calib.report.provenance import provenance, warnings
from calib.report.verdict import Judged, verdict

Section = Callable[[Campaign], list[Block]]
"""Returns what stands in a section, its heading included; nothing where there is nothing to tell."""

PROVENANCE: Final = "provenance"
TITLE: Final = "Calibration of ultra-wideband ranges"


def register_report_section(name: str, section: Section, *, before: str = PROVENANCE) -> None:
    """Add a section to the report of a campaign, above the one called `before`.

    `section` takes the `Campaign` and returns blocks (`calib.report.blocks`: `Heading`, `Text`, `Table`, `Picture`,
    `Listing`), which appear in the HTML page and in the PDF; figures are drawn at the width they are asked for.
    Raises `BadInputError` for a name that is taken and for a `before` that is not there.

    >>> import calib
    >>> from calib.report.blocks import Heading, Text
    >>> def weather(campaign):
    ...     return [Heading("Weather"), Text(f"Dry, for all {len(campaign.judged)} ranges.")]
    >>> calib.register_report_section("weather", weather, before="outliers")

    And out again:

    >>> from calib.report.layout import SECTIONS
    >>> del SECTIONS["weather"]
    """
    if name in SECTIONS:
        raise BadInputError(f"a section {name!r} is there already; choose another name", parameter="name")
    if before not in SECTIONS:
        raise BadInputError(f"found {before!r}, allowed: {', '.join(SECTIONS)}", parameter="before")
    if not callable(section):
        raise BadInputError(f"found {section!r}, expected a function of a campaign", parameter="section")
    rows = list(SECTIONS.items())
    rows.insert(list(SECTIONS).index(before), (name, section))
    SECTIONS.clear()
    SECTIONS.update(rows)


def document(campaign: Campaign) -> Document:
    """Return the report of a campaign."""
    blocks = [block for name, section in SECTIONS.items() for block in _checked(name, section(campaign))]
    return Document(TITLE, blocks, campaign.origin.sentence())


def _checked(name: str, blocks: object) -> list[Block]:
    """Return the blocks of a section; raises `BadInputError` where a function returned something else."""
    if not isinstance(blocks, list) or not all(isinstance(block, Block) for block in blocks):
        raise BadInputError(
            f"report section {name!r}: returned {blocks!r:.60}, expected a list of blocks "
            "(Heading, Text, Table, Picture or Listing)"
        )
    return blocks


def _verdict(campaign: Campaign) -> list[Block]:
    on_what = "the tests" if campaign.tests else "the recordings it was fitted from"
    judged = Judged(
        calibration=campaign.calibration,
        ranges=campaign.judged,
        corrected=campaign.corrected,
        evaluation=campaign.evaluation,
        held_out=bool(campaign.tests) and not campaign.evaluation.seen,
        warnings=campaign.fit.warnings,
        faults=[f"{name}: {finding.fault}" for name, finding in campaign.findings],
        tracks=campaign.tracks,
    )
    return [*verdict(judged), Text(sections.summary(campaign.evaluation, on_what), "lead")]


def _warned(campaign: Campaign) -> list[Block]:
    told = [*campaign.fit.warnings]
    if not campaign.tests:
        told.append("no tests were given: the figures below are of the recordings that the fit has seen")
    told += [f"{name}: {f.fault}. {_sentence(f.evidence)} {_sentence(f.remedy)}" for name, f in campaign.findings]
    return warnings(told)


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + "."


def _recorded(campaign: Campaign) -> list[Block]:
    return [Heading("What was recorded"), sections.recordings(campaign.training, campaign.tests, campaign.origin.files)]


def _determined(campaign: Campaign) -> list[Block]:
    told = sections.determined(campaign.trained, campaign.calibration, campaign.fit)
    return [Heading("Is it determined?"), *told]


def _delays(campaign: Campaign) -> list[Block]:
    planted, truth = campaign.evaluation.planted, campaign.trained.planted or {}
    return [
        Heading("Antenna delays"),
        *sections.delays(campaign.calibration, planted, truth, campaign.heard),
        *sections.sensitivity(campaign.calibration, campaign.refits),
    ]


def _curves(campaign: Campaign) -> list[Block]:
    trained = campaign.trained
    return error_sections.curves(trained, campaign.calibration.apply(trained), campaign.calibration)


def _before_after(campaign: Campaign) -> list[Block]:
    return [
        Heading("Before and after"),
        *error_sections.before_after(campaign.evaluation),
        *error_sections.errors(campaign.judged, campaign.corrected, campaign.calibration),
    ]


def _outliers(campaign: Campaign) -> list[Block]:
    return [Heading("Outliers"), *error_sections.outliers(campaign.judged, campaign.corrected)]


def _over_time(campaign: Campaign) -> list[Block]:
    return error_sections.over_time(campaign.tests or campaign.training, campaign.calibration)


SECTIONS: Final[dict[str, Section]] = {
    "verdict": _verdict,
    "warnings": _warned,
    "recordings": _recorded,
    "determined": _determined,
    "delays": _delays,
    "curves": _curves,
    "before and after": _before_after,
    "outliers": _outliers,
    "localization": lambda campaign: localization(campaign.tracks),
    "over time": _over_time,
    PROVENANCE: lambda campaign: provenance(campaign.calibration, campaign.origin),
}
