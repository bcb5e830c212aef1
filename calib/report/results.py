"""The results that a report shows, and the origin of the report."""

from __future__ import annotations

import datetime
import hashlib
import os
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from calib.calibration.applying import CorrectedRanges
from calib.calibration.model import Calibration, warnings_of
from calib.data.ranges import Ranges, concatenate
from calib.data.sources import Data
from calib.evaluation.localization import Localization
from calib.evaluation.statistics import Evaluation, PlantedComparison, compare_with_planted, evaluate
from calib.findings import Finding
from calib.fitting.passive_listeners import OverheardDelay
from calib.fitting.result import FitResult


@dataclass(frozen=True, slots=True)
class Origin:
    """Time (ISO 8601, UTC), command, version, and the SHA-256 of each input file by name."""

    made: str = ""
    command: str = ""
    version: str = ""
    files: dict[str, str] = field(default_factory=dict)

    def sentence(self) -> str:
        """Return time, version and command in one line, for the head of a report."""
        parts = [f"Made {self.made}" if self.made else "", f"by uwbcal {self.version}" if self.version else ""]
        return " ".join(filter(None, parts)) + (f": {self.command}" if self.command else "")


def origin_of(data: Iterable[Data], command: str = "") -> Origin:
    """Return the origin of a report, with hashes of the paths in `data`; other sources are ignored.

    The time is that of the environment variable `SOURCE_DATE_EPOCH` (seconds since 1970), for reproducible files, or
    else the present time.
    """
    from uwblink import __version__

    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    seconds = int(epoch) if epoch.isdecimal() else datetime.datetime.now(datetime.UTC).timestamp()
    time = datetime.datetime.fromtimestamp(seconds, datetime.UTC).strftime("%Y-%m-%d %H:%M UTC")
    files = {}
    for path in (Path(one) for one in data if isinstance(one, str | os.PathLike)):
        with path.open("rb") as file:
            files[str(path)] = hashlib.file_digest(file, "sha256").hexdigest()
    return Origin(time, command, __version__, files)


@dataclass(frozen=True, kw_only=True)
class Results:
    """The input of a report: a calibration, and its fit, recordings and evaluation, as far as they are known.

    `training` are the fitted ranges, `tests` those for the evaluation; `evaluated` is an existing evaluation. If the
    tests are held-out parts of the fitted recordings, `part` is the calibration that was fitted without them, and it is
    evaluated in place of `calibration`. `heard` are delays from passive listeners; `findings` those of the doctor, by
    recording; `tracks` the localized bodies; `origin` the time of the report and its input files.
    """

    calibration: Calibration
    training: list[Ranges] = field(default_factory=list)
    tests: list[Ranges] = field(default_factory=list)
    evaluated: Evaluation | None = None
    fit: FitResult | None = None
    part: Calibration | None = None
    heard: dict[int, OverheardDelay] = field(default_factory=dict)
    findings: list[tuple[str, Finding]] = field(default_factory=list)
    tracks: list[Localization] = field(default_factory=list)
    origin: Origin = field(default_factory=Origin)

    @property
    def warnings(self) -> list[str]:
        """The warnings of the fit, from its calibration."""
        return warnings_of(self.calibration)

    @property
    def recordings(self) -> list[Ranges]:
        """The recordings of the evaluation: the tests, or the training if there are none."""
        return self.tests or self.training

    @property
    def held_out(self) -> bool:
        """Whether the evaluation is on recordings that were not fitted."""
        return bool(self.tests) and self.part is None and not self.evaluation.seen

    @property
    def judged_calibration(self) -> Calibration:
        """The calibration whose errors are shown: `part`, or the calibration itself."""
        return self.part or self.calibration

    @cached_property
    def trained(self) -> Ranges:
        """The ranges in figures of the curves: those of the training, or of the tests if the training is unknown."""
        return concatenate(self.training or self.tests)

    @cached_property
    def judged(self) -> Ranges:
        """The ranges of `recordings`, joined."""
        return concatenate(self.recordings)

    @cached_property
    def corrected(self) -> CorrectedRanges:
        """The judged ranges, corrected."""
        return self.judged_calibration.apply(self.judged)

    @cached_property
    def evaluation(self) -> Evaluation:
        """The evaluation of the judged ranges."""
        found = self.evaluated or evaluate(self.judged, self.judged_calibration)
        # The held-out part has the name of a fitted recording, but was not fitted.
        return found if self.part is None else replace(found, seen=())

    @cached_property
    def planted(self) -> PlantedComparison | None:
        """The comparison of the calibration with the planted values of a simulation, None without any."""
        if self.part is None:
            return self.evaluation.planted
        return compare_with_planted(self.trained, self.calibration.apply(self.trained), self.calibration)
