"""The reports: of an evaluation, and of a whole campaign from recordings to localization."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from calib.calibration.model import Calibration, write_bytes, write_text
from calib.doctor.base import Finding
from calib.estimation.fitting import FitResult
from calib.estimation.passive_listeners import OverheardDelay
from calib.evaluation.localization import Localization
from calib.evaluation.statistics import Evaluation, evaluate
from calib.ranges import Ranges, concatenate
from calib.report import sections
from calib.report.blocks import Block, Document, Heading, Listing, Text, rendered
from calib.report.html import to_html
from calib.report.localization_section import localization

PAPER_KINDS: Final = ("pdf", "svg")
Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Campaign:
    """Everything that a report tells of: what was fitted from which recordings, and how it does on which tests.

    `refits` are calibrations for other scales of the loss, by scale in ns; `heard` delays as passive listeners see
    them; `findings` the doctor's, by recording.
    """

    training: list[Ranges]
    tests: list[Ranges]
    fit: FitResult
    refits: dict[float, Calibration] = field(default_factory=dict)
    heard: dict[int, OverheardDelay] = field(default_factory=dict)
    findings: list[tuple[str, Finding]] = field(default_factory=list)
    tracks: list[Localization] = field(default_factory=list)

    @property
    def calibration(self) -> Calibration:
        """Return the calibration that was fitted."""
        return self.fit.calibration

    def evaluation(self) -> Evaluation:
        """Evaluate on the tests, or on the training where there are none."""
        return evaluate(concatenate(self.tests or self.training), self.calibration)


def render(recordings: Sequence[Ranges], calibration: Calibration) -> str:
    """Return the report of an evaluation as HTML text."""
    return _html(_evaluated(list(recordings), calibration))


def write_report(path: Path, recordings: Sequence[Ranges], calibration: Calibration, *, force: bool = False) -> None:
    """Evaluate a calibration on recordings and write what came out as one HTML file.

    Raises what `Calibration.apply` and `check_output` raise; nothing is written then.
    """
    write_text(path, render(recordings, calibration), force=force)


def write_campaign(
    campaign: Campaign,
    html: Path,
    pdf: Path | None = None,
    figures: Path | None = None,
    *,
    force: bool = False,
    progress: Progress = lambda _: None,
) -> None:
    """Write the report of a campaign as HTML, as PDF and as figures at paper size (PDF and SVG) in a folder."""
    document = _campaign(campaign)
    pictures: dict[str, bytes] = {}
    files: dict[str, bytes] = {}
    for picture in document.pictures():
        progress(f"drawing {picture.name}")
        figure = picture.draw()
        pictures[picture.name] = rendered(figure, "png")
        if figures:
            files |= {f"{picture.name}.{kind}": rendered(figure, kind, 200) for kind in PAPER_KINDS}
    text = to_html(document, pictures)
    if pdf:
        from calib.report.pdf import to_pdf

        progress("setting the PDF")
        write_bytes(pdf, to_pdf(document, pictures), force=force)
    if figures:
        figures.mkdir(parents=True, exist_ok=True)
        for name, data in files.items():
            write_bytes(figures / name, data, force=True)
    write_text(html, text, force=force)


def _html(document: Document) -> str:
    return to_html(document, {p.name: rendered(p.draw(), "png") for p in document.pictures()})


def _evaluated(recordings: list[Ranges], calibration: Calibration) -> Document:
    ranges = concatenate(recordings)
    evaluation, applied = evaluate(ranges, calibration), calibration.apply(ranges)
    return Document(
        "Calibration report",
        [
            Text(sections.summary(evaluation), "lead"),
            *_warnings(calibration.provenance.get("warnings", [])),
            Heading("Recordings"),
            sections.recordings(recordings),
            Heading("Antenna delays"),
            *sections.delays(calibration, evaluation.planted, ranges.planted or {}, {}),
            Heading("Before and after"),
            *sections.before_after(evaluation),
            *sections.errors(ranges, applied, calibration),
            *sections.curves(ranges, applied, calibration),
            *sections.over_time(recordings, calibration),
            *_provenance(calibration),
        ],
    )


def _campaign(campaign: Campaign) -> Document:
    calibration, training = campaign.calibration, concatenate(campaign.training)
    judged = campaign.tests or campaign.training
    ranges = concatenate(judged)
    evaluation, applied = campaign.evaluation(), calibration.apply(ranges)
    trained = calibration.apply(training)
    on_what = "the tests" if campaign.tests else "the recordings it was fitted from"
    warnings = [*campaign.fit.warnings]
    if not campaign.tests:
        warnings.append("no tests were given: the figures below are of the recordings that the fit has seen")
    warnings += [f"{name}: {f.fault}. {_sentence(f.evidence)} {_sentence(f.remedy)}" for name, f in campaign.findings]
    blocks: list[Block] = [
        Text(sections.summary(evaluation, on_what), "lead"),
        *_warnings(warnings),
        Heading("What was recorded"),
        sections.recordings(campaign.training, campaign.tests),
        Heading("Is it determined?"),
        *sections.determined(training, calibration, campaign.fit),
        Heading("Antenna delays"),
        *sections.delays(calibration, evaluation.planted, training.planted or {}, campaign.heard),
        *sections.sensitivity(calibration, campaign.refits),
        *sections.curves(training, trained, calibration),
        Heading("Before and after"),
        *sections.before_after(evaluation),
        *sections.errors(ranges, applied, calibration),
        Heading("Outliers"),
        *sections.outliers(ranges, applied),
        *localization(campaign.tracks),
        *sections.over_time(judged, calibration),
        *_provenance(calibration),
    ]
    return Document("Calibration of ultra-wideband ranges", blocks)


def to_dict(campaign: Campaign) -> dict[str, Any]:
    """Return what `calib report --json` prints."""
    from dataclasses import asdict

    from calib.evaluation.localization import FILTERS, summarize

    calibration = campaign.calibration
    document: dict[str, Any] = {
        "calibration": json.loads(calibration.to_json()),
        "warnings": campaign.fit.warnings,
        "evaluation": campaign.evaluation().to_dict(),
        "heard": {str(tag): asdict(heard) for tag, heard in campaign.heard.items()},
        "findings": [{"recording": name} | asdict(finding) for name, finding in campaign.findings],
    }
    if campaign.tracks:
        document["localization"] = {
            "scenarios": [
                {"recording": t.source, "body": t.body, "rmse_m": {s: t.tracks[s].rmse_m for s in FILTERS}}
                for t in campaign.tracks
            ],
            "summary": asdict(summarize(campaign.tracks)),
        }
    return document


def _warnings(sentences: list[str]) -> list[Block]:
    return [Text(f"Warning: {sentence}", "warning") for sentence in sentences]


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + "."


def _provenance(calibration: Calibration) -> list[Block]:
    return [Heading("Provenance"), Listing(json.dumps(calibration.provenance, indent=1))]
