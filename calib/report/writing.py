"""Reports of evaluations and of surveys, and figures without a report, as files."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

from calib import figures as drawings
from calib.calibration.comparison import CalibrationComparison
from calib.calibration.model import Calibration, CalibrationSource, given_calibration
from calib.data.sources import Data, each, load_each
from calib.errors import BadInputError
from calib.evaluation.localization import Localization
from calib.evaluation.onboard import OnboardTrack
from calib.evaluation.statistics import Evaluation
from calib.report.error_sections import track_name
from calib.report.figures import onboard, rmse_bars, track
from calib.report.results import Origin, Results, origin_of
from calib.report.sections import document
from uwblink.output import check_folder, check_output
from uwblink.pages.blocks import Block, Document, Picture, write_document


def check_places(output: Path | None, pdf: Path | None, figures: Path | None, *, force: bool) -> None:
    """Check the output files of a report before anything is computed.

    Raises what `check_output` and, for a folder of `figures`, `check_folder` raise, and `BadInputError` for a `pdf`
    that is the `output` and for a folder that holds figures already.
    """
    for path in filter(None, (output, pdf)):
        check_output(path, force=force)
    if pdf is not None and output is not None and output.resolve() == pdf.resolve():
        raise BadInputError(f"{output} is the page already; give the PDF another name", parameter="pdf")
    if figures is not None:
        check_folder(figures)
        if not force and any(path.suffix in (".pdf", ".svg") for path in figures.glob("*.*")):
            text = "holds figures already; give another folder, or `force` to replace them"
            raise BadInputError(f"{figures} {text}", parameter="figures")


def write_report(
    path: str | os.PathLike[str] | None,
    data: Data | Iterable[Data],
    calibration: CalibrationSource,
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
    calibration = given_calibration(calibration)
    output, folder = (None if place is None else Path(place) for place in (path, figures))
    check_places(output, None, folder, force=force)
    recordings = each(data)
    loaded = load_each(recordings, need_power=calibration.needs_power)
    made = origin or origin_of(recordings)
    results = Results(calibration=calibration, tests=loaded, evaluated=evaluation, origin=made)
    write_document(document(results, "Calibration report"), output, None, folder, force=force)


def write_survey_report(
    path: str | os.PathLike[str], calibration: CalibrationSource, *, origin: Origin | None = None, force: bool = False
) -> None:
    """Write what a calibration without known distances rests on and whether it is fit for use, as HTML or .pdf.

    It needs no recording: everything stands in the calibration. Raises what `check_output` raises.
    """
    calibration = given_calibration(calibration)
    check_places(Path(path), None, None, force=force)
    results = Results(calibration=calibration, origin=origin or origin_of([]))
    title = "Report of a calibration without motion capture"
    write_document(document(results, title), Path(path), force=force)


def write_track_figures(
    found: Sequence[Localization] | Sequence[OnboardTrack], folder: Path, *, force: bool = False
) -> None:
    """Write each body's track into a folder, as PDF and SVG at two widths; of filters also bars of their RMSE.

    Raises what `check_places` raises.
    """
    compared = [one for one in found if isinstance(one, Localization)]
    pictures = [Picture("rmse", partial(rmse_bars, found=compared), "RMSE")] if compared else []
    for one in found:
        draw = partial(track, one=one) if isinstance(one, Localization) else partial(onboard, one=one)
        pictures.append(Picture(track_name(one.source, one.body), draw, one.body))
    _write_figures(pictures, folder, force)


def write_comparison_figures(
    found: CalibrationComparison,
    known: Sequence[Calibration],
    names: Sequence[str],
    folder: Path,
    *,
    force: bool = False,
) -> None:
    """Write the differences of delays and both calibrations' curves into a folder; `names` label the calibrations."""
    pictures = [
        Picture("differences", partial(drawings.differences, found=found), "Delays"),
        Picture("curves", partial(drawings.both_curves, known=known, names=names), "Curves"),
    ]
    _write_figures(pictures, folder, force)


def _write_figures(pictures: Sequence[Block], folder: Path, force: bool) -> None:
    check_places(None, None, folder, force=force)
    write_document(Document("", list(pictures)), None, None, folder, force=force)
