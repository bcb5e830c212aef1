"""Features of impulse responses that indicate a reflection, from the table `cirs`.

A direct path that is too weak for the chip's threshold lies before the first path that the chip found. Then more energy
comes later, and the response rises more slowly.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.data.ranges import FEATURES
from uwblink.arrays import Floats, Ints
from uwblink.recording.file import Recording
from uwblink.recording.schema import CirRow
from uwblink.twr import Exchanges

Columns = Mapping[str, NDArray[Any]]


def response_features(magnitudes: Iterable[int], first_path_index: float) -> tuple[float, float]:
    """Return the energy of an impulse response over that of its first path in dB, and the rise time in taps.

    Both are NaN where the first path lies too near to the ends of the response.
    """
    taps = np.atleast_1d(np.asarray(magnitudes, dtype=np.float64))
    # Taps around the first path that count: 100 of them (100 ns) contain detours of 30 m.
    before, after = 20, 100
    first = int(first_path_index) if 0 <= first_path_index <= len(taps) - after else 0
    # From tap 50 on, up to well before the first path, there is only noise.
    quiet, own = taps[50 : max(first - 2 * before, 0)], taps[first + 1 : first + 4]
    if len(quiet) < before or not own.any():
        return np.nan, np.nan
    near = taps[first - before : first + after]
    noise = np.sqrt(np.mean(quiet**2) / 2)
    # Magnitudes of noise are Rayleigh-distributed: of 20 taps one in 10,000 is above five deviations of a part.
    begins = int(np.argmax(near > 5 * noise)) - before
    return float(10 * np.log10(np.sum(near**2) / np.sum(own**2))), float(1 + np.argmax(own) - begins)


def features_of(exchanges: Exchanges, source: object) -> NDArray[np.float32]:
    """Return the `FEATURES` (n, 2) of exchanges by the table `cirs` of a source, NaN where unknown."""
    found = np.full((len(exchanges), len(FEATURES)), np.nan, dtype=np.float32)
    for some in _responses(source):
        of_ends = (some["board"] == some["initiator"]) | (some["board"] == some["target"])
        some = {name: column[of_ends] for name, column in some.items()}
        rows, which = _exchange_of(exchanges, some)
        told = [response_features(some["magnitudes"][row], some["first_path_index"][row]) for row in rows]
        for k, values in enumerate(np.array(told).reshape(-1, 2).T):
            means = _means(which, values, len(exchanges))
            found[:, k] = np.where(np.isfinite(means), means, found[:, k])
    return found


def _responses(source: object) -> Iterable[Columns]:
    """Yield the impulse responses of a source as columns, those of a recording some at a time: each has 2 kB."""
    recording = getattr(source, "recording", None)
    if isinstance(recording, Recording):
        edges = recording.dividing_times("cirs", 2000)
        for start_ns, end_ns in pairwise([*edges[:-1], edges[-1] + 1] if edges else []):
            yield recording.columns("cirs", start_ns, end_ns)
    elif rows := getattr(source, "cirs", None):
        yield {name: _column([getattr(row, name) for row in rows]) for name in CirRow.__dataclass_fields__}


def _column(values: list[Any]) -> NDArray[Any]:
    column = np.empty(len(values), dtype=object if isinstance(values[0], tuple) else type(values[0]))
    column[:] = values
    return column


def _exchange_of(exchanges: Exchanges, rows: Columns) -> tuple[Ints, Ints]:
    """Return which rows belong to an exchange (m,), and the exchange of each: the last one of their pair before them.

    Boards print a response after its exchange, in MILUV 0.13 s in the median: it may be 0.4 s late, and 10 ms early.
    """
    pairs, time_ns = _pairs(exchanges.initiator, exchanges.target), exchanges.time_ns
    order = np.lexsort((time_ns, pairs))
    own = _pairs(rows["initiator"], rows["target"])
    found = np.full(len(own), -1)
    for pair in np.unique(own).tolist():
        some, mine = order[pairs[order] == pair], np.flatnonzero(own == pair)
        before = np.searchsorted(time_ns[some], rows["time_ns"][mine] + 10_000_000, side="right") - 1
        found[mine] = np.where(before >= 0, some[before] if len(some) else -1, -1)
    late = rows["time_ns"] - time_ns[found] > 400_000_000 if len(time_ns) else True
    belongs = np.flatnonzero((found >= 0) & ~late)
    return belongs, found[belongs]


def _pairs(initiator: Ints, target: Ints) -> Ints:
    return np.asarray(initiator).astype(np.int64) << 16 | np.asarray(target).astype(np.int64)


def _means(which: Ints, values: Floats, count: int) -> Floats:
    """Return the mean of finite values (m,) by the exchange that they belong to (count,), NaN without any."""
    known = np.isfinite(values)
    total, number = np.bincount(which[known], values[known], count), np.bincount(which[known], minlength=count)
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)
