"""Where the tags and anchors of a MILUV flight are, and which constellation of anchors it was flown beside."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.errors import ImportTableError
from uwblink.importers.miluv_files import Flight
from uwblink.importers.miluv_yaml import Vector, read_vectors
from uwblink.recording.distances import distances_m
from uwblink.recording.schema import Poses, Tag
from uwblink.twr import Exchanges

_SAME_ANCHORS_M: Final = 0.05
"""Median difference from `gt_range`: the constellations of the dataset are a decimetre and more apart."""


def read_tags(flight: Flight) -> list[Tag]:
    """Return the robots' tags and lever arms from tags.yaml; none where there is no such file."""
    path = flight.folder / "tags.yaml"
    if not path.exists():
        return []
    arms = read_vectors(path)
    names = {robot.name for robot in flight.robots}
    return [Tag(number, body, arm) for body, tags in arms.items() if body in names for number, arm in tags.items()]


@dataclass(frozen=True, slots=True)
class Anchors:
    """The anchors of a flight: the constellation's name (None: no anchors known), and their places by tag.

    `off_m` is the median difference of their distances from `gt_range`, NaN where nothing can be compared.
    """

    constellation: str | None
    off_m: float
    places_m: dict[int, Vector]

    def tags(self) -> list[Tag]:
        """Return the anchors as tags, each alone on a body of its own."""
        return [Tag(number, f"anchor{number}", (0.0, 0.0, 0.0)) for number in sorted(self.places_m)]

    def join(self, poses: Poses) -> Poses:
        """Return poses with one more for each anchor at their beginning: a body with a single pose does not move."""
        numbers = sorted(self.places_m)
        standing = Poses(
            np.full(len(numbers), poses.time_ns.min() if len(poses) else 0, dtype=np.int64),
            np.array([f"anchor{number}" for number in numbers], dtype=np.str_),
            np.array([self.places_m[number] for number in numbers], dtype=np.float64).reshape(-1, 3),
            np.tile([0.0, 0.0, 0.0, 1.0], (len(numbers), 1)),
        )
        return _joined(poses, standing)


def find_anchors(
    flight: Flight, exchanges: Exchanges, measured_m: Floats, poses: Poses, tags: list[Tag], wanted: str | None
) -> Anchors:
    """Return the constellation called `wanted`, or else the one whose distances are those of `gt_range`.

    Raises `ImportTableError` for a name that anchors.yaml does not have, and where no constellation fits.
    """
    path = flight.folder / "anchors.yaml"
    if not path.exists():
        if wanted is not None:
            raise ImportTableError(f"{path}: no such file, so there is no constellation {wanted[:40]!r}")
        return Anchors(None, float("nan"), {})
    known = read_vectors(path)
    if wanted is not None and wanted not in known:
        raise ImportTableError(f"{path}: no constellation {wanted[:40]!r}; there are {', '.join(known)}")
    ranging = {*exchanges.initiator.tolist(), *exchanges.target.tolist()} - {tag.tag for tag in tags}
    found = []
    for name, places in known.items():
        anchors = Anchors(name, float("nan"), {n: place for n, place in places.items() if n in ranging})
        found.append(replace(anchors, off_m=_off_m(anchors, exchanges, measured_m, poses, tags)))
    if wanted is not None:
        return next(anchors for anchors in found if anchors.constellation == wanted)
    if not ranging:
        return Anchors(None, float("nan"), {})
    best = min(found, key=lambda anchors: np.nan_to_num(anchors.off_m, nan=np.inf), default=None)
    if best is None or not best.off_m < _SAME_ANCHORS_M:
        raise ImportTableError(
            f"{path}: which constellation the flight was beside cannot be told from gt_range; "
            f"choose one of {', '.join(known)}"
        )
    return best


def _off_m(anchors: Anchors, exchanges: Exchanges, measured_m: Floats, poses: Poses, tags: list[Tag]) -> float:
    everything = [*tags, *anchors.tags()]
    true_m = distances_m(anchors.join(poses), everything, exchanges.initiator, exchanges.target, exchanges.time_ns)
    involved = np.isin(exchanges.target, list(anchors.places_m)) | np.isin(exchanges.initiator, list(anchors.places_m))
    off = np.abs(true_m - measured_m)[involved]
    return float(np.median(off[np.isfinite(off)])) if np.isfinite(off).any() else float("nan")


def _joined(poses: Poses, more: Poses) -> Poses:
    order = np.argsort(np.concatenate([poses.time_ns, more.time_ns]), kind="stable")
    pairs = ((getattr(poses, f.name), getattr(more, f.name)) for f in fields(Poses))
    return Poses(*(np.concatenate(pair)[order] for pair in pairs))


def unplaced(tags: list[Tag], exchanges: Exchanges) -> list[Tag]:
    """Return tags that range and of which no file says where they sit."""
    placed = {tag.tag for tag in tags}
    ranging = sorted({*exchanges.initiator.tolist(), *exchanges.target.tolist()} - placed)
    return [Tag(number, f"tag{number}", (0.0, 0.0, 0.0)) for number in ranging]
