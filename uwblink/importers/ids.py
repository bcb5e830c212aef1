"""Ids of strangers as numbers: as they are, or words that get some."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Bools, Floats, Ints
from uwblink.errors import ImportTableError
from uwblink.importers.stamps import NEVER, whole
from uwblink.twr import LARGEST_ID


@dataclass(frozen=True, slots=True)
class Numbering:
    """What ids become: `known` words in order, `value` their numbers; `names` are ids that were words, by number.

    Without known words ids are numbers.
    """

    known: NDArray[np.str_] | None = None
    value: Ints = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    names: dict[int, str] = field(default_factory=dict)

    def numbers(self, cells: Floats | None, words: NDArray[Any] | None) -> Ints:
        """Return ids (n,) as numbers, `NEVER` where there is none, of words or, where these are None, of cells."""
        if words is None and cells is not None:
            if self.known is None:
                return np.where(is_id(cells), whole(cells), NEVER)
            words = _as_words(cells)
        known = np.empty(0, dtype=np.str_) if self.known is None else self.known
        return np.asarray(self.value[np.searchsorted(known, [] if words is None else words)])


def numbering(
    path: Path, ids: Mapping[str, int], words: Mapping[str, set[str]], others: Mapping[str, set[str]]
) -> Numbering:
    """Return what ids become of which some columns hold `words`, and `others` numbers as text.

    `ids` are numbers that a map gives to words. Raises `ImportTableError` where there are too many.
    """
    # Empty cells are faults, not names.
    if not words or all(map(_is_tag, set().union(*words.values()) - {""})):
        return Numbering()
    distinct = sorted(set().union(*words.values(), *others.values()) - {""})
    numbers = dict(ids)
    numbers |= {n: int(n) for n in distinct if n not in numbers and _is_tag(n)}
    free = iter(sorted(set(range(1, LARGEST_ID + 1)) - set(numbers.values())))
    for name in distinct:
        if name not in numbers:
            number = next(free, None)
            if number is None:
                raise too_many(path)
            numbers[name] = number
    return Numbering(
        np.array(["", *distinct]),
        np.array([NEVER, *(numbers[name] for name in distinct)], dtype=np.int64),
        {numbers[name]: name for name in distinct if name != str(numbers[name])},
    )


def too_many(path: Path) -> ImportTableError:
    """Return the error for a column of ids in which nearly every row is another."""
    return ImportTableError(f"{path}: more than {LARGEST_ID} different ids; are from_id and to_id ids?")


def is_id(cells: Floats) -> Bools:
    """Return which numbers (n,) are ids."""
    with np.errstate(invalid="ignore"):
        return np.asarray((cells >= 0) & (cells <= LARGEST_ID) & (cells == np.rint(cells)))


def _as_words(cells: Floats) -> NDArray[np.str_]:
    good = is_id(cells)
    return np.where(good, np.where(good, cells, 0).astype(np.int64).astype(np.str_), "")


def _is_tag(text: str) -> bool:
    # Texts of thousands of digits are no numbers to Python, either.
    return text.isdecimal() and len(text) < 9 and int(text) <= LARGEST_ID
