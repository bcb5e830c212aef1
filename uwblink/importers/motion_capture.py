"""Motion-capture truth for a recording of boards."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from uwblink.arrays import Floats, few_words
from uwblink.errors import ImportTableError, RecordingExistsError
from uwblink.importers.poses import read_poses
from uwblink.importers.units import other_unit
from uwblink.recording.distances import distances_m, find_offset
from uwblink.recording.file import Recording
from uwblink.recording.schema import Poses, Tag
from uwblink.recording.tags import load_places
from uwblink.twr import Exchanges, raw_range


@dataclass(frozen=True, slots=True)
class AddedPoses:
    """What was added: how many poses of which bodies, the offset used, and how many exchanges they cover."""

    poses: int
    bodies: tuple[str, ...]
    offset_s: float
    exchanges: int
    covered: int


def add_poses(
    recording: Path,
    source: Path | Mapping[str, Path],
    *,
    offset: str = "0",
    tags_from: Path | None = None,
    body: str | None = None,
    topics: Mapping[str, str] | None = None,
    force: bool = False,
) -> AddedPoses:
    """Put poses from a file, or files by body, into a recording; `offset` is in seconds, or "auto".

    `tags_from` is a TOML file with `[[tags]]`, and `[[anchors]]` that stand still. `topics` are those of a bag to read,
    by body; `body` names that of a file which does not. Raises `RecordingExistsError` where there are poses already,
    unless `force` replaces them, `ImportTableError` for poses that cannot be used, what `load_places` and
    `Recording.open` raise; the recording stays as it was then.
    """
    shift_ns = None if offset == "auto" else _seconds(offset)
    files = source if isinstance(source, Mapping) else {body: source}
    parts = [read_poses(path, name, topics) for name, path in files.items()]
    what = ", ".join(str(path) for path in files.values())
    given, anchors = load_places(tags_from) if tags_from else ((), {})
    standing = [Tag(number, f"anchor{number}", (0.0, 0.0, 0.0)) for number in anchors]
    poses = _joined([*parts, *(Poses.from_arrays([0], f"anchor{n}", [place]) for n, place in anchors.items())])
    with Recording.open(recording, update=True) as opened:
        if not force and (there := opened.count("poses")):
            raise RecordingExistsError(f"{recording}: holds {there} poses already; `force` replaces them")
        exchanges = opened.exchanges()
        seats = [tag for tag in (given or opened.tags()) if tag.tag not in anchors] + standing
        if not len(exchanges):
            raise ImportTableError(f"{recording}: holds no exchanges to add truth to")
        bodies = _bodies(poses)
        sitting = [tag for tag in seats if tag.body in bodies]
        if len(sitting) < 2:
            found = ", ".join(sorted({tag.body for tag in seats})) or "none"
            raise ImportTableError(
                f"{what}: its bodies are {', '.join(sorted(bodies))}, those of the tags {found}; "
                "say in `tags_from` where the tags sit"
            )
        if shift_ns is None:
            _check_units(what, exchanges, poses, seats, int(exchanges.time_ns.min() - poses.time_ns.min()))
            shift_ns = find_offset(exchanges, poses, seats).offset_ns
        moved = replace(poses, time_ns=poses.time_ns + shift_ns)
        truth = distances_m(moved, seats, exchanges.initiator, exchanges.target, exchanges.time_ns)
        covered = int(np.count_nonzero(np.isfinite(truth)))
        if not covered:
            raise ImportTableError(
                f"{what}: no exchange lies within its poses, which end {_apart(exchanges.time_ns, moved.time_ns)}; "
                "give `offset` in seconds, or auto"
            )
        _check_units(what, exchanges, moved, seats)
        meta = {"poses_from": ", ".join(path.name for path in files.values()), "poses_offset_s": shift_ns * 1e-9}
        opened.replace_poses(moved, meta, seats if tags_from else None)
    return AddedPoses(len(poses), tuple(sorted(bodies)), shift_ns * 1e-9, len(exchanges), covered)


def _check_units(what: str, exchanges: Exchanges, poses: Poses, tags: Sequence[Tag], shift_ns: int = 0) -> None:
    """Raise `ImportTableError` where the ranges say that positions, lever arms or themselves are not in metres."""
    rows = np.unique(np.linspace(0, len(exchanges) - 1, 2000).astype(np.int64))
    some = exchanges[rows]
    ranges, time_ns = raw_range(some), some.time_ns - shift_ns

    def distances(place: float, arm: float) -> Floats:
        moved = replace(poses, position_m=poses.position_m * place)
        arms = [[arm * x for x in tag.lever_arm_m] for tag in tags]
        seats = [replace(tag, lever_arm_m=(x, y, z)) for tag, (x, y, z) in zip(tags, arms, strict=True)]
        return distances_m(moved, seats, some.initiator, some.target, time_ns)

    errors = {
        "its positions": lambda factor: ranges - distances(factor, 1.0),
        "lever arms": lambda factor: ranges - distances(1.0, factor),
        "its positions and the lever arms": lambda factor: ranges - distances(factor, factor),
        "the ranges": lambda factor: ranges - distances(1.0, 1.0) / factor,
    }
    found = other_unit(errors)
    if found:
        raise ImportTableError(
            f"{what}: {found[0]} are in {found[1]}, not metres, by comparison of ranges and distances; convert them"
        )


def _bodies(poses: Poses) -> set[str]:
    few = few_words(poses.body)
    return set((few[0] if few else np.unique(poses.body)).tolist())


def _joined(parts: list[Poses]) -> Poses:
    """Return poses in order of time; those that stand still are given the time of the first that do not."""
    if len(parts) == 1:
        return parts[0]
    first = min((int(part.time_ns.min()) for part in parts if len(part) > 1), default=0)
    times = [part.time_ns if len(part) > 1 else np.full(len(part), first) for part in parts]
    order = np.argsort(np.concatenate(times), kind="stable")
    return Poses(
        np.concatenate(times)[order],
        np.concatenate([part.body for part in parts])[order],
        np.concatenate([part.position_m for part in parts])[order],
        np.concatenate([part.quaternion for part in parts])[order],
    )


def _seconds(text: str) -> int:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or abs(value) > 4e9:
        raise ImportTableError(f"`offset`: found {text!r}, expected seconds or auto")
    return round(value * 1e9)


def _apart(exchanges_ns: np.ndarray, poses_ns: np.ndarray) -> str:
    early_s = (int(exchanges_ns.min()) - int(poses_ns.max())) * 1e-9
    late_s = (int(poses_ns.min()) - int(exchanges_ns.max())) * 1e-9
    return f"{early_s:.1f} s before they begin" if early_s > 0 else f"and begin {late_s:.1f} s after they end"
