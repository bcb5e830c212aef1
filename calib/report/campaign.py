"""A campaign: fit, examine, localize and judge, for a report; and one flight fitted and judged, for a sweep."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from calib.calibration.model import Calibration
from calib.checks.examine import examine
from calib.data.ranges import Ranges, concatenate
from calib.data.sources import Data, each, held_open, load_each, load_ranges, opened
from calib.errors import UnanswerableError
from calib.evaluation.localization import Localization, localize, summarize
from calib.evaluation.statistics import evaluate
from calib.findings import Finding
from calib.fitting.fitting import fit
from calib.fitting.passive_listeners import heard_delays
from calib.fitting.result import FitResult
from calib.report.results import Results, origin_of
from calib.report.sections import document
from calib.report.writing import check_places
from calib.settings import FitSettings
from uwblink.pages.blocks import write_document

Progress = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Campaign(Results):
    """The results of a campaign: the fit, its recordings, and its errors on tests."""

    fit: FitResult

    def __repr__(self) -> str:
        """Return the fit, the recordings that judge it, and the findings."""
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
        """Write the report as one HTML page, as PDF, and its figures at paper size (PDF and SVG) into a folder.

        Figures come at two widths, a column's (3.5 inch) and a page's (7.16 inch). A `html` that ends in .pdf is a PDF.
        `progress` is told what is being done. Raises the errors of `check_output` before anything is drawn.
        """
        output, *more = (None if place is None else Path(place) for place in (html, pdf, figures))
        check_places(output, *more, force=force)
        made = document(self, "Calibration of ultra-wideband ranges")
        write_document(made, output, *more, force=force, progress=progress)

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
            plain["localization"] = {
                "scenarios": [
                    {
                        "recording": t.source,
                        "body": t.body,
                        "rmse_m": {name: float(rmse.mean()) for name, rmse in t.rmse_m.items()},
                    }
                    for t in self.tracks
                ],
                "summary": asdict(summarize(self.tracks)),
            }
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
    """Fit to the training recordings, judge and localize on the tests, and return all that a report tells of.

    Recordings are what `load_ranges` takes, `settings` and keyword arguments what `fit` takes. Without tests a
    second fit is judged on a part of the training that is held out from it (`FitSettings.hold_out`, 0.3 by default);
    where that is too short, the training itself is judged. The report says which. `Ranges` alone are fitted and
    judged, but neither examined nor localized: that takes a recording. `trim_static` leaves out of the training where
    nothing moves; `progress` is called with what is being done; `command` is the command line that the report states.
    Raises what `load_ranges` and `fit` raise.

    >>> import calib
    >>> campaign = calib.run_campaign(calib.sample_flight(), calib.sample_flight(300, seed=2), loss="huber")
    >>> campaign.evaluation.overall.full.n
    300
    """
    settings = replace(settings or FitSettings(), **changes)
    given = each(training), each(tests) if tests else []
    progress("loading")
    with ExitStack() as stack:
        recordings, judged = ([stack.enter_context(held_open(one)) for one in some] for some in given)
        need_power = not settings.delays_only
        fitted = load_each(recordings, trim_static=trim_static, need_power=need_power)
        testing = load_each(judged, need_power=need_power) if judged else []
        progress("fitting")
        ranges = concatenate(fitted)
        found = fit(ranges, settings) if testing else _fit_and_hold_out(ranges, settings)
        held = None if testing else found.held_out
        known = found.calibration
        progress("examining")
        findings = [finding for one in (*recordings, *judged) for finding in _findings(one)]
        progress("localizing")
        whole = [data for data in recordings if not isinstance(data, Ranges)]
        return Campaign(
            calibration=known,
            training=fitted,
            tests=testing if held is None else [held.ranges],
            part=None if held is None else held.calibration,
            fit=found,
            # From the first recording that has passive listeners.
            heard=next(filter(None, (heard_delays(data, known) for data in whole)), {}),
            findings=findings,
            tracks=[track for data in judged or recordings for track in _tracks(data, known)],
            origin=origin_of([*given[0], *given[1]], command),
        )


def _fit_and_hold_out(ranges: Ranges, settings: FitSettings) -> FitResult:
    """Fit with a part held out to judge by; without it if ranges are too few and `hold_out` was not asked for."""
    if settings.hold_out:
        return fit(ranges, settings)
    try:
        return fit(ranges, settings, hold_out=0.3)  # three of the tenths of `FitSettings.fold`
    except UnanswerableError:
        return fit(ranges, settings)


def _findings(data: Data) -> list[tuple[str, Finding]]:
    if isinstance(data, Ranges):
        return []
    with opened(data) as (name, _):
        return [(name, finding) for finding in examine(data)]


def _tracks(data: Data, calibration: Calibration) -> list[Localization]:
    """Localize in a recording; nothing if no body can be localized."""
    try:
        return [] if isinstance(data, Ranges) else localize(data, calibration)
    except UnanswerableError:
        return []


def evaluate_flight(flight: Data) -> Mapping[str, Any]:
    """Fit a flight and evaluate the fit on it; return the figures as one row of a sweep.

    `flight` is what `uwbsim.simulate` gives, or one of whatever else `load_ranges` takes. The row has the number of
    `exchanges` that could be used; mean, standard deviation and robust spread in metres of the errors of `raw`,
    `delays` and `full` ranges; `rejected`; and, compared with what was planted, `delays_rms_ns`, `curve_rms_m` and
    `correction_rms_m`, None where nothing was; and `settled`, 0 where the fit stopped before it did. Raises
    `UnanswerableError` where the flight cannot be fitted.
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
