"""Rows of a table that cannot be used, as faults: with their line, their column and what stood there."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from uwblink.arrays import Ints
from uwblink.importers.staged_file import StagedFile
from uwblink.importers.stamps import NEVER
from uwblink.importers.unusable import FAULT, Reason
from uwblink.recording.schema import Fault

FAULTS_AT_ONCE: Final = 100_000


def too_long(file: StagedFile) -> Iterator[list[Fault]]:
    """Yield the rows of a file that have more cells than its header, some at a time."""
    lines, name = file.table.rejected(), file.table.path.name
    for start in range(0, len(lines), FAULTS_AT_ONCE):
        some = lines[start : start + FAULTS_AT_ONCE].tolist()
        yield [Fault(0, name, FAULT, f"row {line}: more cells than the header has") for line in some]


def faults_of(file: StagedFile, reason: Reason, rows: Ints, lines: Ints) -> Iterator[list[Fault]]:
    """Yield some rows of a file (n,), which stand at `lines` (n,), some at a time."""
    for start in range(0, len(rows), FAULTS_AT_ONCE):
        some = rows[start : start + FAULTS_AT_ONCE]
        where, found = lines[start : start + len(some)].tolist(), _found(file, reason.name, some)
        yield [
            Fault(
                max(when, 0) if when == NEVER else when,
                file.table.path.name,
                FAULT,
                f"row {line}, {text}, expected {reason.expected}",
            )
            for when, line, text in zip(_times(file, some), where, found, strict=True)
        ]


def _times(file: StagedFile, rows: Ints) -> list[int]:
    chosen, back = np.unique(rows, return_inverse=True)
    time_ns = file.time_ns(lambda kept, columns: kept.at(chosen, columns), len(chosen))
    return [0] * len(rows) if time_ns is None else list(time_ns[back].tolist())


def _found(file: StagedFile, name: str, rows: Ints) -> list[str]:
    """Say what stands in the cells of a column."""
    if name in file.column_map.constants:
        return [f"constant {name!r}: found {str(file.column_map.constants[name])[:40]!r}"] * len(rows)
    header = file.column_map.header(name)
    words = file.table.words_at(header, rows.tolist()) if header in file.table.names else {}
    column = f"column {header[:60]!r}"
    return [f"{column}: found {words[row][:40]!r}" if row in words else column for row in rows.tolist()]
