"""A recording as checks see it; of a long one, stretches over all of its time.

Shares, medians and what lasts show in some hundred thousand exchanges. Stretches are taken, and not single exchanges,
because errors that last show in neighbours only.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from calib.data.sources import RecordedSource, Source, no_poses
from calib.spread import robust_spread
from uwblink.arrays import Bools, Floats, Ints
from uwblink.recording.file import Recording
from uwblink.recording.schema import Arrangement, Fault, Poses, Tag
from uwblink.ticks import TICK_S
from uwblink.twr import Exchanges

if TYPE_CHECKING:
    from calib.checks.quick_fit import QuickFit

PLAUSIBLE_M: Final = 1000.0


@dataclass(frozen=True, kw_only=True)
class RecordingView:
    """A recording as the examinations see it; `truth_m` (n,) is NaN where nothing says it.

    Each exchange is there once; `reported_twice` were reported by both ends, and `contradictions` say how two reports
    of one differ; `doubled` rows repeated another one. It is `posed` where true distances come from poses.
    `arrangements` are those that it marks.
    """

    name: str
    exchanges: Exchanges
    poses: Poses
    tags: list[Tag]
    faults: list[Fault]
    raw_m: Floats
    truth_m: Floats
    reported_twice: int = 0
    contradictions: tuple[str, ...] = ()
    doubled: int = 0
    posed: bool = False
    arrangements: tuple[Arrangement, ...] = ()

    @property
    def standing(self) -> bool:
        """Whether this was recorded to be surveyed: arrangements of boards, and nothing that says where they were."""
        return bool(self.arrangements) and not len(self.poses) and not np.isfinite(self.truth_m).any()

    @cached_property
    def quick_fit(self) -> QuickFit | None:
        """A quick fit with constants of pairs; None where too few ranges have a true distance."""
        from calib.checks.quick_fit import quick_fit

        return quick_fit([self])

    @property
    def error_m(self) -> Floats:
        """Range less truth, shape (n,)."""
        return self.raw_m - self.truth_m


def chosen(view: RecordingView, rows: Bools) -> RecordingView:
    """Return a view of some exchanges."""
    return replace(view, exchanges=view.exchanges[rows], raw_m=view.raw_m[rows], truth_m=view.truth_m[rows])


def spread_m(view: RecordingView, truth_m: Floats | None = None, raw_m: Floats | None = None) -> float:
    """Robust spread of errors after each pair's own median, metres; infinity where nothing is known."""
    error = (view.raw_m if raw_m is None else raw_m) - (view.truth_m if truth_m is None else truth_m)
    left = less_pairs(view, error)
    good = np.isfinite(left)
    return robust_spread(left[good], 0.0) if good.any() else float("inf")


def less_pairs(view: RecordingView, error_m: Floats) -> Floats:
    """Return errors (n,) less the median of their pair, NaN for pairs with ten or fewer."""
    pair = pair_ids(view.exchanges)
    left = np.full(len(error_m), np.nan)
    good = np.isfinite(error_m)
    for p in np.unique(pair[good]):
        rows = good & (pair == p)
        if np.count_nonzero(rows) > 10:
            left[rows] = error_m[rows] - np.median(error_m[rows])
    return left


def pair_ids(e: Exchanges) -> Ints:
    """Return one number for each pair of tags, whoever initiated, shape (n,)."""
    return np.asarray(np.minimum(e.initiator, e.target) * 65_536 + np.maximum(e.initiator, e.target))


def plausible_share(raw_m: Floats) -> float:
    """Return the share of ranges (n,) that a radio of this kind could measure."""
    with np.errstate(invalid="ignore"):
        return float(np.mean(np.abs(raw_m) < PLAUSIBLE_M))


EXAMINED_EXCHANGES: Final = 160_000
"""Exchanges of a recording that are looked at: four training flights' worth."""

EXAMINED_STRETCHES: Final = 40
MARGIN_NS: Final = 4_000_000_000
"""Poses are needed so far around exchanges: farther than the largest offset of clocks that is looked for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Looked:
    """What is looked at of a recording: its exchanges, or some of `count`, and the poses around them."""

    exchanges: Exchanges
    poses: Poses
    tags: list[Tag]
    faults: list[Fault]
    count: int


def looked_at(source: Source) -> Looked:
    """Return what to look at of a source: everything, of a long recording stretches of it."""
    if isinstance(source, RecordedSource) and source.recording.count("exchanges") > EXAMINED_EXCHANGES:
        return _stretches(source.recording)
    faults = list(getattr(source, "faults", ()))
    x = source.exchanges
    return Looked(exchanges=x, poses=source.poses, tags=list(source.tags), faults=faults, count=len(x))


def examined_part(recording: str | os.PathLike[str]) -> str:
    """Return how much of a recording `examine` looks at, in words; nothing where that is all of it.

    Raises what `Recording.open` raises.
    """
    with Recording.open(recording) as opened:
        count = opened.count("exchanges")
    if count <= EXAMINED_EXCHANGES:
        return ""
    return (
        f"about {EXAMINED_EXCHANGES} of its {count} exchanges were looked at, in {EXAMINED_STRETCHES} stretches over "
        "all of its time"
    )


def _stretches(recording: Recording) -> Looked:
    spans = recording.stretches(EXAMINED_EXCHANGES // EXAMINED_STRETCHES)
    chosen = np.unique(np.linspace(0, len(spans) - 1, EXAMINED_STRETCHES).round().astype(int)).tolist()
    windows, parts, poses = recording.pose_windows(), list[Exchanges](), list[Poses]()
    for start_ns, end_ns in (spans[k] for k in chosen):
        part = recording.exchanges_between(start_ns, end_ns)
        # A range belongs to the middle of its first two messages, which is after its time, by half a wrap at most.
        later = int(2**part.bits * TICK_S * 0.5e9) + 1
        parts.append(part)
        poses.append(windows.around(start_ns - MARGIN_NS, end_ns + later + MARGIN_NS))
    return Looked(
        exchanges=_joined(parts),
        poses=_once(poses),
        tags=recording.tags(),
        faults=recording.faults(),
        count=recording.count("exchanges"),
    )


def _joined(parts: list[Exchanges]) -> Exchanges:
    whole: dict[str, Any] = {name: np.concatenate(list(columns)) for name, columns in _columns(parts)}
    return replace(parts[0], **whole)


def _once(parts: list[Poses]) -> Poses:
    """Return poses in order of time, those that several have once."""
    every = replace(no_poses(), **{name: np.concatenate(list(columns)) for name, columns in _columns(parts)})
    body = np.unique(every.body, return_inverse=True)[1]
    order = np.lexsort((body, every.time_ns))
    time, who = every.time_ns[order], body[order]
    first = np.ones(len(order), dtype=bool)
    first[1:] = (np.diff(time) != 0) | (np.diff(who) != 0)
    return every[order[first]]


def _columns(parts: list[Any]) -> Iterator[tuple[str, Iterator[NDArray[Any]]]]:
    for field in fields(parts[0]):
        if isinstance(getattr(parts[0], field.name), np.ndarray):
            yield field.name, (getattr(part, field.name) for part in parts)
