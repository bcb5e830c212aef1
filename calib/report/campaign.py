"""Reports and figures as files: of evaluations, surveys, tracks, comparisons, and campaigns.

A campaign fits a calibration, examines the recordings, localizes the bodies and evaluates the errors. `evaluate_flight`
does the fit and the evaluation for a run of a sweep.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from calib import figures as drawings
from calib.calibration.comparison import CalibrationComparison
from calib.calibration.model import Calibration, CalibrationSource, given_calibration
from calib.checks.examine import examine
from calib.data.ranges import Ranges, concatenate
from calib.data.sources import Data, each, held_open, load_each, load_ranges, opened
from calib.errors import BadInputError, UnanswerableError
from calib.evaluation.localization import Localization, localization_json, localize
from calib.evaluation.onboard import OnboardTrack
from calib.evaluation.statistics import Evaluation, evaluate
from calib.evaluation.team import RelativePose
from calib.findings import Finding
from calib.fitting.fitting import fit
from calib.fitting.passive_listeners import heard_delays
from calib.fitting.result import FitResult
from calib.report.error_sections import track_name
from calib.report.figures import onboard, rmse_bars, track
from calib.report.results import Origin, Results, origin_of
from calib.report.sections import document
from calib.settings import FitSettings
from uwblink.output import check_folder, check_output
from uwblink.pages.blocks import Block, Document, Picture, write_document


def check_places(output: Path | None, pdf: Path | None, figures: Path | None, *, force: bool) -> None:
    """Check the output files of a report.

    Raises the errors of `check_output` and, for the folder `figures`, of `check_folder`; `BadInputError` if `pdf` and
    `output` are the same file, for suffixes other than .html, .htm and .pdf, and, without `force`, for a folder that
    contains figures.
    """
    for name, path, allowed in (("output", output, (".html", ".htm", ".pdf")), ("pdf", pdf, (".pdf",))):
        if path is not None and path.suffix.lower() not in allowed:
            raise BadInputError(
                f"{path}: found {path.suffix or 'no ending'}, expected {' or '.join(allowed)}", parameter=name
            )
        if path is not None:
            check_output(path, force=force)
    if pdf is not None and output is not None and output.resolve() == pdf.resolve():
        raise BadInputError(f"{output} is also the output of the report; give the PDF another name", parameter="pdf")
    if figures is not None:
        check_folder(figures)
        if not force and any(path.suffix in (".pdf", ".svg") for path in figures.glob("*.*")):
            text = "already contains figures; give another folder, or replace them with `force`"
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
    """Evaluate a calibration on recordings and write a report, as one HTML file or as PDF (.pdf).

    `data` is as for `load_ranges`. `figures` is a folder for the figures at paper size (PDF and SVG); without a `path`
    only these are written. `evaluation` is an existing evaluation of the same recordings, and `origin` the origin that
    the report states; both are computed by default. Raises the errors of `Calibration.apply`, `load_ranges` and
    `check_output`, and writes nothing then. For a fit with its report, use `run_campaign(...).write(path)`.

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
    results = Results(
        calibration=calibration, tests=loaded, evaluated=evaluation, origin=origin or origin_of(recordings)
    )
    write_document(document(results, "Calibration report"), output, None, folder, force=force)


def write_survey_report(
    path: str | os.PathLike[str], calibration: CalibrationSource, *, origin: Origin | None = None, force: bool = False
) -> None:
    """Write a report of a calibration without known distances, as HTML or PDF (.pdf): its known facts and a verdict.

    All data are from the calibration, without a recording. Raises the errors of `check_places`.
    """
    results = Results(calibration=given_calibration(calibration), origin=origin or origin_of([]))
    write_checked(document(results, "Report of a calibration without motion capture"), Path(path), force=force)


def write_track_figures(
    found: Sequence[Localization] | Sequence[OnboardTrack], folder: Path, *, force: bool = False
) -> None:
    """Write a figure of each body's track into a folder, as PDF and SVG at two widths.

    Results of `localize` also give a figure of the RMSE of all filters. Raises the errors of `check_places`.
    """
    compared = [one for one in found if isinstance(one, Localization)]
    draws: dict[type, Any] = {Localization: track, RelativePose: track, OnboardTrack: onboard}
    pictures: list[Block] = [
        *([Picture("rmse", partial(rmse_bars, found=compared), "RMSE")] if compared else []),
        *(Picture(track_name(one.source, one.body), partial(draws[type(one)], one=one), one.body) for one in found),
    ]
    write_checked(Document("", pictures), None, folder, force=force)


def write_comparison_figures(
    found: CalibrationComparison,
    known: Sequence[Calibration],
    names: Sequence[str],
    folder: Path,
    *,
    force: bool = False,
) -> None:
    """Write figures of the differences of delays and of the curves of two calibrations, called `names`, into a folder.

    Raises the errors of `check_places`.
    """
    pictures: list[Block] = [
        Picture("differences", partial(drawings.differences, found=found), "Delays"),
        Picture("curves", partial(drawings.both_curves, known=known, names=names), "Curves"),
    ]
    write_checked(Document("", pictures), None, folder, force=force)


def write_checked(page: Document, output: Path | None, figures: Path | None = None, *, force: bool) -> None:
    """Write a document and its figures after `check_places`; raises the errors of that function."""
    check_places(output, None, figures, force=force)
    write_document(page, output, None, figures, force=force)


Progress = Callable[[str | float], None]


@dataclass(frozen=True, kw_only=True)
class Campaign(Results):
    """The results of a campaign: the fit, its recordings, and its errors on tests."""

    fit: FitResult

    def __repr__(self) -> str:
        """Return the fit, the recordings on which it was evaluated, and the findings."""
        found = [f"{name}: {finding.fault}" for name, finding in self.findings]
        return "\n".join([repr(self.fit), f"judged on {self.judged.source}", *found])

    def write(
        self,
        html: str | os.PathLike[str],
        pdf: str | os.PathLike[str] | None = None,
        figures: str | os.PathLike[str] | None = None,
        *,
        force: bool = False,
        progress: Progress = lambda _: None,
    ) -> None:
        """Write the report as one HTML page and as PDF, and its figures (PDF and SVG) into a folder.

        Figures have two widths: of a column (3.5 inch) and of a page (7.16 inch). If `html` ends in .pdf, it is a PDF.
        `progress` is called with the present step, and with the finished share of the campaign and its report. Raises
        the errors of `check_output` before figures are drawn.
        """
        output, *more = (None if place is None else Path(place) for place in (html, pdf, figures))
        check_places(output, *more, force=force)
        page = document(self, "Calibration of ultra-wideband ranges")

        def report_step(step: str | float) -> None:
            # Shares of processor time, measured with the flights of ICRA 2023.
            progress(step if isinstance(step, str) else 0.65 + 0.35 * step)

        write_document(page, output, *more, force=force, progress=report_step)

    def to_dict(self) -> dict[str, Any]:
        """Return what `calib report --json` prints."""
        plain: dict[str, Any] = {
            "calibration": json.loads(self.calibration.to_json()),
            "warnings": self.fit.warnings,
            "evaluation": self.evaluation.to_dict(),
            "heard": {str(tag): asdict(heard) for tag, heard in self.heard.items()},
            "findings": [{"recording": name} | asdict(finding) for name, finding in self.findings],
        }
        if self.tracks:
            plain["localization"] = localization_json(self.tracks)
        return plain


def run_campaign(
    training: Data | Iterable[Data],
    tests: Data | Iterable[Data] = (),
    *,
    trim_static: bool = False,
    progress: Progress = lambda _: None,
    command: str = "",
    settings: FitSettings | None = None,
    **changes: Any,
) -> Campaign:
    """Fit a calibration to training recordings, evaluate it and localize bodies on test recordings.

    Recordings are as for `load_ranges`, `settings` and keyword arguments as for `fit`. Without tests, a second fit is
    evaluated on a part of the training that is held out from it (`FitSettings.hold_out`, 0.3 by default); if the
    training is too short for that, the errors are those of the fitted ranges. The report states which was done.
    `Ranges` are fitted and evaluated, but examining and localizing need recordings. `trim_static` leaves out parts of
    the training in which nothing moves; `progress` is called with the present step, and with the finished share of the
    campaign and its report; `command` is the command line that the report states. Raises the errors of `load_ranges`
    and `fit`.

    >>> import calib
    >>> campaign = calib.run_campaign(calib.sample_flight(), calib.sample_flight(300, seed=2), loss="huber")
    >>> campaign.evaluation.overall.full.n
    300
    """
    settings = replace(settings or FitSettings(), **changes)
    given = each(training), each(tests) if tests else []
    progress("loading")
    progress(0.0)
    with ExitStack() as stack:
        recordings, judged = ([stack.enter_context(held_open(one)) for one in some] for some in given)
        need_power = not settings.delays_only
        fitted = load_each(recordings, trim_static=trim_static, need_power=need_power)
        testing = load_each(judged, need_power=need_power) if judged else []
        progress("fitting")
        progress(0.05)
        ranges = concatenate(fitted)
        found = fit(ranges, settings) if testing else _fit_and_hold_out(ranges, settings)
        held = None if testing else found.held_out
        known = found.calibration
        progress("examining")
        progress(0.12)
        findings = [finding for one in (*recordings, *judged) for finding in _findings(one)]
        progress("localizing")
        progress(0.2)
        return Campaign(
            calibration=known,
            training=fitted,
            tests=testing if held is None else [held.ranges],
            part=None if held is None else held.calibration,
            fit=found,
            heard=heard_delays(ranges, known),
            findings=findings,
            tracks=[track for data in judged or recordings for track in _tracks(data, known)],
            origin=origin_of([*given[0], *given[1]], command),
        )


def _fit_and_hold_out(ranges: Ranges, settings: FitSettings) -> FitResult:
    """Fit with held-out ranges; if there are too few ranges and `hold_out` was not set, fit without."""
    if settings.hold_out:
        return fit(ranges, settings)
    try:
        return fit(ranges, settings, hold_out=0.3)  # three of ten parts (`FitSettings.fold`)
    except UnanswerableError:
        return fit(ranges, settings)


def _findings(data: Data) -> list[tuple[str, Finding]]:
    if isinstance(data, Ranges):
        return []
    with opened(data) as (name, _):
        # The fit itself names undetermined delays.
        return [(name, finding) for finding in examine(data) if finding.fault != "too few pairs"]


def _tracks(data: Data, calibration: Calibration) -> list[Localization]:
    """Localize the bodies of a recording; an empty list if none can be localized."""
    try:
        return [] if isinstance(data, Ranges) else localize(data, calibration)
    except UnanswerableError:
        return []


def evaluate_flight(flight: Data) -> Mapping[str, Any]:
    """Fit a flight and evaluate the fit on it; return the results as one row of a sweep.

    `flight` is a result of `uwbsim.simulate`, or another source of `load_ranges`. The row has the number of usable
    `exchanges`; mean, standard deviation and robust spread, in metres, of the errors of `raw`, `delays` and `full`
    ranges; `settled`, 1 if the fit converged, else 0; the share `rejected` of corrected ranges outside the 95 % bounds
    of their sigma; and the differences from planted values, `delays_rms_ns`, `curve_rms_m` and `correction_rms_m`, None
    if nothing was planted. Raises `UnanswerableError` if the flight cannot be fitted.
    """
    ranges = load_ranges(flight)
    result = fit(ranges)
    found = evaluate(ranges, result.calibration).to_dict()
    overall, planted = found["overall"], found.get("planted") or {}
    delays = list((planted.get("delay_error_ns") or {}).values())
    errors = product(("raw", "delays", "full"), ("mean_m", "std_m", "robust_std_m"))
    return {
        "exchanges": overall["raw"]["n"],
        **{f"{stage}_{what}": overall[stage][what] for stage, what in errors},
        "settled": int(result.success),
        "rejected": overall["rejected"],
        "delays_rms_ns": float(np.sqrt(np.mean(np.square(delays)))) if delays else None,
        "curve_rms_m": planted.get("curve_rms_m"),
        "correction_rms_m": planted.get("correction_rms_m"),
    }
