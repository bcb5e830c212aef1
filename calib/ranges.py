"""From recordings to the columns a calibration works with; the only reader of recordings in here."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.errors import UnanswerableError
from uwblink.arrays import Bools, Floats, Ints
from uwblink.recording.distances import distances_m
from uwblink.recording.file import Recording
from uwblink.recording.schema import Poses, Tag
from uwblink.ticks import TICK_S
from uwblink.twr import Exchanges, delay_weights, intervals, raw_range


@dataclass(frozen=True, slots=True)
class Ranges:
    """Ranges with their truth as columns of length n.

    `raw_m` is the range recomputed from the stamps, `truth_m` the distance between the antennas;
    `weight_initiator` and `weight_target` are the derivatives of the calibrated time of flight with
    respect to the two tags' antenna delays. `excluded` counts by reason what was left out; `planted`
    is what a simulation put in, for display only.
    """

    source: str
    time_ns: Ints
    initiator: Ints
    target: Ints
    protocol: NDArray[np.str_]
    raw_m: Floats
    truth_m: Floats
    weight_initiator: Floats
    weight_target: Floats
    fpp1_dbm: Floats
    fpp2_dbm: Floats
    excluded: dict[str, int]
    planted: dict[str, Any] | None

    def __len__(self) -> int:
        """Return the number of ranges."""
        return len(self.time_ns)

    def __getitem__(self, rows: Bools | Ints | slice) -> Ranges:
        """Return the chosen rows, in their order."""
        return replace(self, **{name: getattr(self, name)[rows] for name in COLUMNS})

    def tags(self) -> list[int]:
        """Return the ids of the tags that range, in order."""
        counts = [np.bincount(ids) > 0 for ids in (self.initiator, self.target)]
        return sorted({*np.flatnonzero(counts[0]).tolist(), *np.flatnonzero(counts[1]).tolist()})


COLUMNS = tuple(f.name for f in fields(Ranges) if f.name not in {"source", "excluded", "planted"})


def load(path: str | os.PathLike[str]) -> Ranges:
    """Read a recording and work out true distances, leaving out what cannot be used.

    Raises the errors of `Recording.open`, and `UnanswerableError` when no exchange can be used.
    """
    with Recording.open(path) as recording:
        exchanges = recording.exchanges()
        truth = _truth(recording, exchanges)
        uncovered = _uncovered(recording, exchanges, truth)
        planted = recording.meta().get("planted")
    if not len(exchanges):
        raise UnanswerableError(f"{path}: holds no exchanges")
    raw = raw_range(exchanges)
    initiator, target = delay_weights(exchanges)
    ranges = Ranges(
        source=os.path.basename(path),
        time_ns=exchanges.time_ns,
        initiator=exchanges.initiator,
        target=exchanges.target,
        protocol=exchanges.protocol,
        raw_m=raw,
        truth_m=truth,
        weight_initiator=initiator,
        weight_target=target,
        fpp1_dbm=exchanges.fpp1_dbm,
        fpp2_dbm=exchanges.fpp2_dbm,
        excluded={},
        planted=planted if isinstance(planted, dict) else None,
    )
    return _usable(ranges, path, uncovered)


@dataclass(frozen=True, slots=True)
class Flight:
    """Ranges together with where bodies and tags were."""

    ranges: Ranges
    poses: Poses
    tags: list[Tag]

    def moving_bodies(self) -> list[str]:
        """Return the bodies whose position changes by more than a decimetre."""
        names = sorted(set(self.poses.body.tolist()))
        spans = {n: np.ptp(self.poses.position_m[self.poses.body == n], axis=0).max() for n in names}
        return [name for name in names if spans[name] > 0.1]


def load_flight(path: str | os.PathLike[str]) -> Flight:
    """Read a recording with its poses; raises what `load` raises."""
    ranges = load(path)
    with Recording.open(path) as recording:
        return Flight(ranges, recording.poses(), recording.tags())


def concatenate(parts: Sequence[Ranges]) -> Ranges:
    """Join the ranges of several recordings, in their order."""
    columns = {name: np.concatenate([getattr(p, name) for p in parts]) for name in COLUMNS}
    reasons = sorted({reason for p in parts for reason in p.excluded})
    return Ranges(
        source=", ".join(p.source for p in parts),
        excluded={r: sum(p.excluded.get(r, 0) for p in parts) for r in reasons},
        planted=parts[0].planted,
        **columns,
    )


STATIC = "static"
STATIC_S = 2.0
STATIC_M = 0.02


def without_static(ranges: Ranges) -> Ranges:
    """Leave out spans of two seconds in which a pair's distance stays within two centimetres.

    A flight that waits on the ground repeats one geometry, and with it one error. Raises `UnanswerableError` where
    nothing ever moves.
    """
    low, high = np.minimum(ranges.initiator, ranges.target), np.maximum(ranges.initiator, ranges.target)
    span = (ranges.time_ns - ranges.time_ns.min()) // int(STATIC_S * 1e9)
    order = np.lexsort((span, high, low))
    keys = np.column_stack([low, high, span])[order]
    starts = np.flatnonzero(np.any(np.diff(keys, axis=0, prepend=keys[:1] - 1) != 0, axis=1))
    truth = ranges.truth_m[order]
    reach = np.maximum.reduceat(truth, starts) - np.minimum.reduceat(truth, starts)
    moves = np.empty(len(ranges), dtype=bool)
    moves[order] = np.repeat(reach > STATIC_M, np.diff(starts, append=len(ranges)))
    if not moves.any():
        raise UnanswerableError(f"{ranges.source}: nothing moves, so `trim_static` leaves nothing")
    count = int(np.count_nonzero(~moves))
    return replace(ranges[moves], excluded=ranges.excluded | ({STATIC: count} if count else {}))


def _truth(recording: Recording, exchanges: Exchanges) -> Floats:
    if np.isfinite(exchanges.truth_m).all() or not recording.count("poses"):
        return exchanges.truth_m
    # A range belongs to the middle of its first two messages.
    middle = exchanges.time_ns + np.rint(intervals(exchanges).dt41 * (TICK_S * 5e8)).astype(np.int64)
    computed = distances_m(recording.poses(), recording.tags(), exchanges.initiator, exchanges.target, middle)
    return np.where(np.isfinite(exchanges.truth_m), exchanges.truth_m, computed)


def _uncovered(recording: Recording, exchanges: Exchanges, truth_m: Floats) -> str:
    """Say how poses and exchanges lie in time, where no exchange has a true distance although there are poses."""
    if np.isfinite(truth_m).any() or not recording.count("poses") or not len(exchanges):
        return ""
    poses = recording.poses()
    missing = sorted({t.body for t in recording.tags()} - set(np.unique(poses.body).tolist()))
    if missing:
        return f"no poses of body {missing[0]}"
    start = int(poses.time_ns[0])
    spans = [((int(t.min()) - start) * 1e-9, (int(t.max()) - start) * 1e-9) for t in (poses.time_ns, exchanges.time_ns)]
    return (
        f"its poses cover {spans[0][0]:.1f} to {spans[0][1]:.1f} s, its exchanges {spans[1][0]:.1f} to "
        f"{spans[1][1]:.1f} s after the first pose; shift the poses with 'uwblink poses --offset'"
    )


LOUDEST_DBM = -30.0
FAINTEST_DBM = -140.0
"""Powers beyond these bounds were not measured: a board that cannot tell a strong power prints 0."""


def _powers(fpp_dbm: Floats) -> Floats:
    """Return first-path powers (n,), NaN where the number cannot be one."""
    with np.errstate(invalid="ignore"):
        return np.where((fpp_dbm < LOUDEST_DBM) & (fpp_dbm > FAINTEST_DBM), fpp_dbm, np.nan)


def _usable(ranges: Ranges, path: str | os.PathLike[str], uncovered: str) -> Ranges:
    ranges = replace(ranges, fpp1_dbm=_powers(ranges.fpp1_dbm), fpp2_dbm=_powers(ranges.fpp2_dbm))
    reasons = {
        "no true distance": np.isfinite(ranges.truth_m),
        "no power": np.isfinite(ranges.fpp1_dbm) | np.isfinite(ranges.fpp2_dbm),
        "impossible stamps": np.isfinite(ranges.raw_m) & (np.abs(ranges.raw_m) < 1e4),
    }
    keep = np.ones(len(ranges), dtype=bool)
    excluded = {}
    for reason, good in reasons.items():
        excluded[reason] = int(np.count_nonzero(keep & ~good))
        keep &= good
    if not keep.any():
        most = max(excluded, key=lambda reason: excluded[reason])
        raise UnanswerableError(
            f"{path}: none of its {len(ranges)} exchanges can be used: {most}"
            + (f"; {uncovered or 'it needs poses and lever arms, or measured distances'}" if "true" in most else "")
        )
    return replace(ranges[keep], excluded={r: n for r, n in excluded.items() if n})
