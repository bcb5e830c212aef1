"""The report of an evaluation: how a calibration does on recordings, as one HTML page or PDF, and its figures."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from calib.calibration.model import Calibration, require_calibration
from calib.data.ranges import Ranges, concatenate
from calib.data.sources import Data, each, load_each
from calib.evaluation.statistics import Evaluation, evaluate
from calib.report import error_sections, sections
from calib.report.blocks import Document, Heading, Text
from calib.report.origin import Origin, origin_of
from calib.report.provenance import provenance, warnings
from calib.report.verdict import Judged, verdict
from calib.report.without_truth import foundations
from calib.report.writing import check_places, html_of, write_document


def render(data: Data | Iterable[Data], calibration: Calibration) -> str:
    """Return the report of an evaluation as HTML text; `data` is what `load_ranges` takes."""
    recordings = each(data)
    return html_of(_evaluated(load_each(recordings), calibration, None, origin_of(recordings)))


def write_report(
    path: str | os.PathLike[str] | None,
    data: Data | Iterable[Data],
    calibration: Calibration,
    *,
    figures: str | os.PathLike[str] | None = None,
    evaluation: Evaluation | None = None,
    origin: Origin | None = None,
    force: bool = False,
) -> None:
    """Evaluate a calibration on recordings and write what came out as one HTML file, or as PDF where it ends so.

    `data` is what `load_ranges` takes. `figures` is a folder for the figures at paper size (PDF and SVG); without a
    `path` they are all that is written. An `evaluation` of the same recordings is taken instead of another one, and
    `origin` as what the report says of where it comes from. Raises what `Calibration.apply`, `load_ranges` and
    `check_output` raise; nothing is written then. The report of a whole campaign is `run_campaign(...).write(path)`.

    >>> import calib, pathlib, tempfile
    >>> flight = calib.sample_flight(300)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     page = pathlib.Path(folder) / "report.html"
    ...     calib.write_report(page, flight, calib.fit(flight).calibration)
    ...     "Before and after" in page.read_text()
    True
    """
    require_calibration(calibration)
    output, folder = (None if place is None else Path(place) for place in (path, figures))
    check_places(output, None, folder, force=force)
    recordings = each(data)
    need_power = calibration.needs_power
    document = _evaluated(
        load_each(recordings, need_power=need_power), calibration, evaluation, origin or origin_of(recordings)
    )
    write_document(document, output, None, folder, force=force)


def _evaluated(
    recordings: list[Ranges], calibration: Calibration, known: Evaluation | None, origin: Origin
) -> Document:
    ranges = concatenate(recordings)
    evaluation, applied = known or evaluate(ranges, calibration), calibration.apply(ranges)
    told = calibration.provenance.get("warnings", [])
    judged = Judged(
        calibration=calibration,
        ranges=ranges,
        corrected=applied,
        evaluation=evaluation,
        held_out=not evaluation.seen,
        warnings=told,
    )
    return Document(
        "Calibration report",
        [
            *verdict(judged),
            Text(sections.summary(evaluation), "lead"),
            *warnings(told),
            Heading("Recordings"),
            sections.recordings(recordings, None, origin.files),
            *foundations(calibration),
            Heading("Antenna delays"),
            *sections.delays(calibration, evaluation.planted, ranges.planted or {}, {}),
            Heading("Before and after"),
            *error_sections.before_after(evaluation),
            *error_sections.errors(ranges, applied, calibration),
            *error_sections.curves(ranges, applied, calibration),
            *error_sections.over_time(recordings, calibration),
            *provenance(calibration, origin),
        ],
        origin.sentence(),
    )
