"""Corrected ranges while recording, by whatever distribution knows how to correct.

uwblink stands below what calibrates, so it does not import it: an entry point of the group `uwbcal.corrections` names a
function that takes the path of a calibration and returns the function which corrects one range.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from pathlib import Path
from typing import Final

from uwblink.errors import PlanError
from uwblink.wire.messages import RangeReport

GROUP: Final = "uwbcal.corrections"
Correction = Callable[[int, RangeReport], Mapping[str, float]]
"""Returns what is known of a range by name, from the initiator's id and the report.

`corrected_m` and `sigma_m` in metres, and whatever else whoever corrects can say; nothing where it cannot be corrected.
"""


def load_correction(path: Path) -> Correction:
    """Return the correction of a calibration's file; raises `PlanError` for what is none, or where nothing corrects."""
    found = sorted(entry_points(group=GROUP), key=lambda entry: entry.name)
    if not found:
        raise PlanError(f"{path}: no installed distribution corrects ranges (entry points of {GROUP})")
    try:
        make: Callable[[Path], Correction] = found[0].load()
        return make(path)
    except (ValueError, OSError, ImportError) as error:
        raise PlanError(str(error)) from error
