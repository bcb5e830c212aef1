"""Rows that cannot be used: which, why, and what they become."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from uwblink.arrays import Bools, Ints
from uwblink.importers.table_rows import Rows

FAULT: Final = "unusable row"


@dataclass(frozen=True, slots=True)
class Reason:
    """The column (ours) because of which rows cannot be used, and what is expected there."""

    name: str
    expected: str


@dataclass(slots=True)
class Unusable:
    """Places of rows among all that were read, by the reason; in the order in which reasons were looked for."""

    rows: dict[Reason, list[Ints]] = field(default_factory=dict)

    def reject(self, rows: Rows, name: str, wrong: Bools, expected: str) -> None:
        """Note the rows that are wrong, (n,)."""
        self.add(name, rows.origin[wrong], expected)

    def add(self, name: str, origin: Ints, expected: str) -> None:
        """Note rows by their places."""
        found = self.rows.setdefault(Reason(name, expected), [])
        if len(origin):
            found.append(origin)

    def take(self, other: Unusable) -> None:
        """Add what another one noted."""
        for reason, rows in other.rows.items():
            self.rows.setdefault(reason, []).extend(rows)

    def __bool__(self) -> bool:
        """Whether there are any."""
        return any(self.rows.values())

    def __len__(self) -> int:
        """Return how many there are, a row as often as there are reasons."""
        return sum(len(part) for parts in self.rows.values() for part in parts)

    def reasons(self) -> Iterator[tuple[Reason, Ints]]:
        """Yield the reasons with their rows."""
        for reason, parts in self.rows.items():
            if parts:
                yield reason, np.concatenate(parts)

    def distinct(self) -> int:
        """Return how many rows cannot be used."""
        found = [rows for _, rows in self.reasons()]
        return len(np.unique(np.concatenate(found))) if found else 0

    def first(self) -> tuple[Reason, int]:
        """Return the first of the rows, and the first reason against it; there is one at least."""
        reason, rows = min(self.reasons(), key=lambda one: int(one[1].min()))
        return reason, int(rows.min())
