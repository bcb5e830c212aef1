"""What a calibration said of the exchanges of a recording, row by row, for the forms that put it beside the ranges."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.recording.contents import Contents

ENDS: Final = ("time_ns", "initiator", "target")


def corrections(held: Contents) -> dict[str, list[Any]]:
    """Return columns of messages by name: `range_m` as it was measured, `corrected_m`, and what is known of it.

    Nothing where ranges were not corrected, or the table is not that of the exchanges, row by row.
    """
    if not _fits(held):
        return {}
    table = held.corrected
    columns = {name: column.tolist() for name, column in table.items() if name not in (*ENDS, "raw_m")}
    return {"range_m": table["raw_m"].tolist()} | columns


def variances(held: Contents) -> Floats:
    """Return the variances of ranges (n,), reflections counted in where that is known; 0 where nothing is."""
    if not _fits(held):
        return np.zeros(len(held.exchanges))
    total, noise = held.corrected["sigma_total_m"], held.corrected["sigma_m"]
    return np.asarray(np.nan_to_num(np.where(np.isfinite(total), total, noise) ** 2))


def _fits(held: Contents) -> bool:
    return bool(held.corrected) and all(
        np.array_equal(held.corrected[name], getattr(held.exchanges, name)) for name in ENDS
    )
