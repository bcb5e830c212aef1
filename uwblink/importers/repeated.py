"""Exchanges that stand in a table twice, as where the logs of both devices are put together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Bools, Floats, Ints
from uwblink.importers.staging import Stage
from uwblink.importers.table_rows import Rows
from uwblink.twr import LARGEST_ID

_MIX: Final = (np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB))
"""The factors of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014)."""

BY_CHANCE: Final = 1e-6
"""How likely, at most, ranges are told to be repeated that are not."""


class Repeated:
    """Looks for rows with the same devices and stamps: no two exchanges have these, whenever they were."""

    def __init__(self, stage: Stage) -> None:
        """Put on a stage what tells rows apart, 16 bytes each."""
        self._kept = stage.keep("SELECT 0::UBIGINT AS code, 0::BIGINT AS row WHERE false", [], ("code", "row"))

    def add(self, rows: Rows, stamps: Mapping[str, Floats], good: Bools, before: int) -> None:
        """Look at the rows that are `good`, `before` which others like them came."""
        stamped = np.any([column[good] != 0 for column in stamps.values()], axis=0)
        columns: list[NDArray[Any]] = [*rows.ids.values(), *stamps.values()]
        code = _codes([column[good][stamped] for column in columns])
        if len(code):
            self._kept.stage.add(self._kept, {"code": code, "row": before + np.flatnonzero(stamped)})

    def rows(self) -> Ints:
        """Return which of the rows are those of an exchange that came before, in ascending order."""
        table = self._kept.table
        twice = f"SELECT code, min(row) AS first FROM {table} GROUP BY code HAVING count(*) > 1"  # noqa: S608 - a name of ours
        query = f"SELECT row FROM {table} JOIN ({twice}) USING (code) WHERE row > first ORDER BY row"  # noqa: S608 - as above
        return np.ma.getdata(self._kept.stage.db.execute(query).fetchnumpy()["row"])


def _codes(columns: Iterable[NDArray[Any]]) -> NDArray[np.uint64]:
    """Return a number of 64 bits for each row: of 10 million different ones two are equal once in 400,000 tables."""
    code: NDArray[np.uint64] = np.uint64(0)  # type: ignore[assignment]
    for column in columns:
        code = (code ^ column.view(np.uint64)) * _MIX[0]
        code = (code ^ (code >> np.uint64(31))) * _MIX[1]
        code = code ^ (code >> np.uint64(29))
    return code


def likely_repeated(rows: Rows) -> str:
    """Return why ranges without stamps are likely there twice; nothing where they are not.

    A range that is exactly the one before of the same two devices is so by chance, or repeats it. By chance it comes as
    long after it as others do; that is asked by the rank test of Mann and Whitney.
    """
    if rows.time_ns is None or "range_m" not in rows.cells:
        return ""
    one, other = (rows.ids[name] for name in ("from_id", "to_id"))
    pair = np.minimum(one, other) * (LARGEST_ID + 1) + np.maximum(one, other)
    order = np.lexsort((rows.time_ns, pair))
    same = np.diff(pair[order]) == 0
    gap = np.diff(rows.time_ns[order])[same] * 1e-9
    equal = (np.diff(rows.cells["range_m"][order]) == 0)[same]
    if equal.all() or not equal.any():
        return ""
    from scipy.stats import mannwhitneyu

    chance = mannwhitneyu(gap[equal], gap[~equal], alternative="less", method="asymptotic").pvalue
    if not chance < BY_CHANCE:
        return ""
    after, others = (f"{1e3 * np.median(some):.3g} ms" for some in (gap[equal], gap[~equal]))
    return (
        f"{np.count_nonzero(equal)} of {len(rows)} ranges are exactly the one before of the same two devices, {after} "
        f"after it where others come after {others}: are exchanges there twice, from the logs of both? They are kept"
    )
