"""The report of an evaluation: how a calibration does on recordings, as one HTML page."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from calib.calibration.model import Calibration, require_calibration
from calib.evaluation.statistics import evaluate
from calib.ranges import Ranges, concatenate
from calib.report import sections
from calib.report.blocks import Document, Heading, Text
from calib.report.layout import provenance, warnings
from calib.report.writing import html_of
from calib.sources import Data, load_each
from uwblink.output import check_output, write_text


def render(data: Data | Iterable[Data], calibration: Calibration) -> str:
    """Return the report of an evaluation as HTML text; `data` is what `load_ranges` takes."""
    return html_of(_evaluated(load_each(data), calibration))


def write_report(
    path: str | os.PathLike[str], data: Data | Iterable[Data], calibration: Calibration, *, force: bool = False
) -> None:
    """Evaluate a calibration on recordings and write what came out as one HTML file.

    `data` is what `load_ranges` takes. Raises what `Calibration.apply`, `load_ranges` and `check_output` raise; nothing
    is written then. The report of a whole campaign is `run_campaign(...).write(path)`.

    >>> import calib, pathlib, tempfile
    >>> flight = calib.sample_flight(300)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     page = pathlib.Path(folder) / "report.html"
    ...     calib.write_report(page, flight, calib.fit(flight).calibration)
    ...     "Before and after" in page.read_text()
    True
    """
    require_calibration(calibration)
    check_output(Path(path), force=force)
    write_text(Path(path), render(data, calibration), force=force)


def _evaluated(recordings: list[Ranges], calibration: Calibration) -> Document:
    ranges = concatenate(recordings)
    evaluation, applied = evaluate(ranges, calibration), calibration.apply(ranges)
    return Document(
        "Calibration report",
        [
            Text(sections.summary(evaluation), "lead"),
            *warnings(calibration.provenance.get("warnings", [])),
            Heading("Recordings"),
            sections.recordings(recordings),
            Heading("Antenna delays"),
            *sections.delays(calibration, evaluation.planted, ranges.planted or {}, {}),
            Heading("Before and after"),
            *sections.before_after(evaluation),
            *sections.errors(ranges, applied, calibration),
            *sections.curves(ranges, applied, calibration),
            *sections.over_time(recordings, calibration),
            *provenance(calibration),
        ],
    )
