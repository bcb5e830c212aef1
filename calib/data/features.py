"""Features of impulse responses that indicate a reflection, from the table `cirs`.

If the direct path is too weak for the chip's threshold, the chip takes a later, reflected path for the first one. Then
the response has more energy after its first path, and rises more slowly.
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
    """Return the energy of an impulse response relative to that of its first path in dB, and its rise time in taps.

    The energy is that of taps 20 before to 100 after the first path; the first path are the three taps after its index.
    The rise time is the number of taps from the first one above the noise to the largest of these three. Both are NaN
    if the first path is too near to the ends of the response.
    """
    taps = np.atleast_1d(np.asarray(magnitudes, dtype=np.float64))
    # A tap is 1 ns, so 100 taps contain detours of up to 30 m.
    before, after = 20, 100
    first = int(first_path_index) if 0 <= first_path_index <= len(taps) - after else 0
    # From tap 50 up to 40 taps before the first path there is only noise.
    quiet, own = taps[50 : max(first - 2 * before, 0)], taps[first + 1 : first + 4]
    if len(quiet) < before or not own.any():
        return np.nan, np.nan
    near = taps[first - before : first + after]
    noise = np.sqrt(np.mean(quiet**2) / 2)
    # Magnitudes of noise have a Rayleigh distribution with this sigma: one of 20 exceeds 5 sigma with probability 1e-4.
    begins = int(np.argmax(near > 5 * noise)) - before
    return float(10 * np.log10(np.sum(near**2) / np.sum(own**2))), float(1 + np.argmax(own) - begins)


def features_of(exchanges: Exchanges, source: object) -> NDArray[np.float32]:
    """Return the `FEATURES` (n, 2) of exchanges from the table `cirs` of a source, NaN if unknown.

    Values are means over the receptions at initiator and target.
    """
    found = np.full((len(exchanges), len(FEATURES)), np.nan, dtype=np.float32)
    for some in _responses(source):
        of_ends = (some["board"] == some["initiator"]) | (some["board"] == some["target"])
        some = {name: column[of_ends] for name, column in some.items()}
        rows, which = _exchange_of(exchanges, some)
        features = [response_features(some["magnitudes"][row], some["first_path_index"][row]) for row in rows]
        for k, values in enumerate(np.array(features).reshape(-1, 2).T):
            means = _means(which, values, len(exchanges))
            found[:, k] = np.where(np.isfinite(means), means, found[:, k])
    return found


def _responses(source: object) -> Iterable[Columns]:
    """Yield the impulse responses of a source as columns; those of a recording in blocks, because each has 2 kB."""
    recording = getattr(source, "recording", None)
    if isinstance(recording, Recording):
        edges = recording.dividing_times("cirs", 2000)
        for start_ns, end_ns in pairwise([*edges[:-1], edges[-1] + 1] if edges else []):
            yield recording.columns("cirs", start_ns, end_ns)
    elif rows := getattr(source, "cirs", None):
        # Responses may differ in length.
        kinds = {name: object if name == "magnitudes" else None for name in CirRow.__dataclass_fields__}
        yield {name: np.array([getattr(row, name) for row in rows], dtype=kind) for name, kind in kinds.items()}


def _exchange_of(exchanges: Exchanges, rows: Columns) -> tuple[Ints, Ints]:
    """Return the rows (m,) of impulse responses that belong to an exchange, and the exchange of each (m,).

    It is the last exchange of the pair before the response, at most 0.4 s ago. Boards print a response after its
    exchange, in MILUV with a median delay of 0.13 s. A response may have a time up to 10 ms before its exchange.
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
    """Return the mean of the finite values (m,) of each exchange (count,), NaN without any; `which` (m,) numbers it."""
    known = np.isfinite(values)
    total, number = np.bincount(which[known], values[known], count), np.bincount(which[known], minlength=count)
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)
