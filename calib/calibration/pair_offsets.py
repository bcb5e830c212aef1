"""Constants by which the ranges of single pairs are too long, where delays of tags cannot be had or do not suffice."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from calib.calibration.json_format import METRES, STD_M, Reader, is_tag
from calib.data.ranges import Ranges
from calib.errors import BadInputError
from uwblink.arrays import Floats

BETWEEN: Final = "-"


class PairOffset(NamedTuple):
    """By how much the ranges of a pair are too long, and its standard error, in metres."""

    offset_m: float
    std_m: float


Offsets = Mapping[tuple[int, int], PairOffset]


def offset_of(offsets: Offsets, first: int, second: int) -> PairOffset:
    """Return the constant of a pair, whoever initiates; raises `BadInputError` for a pair that has none."""
    try:
        return offsets[min(first, second), max(first, second)]
    except KeyError as error:
        known = ", ".join(named(pair) for pair in sorted(offsets)[:6])
        raise BadInputError(
            f"no constant for pair {named(error.args[0])} in the calibration, which knows {known}"
            f"{' and others' if len(offsets) > 6 else ''}"
        ) from None


def offsets_m(offsets: Offsets, ranges: Ranges) -> Floats:
    """Return the constant of each range's pair (n,); nothing where there are none; raises what `offset_of` raises."""
    if not offsets or not len(ranges):
        return np.zeros(len(ranges))
    ends = np.sort(np.column_stack([ranges.initiator, ranges.target]), axis=1)
    pairs, place = np.unique(ends, axis=0, return_inverse=True)
    values = [offset_of(offsets, *pair).offset_m for pair in pairs.tolist()]
    return np.asarray(np.array(values)[place.ravel()])


def named(pair: tuple[int, int]) -> str:
    """Return a pair as it is written: 1-2."""
    return BETWEEN.join(map(str, pair))


def table_of(offsets: Offsets) -> dict[str, Any]:
    """Return constants as they stand in a file."""
    return {named(pair): {"offset_m": one.offset_m, "std_m": one.std_m} for pair, one in sorted(offsets.items())}


def offsets_from(read: Reader) -> dict[tuple[int, int], PairOffset]:
    """Take constants from a calibration's table; raises `BadInputError` that names the key."""
    inner, found = read.inside("pair_offsets"), {}
    for key in read.table("pair_offsets"):
        first, between, second = key.partition(BETWEEN)
        if not (between and is_tag(first) and is_tag(second)):
            raise BadInputError(f"pair_offsets: found {key[:40]!r}, expected two tag ids, as in 1-2")
        one = inner.inside(key)
        pair = sorted((int(first), int(second)))
        found[pair[0], pair[1]] = PairOffset(one.number("offset_m", METRES), one.number("std_m", STD_M))
    return found
