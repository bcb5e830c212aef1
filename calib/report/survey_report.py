"""The report of a survey: its verdict, what it rests on, delays and curve, without any recording to judge it on."""

from __future__ import annotations

import os
from pathlib import Path

from calib.calibration.model import Calibration, curve_rows, require_calibration
from calib.report import sections
from calib.report.blocks import Document, Heading, Table, Text
from calib.report.grades import BAD, Criterion, judgement
from calib.report.origin import Origin, origin_of
from calib.report.provenance import provenance, warnings
from calib.report.verdict import settled
from calib.report.without_truth import criteria, foundations
from calib.report.writing import check_places, write_document

UNSEEN = (
    "Nothing of this was held against a true distance. Where a recording has them, evaluate the calibration "
    "on it: the report of that evaluation has this section, too."
)


def write_survey_report(
    path: str | os.PathLike[str],
    calibration: Calibration,
    *,
    origin: Origin | None = None,
    force: bool = False,
) -> None:
    """Write what a calibration without known distances rests on and whether it is fit for use, as HTML or .pdf.

    It needs no recording: everything stands in the calibration. Raises what `check_output` raises.
    """
    require_calibration(calibration)
    check_places(Path(path), None, None, force=force)
    write_document(_document(calibration, origin or origin_of([])), Path(path), None, None, force=force)


def _document(calibration: Calibration, origin: Origin) -> Document:
    told = list(map(str, calibration.provenance.get("warnings", [])))
    power, *curves = curve_rows(calibration)
    return Document(
        "Report of a calibration without motion capture",
        [
            *judgement([*_converged(calibration), *settled(calibration), *criteria(calibration)]),
            Text(UNSEEN, "lead"),
            *warnings(told),
            *foundations(calibration),
            Heading("Antenna delays"),
            *sections.delays(calibration, None, {}, {}),
            Heading("Bias and spread over power"),
            Table(list(power), [list(row) for row in curves]),
            *provenance(calibration, origin),
        ],
        origin.sentence(),
    )


def _converged(calibration: Calibration) -> list[Criterion]:
    if calibration.provenance.get("converged", True):
        return []
    return [Criterion("Did the search settle?", "yes", "no", BAD, "the search stopped before it settled")]
