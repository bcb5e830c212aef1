"""Writes a recording again with corrected ranges."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.calibration.model import Calibration
from calib.errors import BadInputError
from calib.ranges import Ranges
from uwblink.recording.file import Recording, check_output
from uwblink.twr import delay_weights, raw_range


def correct(source: Path, calibration: Calibration, output: Path, *, force: bool = False) -> tuple[int, int]:
    """Correct `range_m` of every exchange; returns how many, and how many beyond the fitted power.

    Stamps stay as they were recorded, and everything else is copied. An exchange without any power
    gets the delays' part only. Raises `BadInputError` for a recording that is corrected already.
    """
    check_output(output, force=force)
    with Recording.open(source) as recording:
        meta = recording.meta()
        if "calibration" in meta:
            raise BadInputError(f"{source}: its ranges are corrected already; apply to the original")
        exchanges = recording.exchanges()
        initiator, target = delay_weights(exchanges)
        nothing = np.full(len(exchanges), np.nan)
        applied = calibration.apply(
            Ranges(
                source.name,
                exchanges.time_ns,
                exchanges.initiator,
                exchanges.target,
                exchanges.protocol,
                raw_range(exchanges),
                nothing,
                initiator,
                target,
                exchanges.fpp1_dbm,
                exchanges.fpp2_dbm,
                {},
                None,
            )
        )
        corrected = np.where(np.isfinite(applied.lifted), applied.corrected_m, applied.delay_corrected_m)
        with Recording.create(output, meta=meta, force=force) as written:
            written.append_meta({"calibration": calibration.provenance})
            written.append_tags(recording.tags())
            written.append_poses(recording.poses())
            written.append_faults(recording.faults())
            written.append_exchanges(replace(exchanges, range_m=corrected))
    return len(exchanges), int(np.count_nonzero(applied.clamped))
