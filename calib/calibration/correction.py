"""Corrected copies of recordings, as recordings or in other formats, and the correction of live exchanges."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.calibration.applying import CorrectedRanges, columns_of, determined, undetermined_text
from calib.calibration.model import Calibration, CalibrationSource, given_calibration, load_calibration
from calib.calibration.patterns import lack_direction, warn_of_directions
from calib.data.arrivals import arrivals_of
from calib.data.features import features_of
from calib.data.ranges import Ranges
from calib.data.sources import RecordedSource
from calib.errors import BadInputError, LeftOutWarning
from uwblink.arrays import Floats
from uwblink.corrections import Columns, Correction
from uwblink.errors import warn
from uwblink.exporters import check_export, export_recording
from uwblink.output import check_output
from uwblink.recording.contents import READING_MB, Contents, exchanges_with_poses
from uwblink.recording.file import Recording
from uwblink.twr import Exchanges


@dataclass(frozen=True, slots=True)
class Applied:
    """Counts of corrected ranges: all, those with powers outside the fitted ones, and those without power.

    If the calibration needs power, a range without it is corrected for delays only, and its sigma is NaN.
    """

    count: int
    clamped: int
    unpowered: int


def apply(
    source: str | os.PathLike[str],
    calibration: CalibrationSource,
    output: str | os.PathLike[str],
    *,
    to: str | None = None,
    force: bool = False,
) -> Applied:
    """Write a copy of a recording with corrected `range_m` of every exchange; all other data stay the same.

    The table `corrected` has the raw range of each exchange, its expected errors and its flags. With `to`, the output
    is a folder in a format of `uwblink.exporters` ("csv", "parquet", "mcap", "rosbag2"). Stamps are not changed. An
    exchange without any power is corrected for delays only. Exchanges of pairs that the calibration cannot correct are
    left out, with a `LeftOutWarning`. Raises `BadInputError` for a recording that is corrected already and for one with
    differences of arrival only, and the errors of `Calibration.apply`, `Recording.open`, `check_output` and
    `export_recording`.

    >>> import calib, tempfile
    >>> from uwblink import Recording
    >>> flight = calib.sample_flight()
    >>> known = calib.fit(flight).calibration
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with Recording.create(f"{folder}/flight.uwb") as recording:
    ...         recording.append("exchanges", flight.exchanges)
    ...     calib.apply(f"{folder}/flight.uwb", known, f"{folder}/corrected.uwb").count
    900
    """
    calibration = given_calibration(calibration)
    if to is None:
        return _write(source, calibration, Path(output), force=force)
    check_export(output, to=to, force=force)
    with TemporaryDirectory() as place:
        path = Path(place) / Path(source).name
        done = _write(source, calibration, path, force=False)
        export_recording(path, output, to=to, force=force)
    return done


def _write(source: str | os.PathLike[str], calibration: Calibration, output: Path, *, force: bool) -> Applied:
    check_output(output, force=force, recording=True)
    with Recording.open(source, memory_mb=READING_MB) as recording:
        if "calibration" in recording.meta():
            raise BadInputError(
                f"{source}: its ranges are already corrected; apply the calibration to the original recording"
            )
        if (bare := recording.count("differences")) and not recording.count("exchanges"):
            raise BadInputError(
                f"{source}: holds {bare} differences of arrival and no ranges; `calib localize` with `use` "
                f"receptions corrects them itself"
            )
        warm, first = recording.columns("temperature"), 0
        slopes = calibration.errors.features if calibration.errors else {}
        # Not block by block: an impulse response may belong to an exchange of the block before.
        features = features_of(recording.exchanges(), RecordedSource(recording)) if slopes else None
        # Counts of corrected ranges: all, clamped, without power, without a direction.
        tags, counts, left_out, why = recording.tags(), np.zeros(4, dtype=np.int64), 0, ""
        meta = {"calibration": calibration.provenance}
        with recording.copying(output, without=("exchanges", "corrected"), meta=meta, force=force) as written:
            for exchanges, poses in exchanges_with_poses(recording):
                ranges = Ranges.from_exchanges(
                    exchanges, poses=poses, tags=tags, source=Path(source).name, temperature=warm
                )
                if features is not None:
                    ranges = replace(ranges, features=features[first : first + len(exchanges)])
                first += len(exchanges)
                good = determined(calibration, ranges)
                if not good.all():
                    left_out += int(np.count_nonzero(~good))
                    why = undetermined_text(calibration, ranges, good)
                if good.any():
                    lacking = int(np.count_nonzero(lack_direction(calibration, ranges[good])))
                    counts += (*_append(written, exchanges[good], calibration.apply(ranges[good])), lacking)
            if left_out and not counts[0]:
                raise BadInputError(why)
    *applied, lacking = counts.tolist()
    warn_of_directions(lacking, applied[0], Path(source).name)
    if left_out:
        warn(f"{why}; {left_out} ranges are left out", LeftOutWarning)
    if bare:
        warn(f"{bare} differences of arrival without stamps are copied unchanged", LeftOutWarning)
    return Applied(*applied)


def _append(written: Recording, exchanges: Exchanges, applied: CorrectedRanges) -> tuple[int, int, int]:
    """Add corrected exchanges; return the numbers of all, of those outside the fitted powers, and of those without
    power.
    """
    known = columns_of(applied)
    table: dict[str, NDArray[Any]] = {
        "time_ns": exchanges.time_ns,
        "initiator": exchanges.initiator,
        "target": exchanges.target,
        "raw_m": applied.raw_m,
        "corrected_m": known.range_m,
        "clamped": known.clamped,
        "outlier": applied.outlier,
        "sigma_m": known.sigma_m,
        "sigma_total_m": known.sigma_total_m,
        "mean_error_m": applied.mean_error_m,
        "tail_share": known.tail_share,
        "tail_probability": applied.tail_probability,
    }
    with written.transaction():
        written.append("exchanges", replace(exchanges, range_m=known.range_m))
        written.append("corrected", table)
    return len(exchanges), int(np.count_nonzero(known.clamped)), int(np.count_nonzero(np.isnan(applied.lifted)))


def live_correction(path: Path) -> Correction:
    """Return the correction of live exchanges and overheard frames by the calibration in a file.

    Its columns are `corrected_m` and the other fields of `CorrectedRange`, with the same values as `calib.apply`. The
    correction raises the errors of `Calibration.apply` and `Calibration.correct_arrivals`, for example for a tag
    without a delay. Raises the errors of `load_calibration`.
    """
    calibration = load_calibration(path)

    def correct(exchanges: Exchanges) -> dict[str, Floats]:
        ranges = Ranges.from_exchanges(exchanges, source=str(path))
        known = columns_of(calibration.apply(ranges))._asdict()
        return {"corrected_m": known.pop("range_m"), **known}

    def differences(exchanges: Exchanges, overheard: Columns) -> Columns:
        ranges, no_poses = Ranges.from_exchanges(exchanges, source=str(path)), Contents(exchanges=exchanges).poses
        heard = arrivals_of(exchanges, ranges.raw_m, overheard, no_poses, (), need_truth=False)
        applied = calibration.correct_arrivals(replace(ranges, arrivals=heard))
        known = {name: getattr(exchanges, name)[heard.exchange] for name in ("time_ns", "initiator", "target")}
        known |= {"listener": heard.listener, "difference_m": applied.raw_m, "corrected_m": applied.corrected_m}
        return known | {"sigma_m": applied.sigma_m, "shared_m": applied.shared_m}

    # A calibration with patterns cannot correct overheard frames (`Calibration.correct_arrivals`).
    return Correction(correct, None if calibration.patterns else differences, calibration.antenna_delays)
