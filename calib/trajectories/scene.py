"""What a fit of trajectories is given: ranges, who carries which tag, and all that is known of places and attitudes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from calib.data.ranges import Ranges
from calib.trajectories.attitudes import Attitude
from calib.trajectories.heights import Heights, no_heights
from calib.trajectories.inertial import Inertial
from calib.trajectories.tapes import Tapes, no_tapes
from uwblink.arrays import Bools, Floats, Ints

NOWHERE: Final = -1


@dataclass(frozen=True, slots=True)
class Places:
    """Places of moving bodies that are known: seconds (k,), number of the body (k,), metres (k, 3), standard errors."""

    time_s: Floats
    body: Ints
    position_m: Floats
    std_m: Floats

    def __getitem__(self, rows: Bools) -> Places:
        """Return the chosen ones."""
        return Places(self.time_s[rows], self.body[rows], self.position_m[rows], self.std_m[rows])

    def __add__(self, other: Places) -> Places:
        """Return both."""
        names = ("time_s", "body", "position_m", "std_m")
        return Places(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Ranges (n,) at `time_s` (n,) between tags of bodies that move or stand still.

    `moving` names the bodies that move; `still` has those that do not, with their place or None where it is to be
    found. `arms` says of each tag its body and lever arm. `attitudes` are those of moving bodies; a body without any
    has its tags in its middle. `tapes` are distances that were measured otherwise, `heights` readings of sensors.
    """

    source: str
    ranges: Ranges
    time_s: Floats
    moving: tuple[str, ...]
    still: Mapping[str, Floats | None]
    still_turned: Mapping[str, Floats] = field(default_factory=dict)
    arms: Mapping[int, tuple[str, Floats]]
    attitudes: Mapping[str, Attitude]
    places: Places
    inertial: Mapping[str, Inertial] = field(default_factory=dict)
    heights: Heights = field(default_factory=no_heights)
    tapes: Tapes = field(default_factory=no_tapes)

    @property
    def sought(self) -> list[str]:
        """Return the bodies that stand still at places that are to be found."""
        return [body for body, place in self.still.items() if place is None]

    @property
    def by_geometry_alone(self) -> bool:
        """Whether nothing says how far anything is but how ranges between lever arms fit together in space."""
        given = sum(place is not None for place in self.still.values())
        told = len(self.places.time_s), len(self.heights.time_s), len(self.inertial), len(self.tapes.told)
        return given < 2 and not any(told)

    def between(self, begin_s: float, end_s: float) -> Scene:
        """Return what lies within a span of time."""
        known = (self.places.time_s >= begin_s) & (self.places.time_s <= end_s)
        rows = np.flatnonzero((self.time_s >= begin_s) & (self.time_s <= end_s))
        inertial = {body: sensed.within(begin_s, end_s) for body, sensed in self.inertial.items()}
        return replace(
            self.only(rows),
            places=self.places[known],
            inertial=inertial,
            heights=self.heights.within(begin_s, end_s),
            tapes=self.tapes.within(begin_s, end_s),
        )

    def at(self, places: Places) -> Scene:
        """Return the scene with these places, and nothing else that is known beside its attitudes."""
        return replace(self, places=places, inertial={}, heights=no_heights(), tapes=no_tapes())

    def only(self, rows: Ints) -> Scene:
        """Return the scene with some of its ranges."""
        columns = {name: getattr(self, name)[rows] for name in ("ranges", "time_s")}
        return replace(self, **columns)


@dataclass(frozen=True, slots=True)
class Ends:
    """One end of each range (n,): what carries the antenna there.

    `mover` and `stander` number the moving body or the one whose place is sought, -1 for neither; `base_m` (n, 3) is
    the antenna of a body at a known place, or how far it is from the middle of a standing one; `arm_m` (n, 3) is how
    far it is from the middle of a moving body by its given attitude.
    """

    mover: Ints
    stander: Ints
    base_m: Floats
    arm_m: Floats


def ends_of(scene: Scene, ids: Ints, time_s: Floats) -> Ends:
    """Return the ends at tags `ids` (n,) at instants (n,)."""
    count = len(ids)
    mover, stander = np.full(count, NOWHERE), np.full(count, NOWHERE)
    base, arm = np.zeros((count, 3)), np.zeros((count, 3))
    sought = scene.sought
    for tag, (body, lever) in scene.arms.items():
        rows = np.flatnonzero(ids == tag)
        if not len(rows):
            continue
        if body in scene.still:
            place = scene.still[body]
            turned = scene.still_turned.get(body, np.eye(3)) @ lever
            base[rows] = turned if place is None else place + turned
            stander[rows] = sought.index(body) if place is None else NOWHERE
        else:
            mover[rows] = scene.moving.index(body)
            if body in scene.attitudes:
                arm[rows] = scene.attitudes[body].at(time_s[rows]) @ lever
    return Ends(mover, stander, base, arm)
