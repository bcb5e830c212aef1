"""What the doctor looks at of a recording that is too long to look at as a whole: stretches over all of its time.

What the doctor finds shows in shares, medians and what lasts, for which some hundred thousand exchanges do; stretches,
and not single exchanges, because what lasts, and what comes one after the other, shows in neighbours alone.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calib.data.sources import RecordedSource, Source, no_poses
from uwblink.recording.file import Recording
from uwblink.recording.schema import Fault, Poses, Tag
from uwblink.ticks import TICK_S
from uwblink.twr import Exchanges

MOST: Final = 160_000
"""Exchanges of a recording that are looked at: four training flights' worth."""

STRETCHES: Final = 40
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
    if isinstance(source, RecordedSource) and source.recording.count("exchanges") > MOST:
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
    if count <= MOST:
        return ""
    return f"about {MOST} of its {count} exchanges were looked at, in {STRETCHES} stretches over all of its time"


def _stretches(recording: Recording) -> Looked:
    spans = recording.stretches(MOST // STRETCHES)
    chosen = np.unique(np.linspace(0, len(spans) - 1, STRETCHES).round().astype(int)).tolist()
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
