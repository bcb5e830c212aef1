"""Correction of exchanges as they arrive, for the live page of a recorder and for streams."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from calib.calibration.applying import columns_of
from calib.calibration.model import load_calibration
from calib.data.ranges import Ranges
from uwblink.arrays import Floats
from uwblink.twr import Exchanges


def live_correction(path: Path) -> Callable[[Exchanges], dict[str, Floats]]:
    """Return a function that corrects exchanges (n,) to `corrected_m`, and what else `CorrectedRange` has.

    The numbers are those of `calib.apply`; its attribute `antenna_delays` is what was programmed where the
    calibration was fitted. The function raises what `Calibration.apply` raises, as for a tag that is not calibrated.
    Raises what `load_calibration` raises.
    """
    calibration = load_calibration(path)

    def correct(exchanges: Exchanges) -> dict[str, Floats]:
        ranges = Ranges.from_exchanges(exchanges, source=str(path))
        known = columns_of(calibration.apply(ranges))._asdict()
        return {"corrected_m": known.pop("range_m"), **known}

    correct.antenna_delays = calibration.antenna_delays  # type: ignore[attr-defined]
    return correct
