"""Links between antennas, their ends, and the bodies that may obstruct them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from uwblink.arrays import Floats, Ints
from uwbsim.scenario.bodies import Shadow
from uwbsim.scenario.devices import Body
from uwbsim.scenario.model import Scenario
from uwbsim.world.diffraction import body_gain, ellipsoid_chord_m, near_body
from uwbsim.world.radio import antenna_gain_db

if TYPE_CHECKING:
    from uwbsim.world.world import World


@dataclass(frozen=True, slots=True)
class Link:
    """n links between two antennas each, (n,).

    `distance_m` is the length of the straight line, `excess_m` the apparent additional length of the first detected
    path; `power_dbm` is that path's power, `total_dbm` that of all paths together. With several paths, `paths_m` and
    `paths_dbm` are the lengths and powers of all, (n, paths), in any order. With geometric responses, `noise_s` is the
    standard deviation of the leading edge of the first path by noise.
    """

    distance_m: Floats
    excess_m: Floats
    power_dbm: Floats
    total_dbm: Floats
    _: KW_ONLY
    paths_m: Floats | None = None
    paths_dbm: Floats | None = None
    noise_s: Floats | None = None

    @classmethod
    def concatenate(cls, parts: Sequence[Link]) -> Link:
        """Return the links of one or more parts, which have the same columns."""
        columns = {
            column.name: np.concatenate([getattr(part, column.name) for part in parts])
            for column in fields(cls)
            if getattr(parts[0], column.name) is not None
        }
        return cls(**columns)

    def __getitem__(self, rows: Ints) -> Link:
        """Return the chosen links."""
        columns = {column.name: getattr(self, column.name) for column in fields(self)}
        return replace(self, **{name: column[rows] for name, column in columns.items() if column is not None})

    def weaker(self, loss_db: Floats) -> Link:
        """Return the links with a loss (n,) on all their paths."""
        paths = None if self.paths_dbm is None else self.paths_dbm - loss_db[:, None]
        return replace(self, power_dbm=self.power_dbm - loss_db, total_dbm=self.total_dbm - loss_db, paths_dbm=paths)


@dataclass(frozen=True, slots=True)
class PlacedBody:
    """A body with a shadow at n instants: positions (n, 3) in metres, rotations body to world (n, 3, 3)."""

    body: Body
    shadow: Shadow
    position_m: Floats
    rotation: Floats

    def loss_db(self, one: Floats, other: Floats) -> Floats:
        """Return the loss by the body on segments (n, k or 1, 3) to (n, k, 3), in dB, (n, k)."""
        a, b = ((spots - self.position_m[:, None]) @ self.rotation for spots in (one, other))
        return ellipsoid_chord_m(self.shadow, a, b) * self.shadow.loss_db_per_m

    def gain(self, instants: Ints, a: Floats, b: Floats) -> Floats:
        """Return the relative field behind the body on segments (m, 3) to (m, 3) at instants with indices (m,)."""
        centre = self.position_m + self.rotation @ np.array(self.shadow.centre_m)
        rows = near_body(self.shadow, a - centre[instants], b - a)
        at, gain = instants[rows], np.ones(len(a))
        ends = (np.einsum("nj,njk->nk", end[rows] - self.position_m[at], self.rotation[at]) for end in (a, b))
        gain[rows] = body_gain(self.shadow, *ends)
        return gain


@dataclass(frozen=True, slots=True, kw_only=True)
class Ends:
    """The two ends of n links, each at one instant, in the world frame; the first end sends.

    `time_s` (n,) is true time; `places` are the indices of the two tags in the scenario, (n,) each; `antennas_m` the
    positions of their antennas, (n, 3) each, and `rotations` their attitudes, body to world, (n, 3, 3) each. `shadows`
    are the bodies that may obstruct links.
    """

    world: World
    time_s: Floats
    places: tuple[Ints, Ints]
    antennas_m: tuple[Floats, Floats]
    rotations: tuple[Floats, Floats]
    shadows: Sequence[PlacedBody]

    @property
    def distance_m(self) -> Floats:
        """Return the lengths of the straight lines, (n,)."""
        apart = self.antennas_m[1] - self.antennas_m[0]
        return np.asarray(np.sqrt(np.einsum("ij,ij->i", apart, apart)))

    @property
    def scenario(self) -> Scenario:
        """Return the scenario of the world."""
        return self.world.scenario

    @property
    def towards(self) -> Floats:
        """Return unit vectors from the sender to the receiver, (n, 3)."""
        return (self.antennas_m[1] - self.antennas_m[0]) / np.maximum(self.distance_m, 1e-10)[:, None]

    def gain_towards_db(self, leaving: Floats, arriving: Floats) -> Floats:
        """Return the gain of both antennas and the offset of the sender's power on paths, (n,).

        `leaving` are unit vectors (n, 3) from the sender along the paths, `arriving` those from the receiver.
        """
        gain = np.zeros(len(leaving))
        for tags, rotation, way in zip(self.places, self.rotations, (leaving, arriving), strict=True):
            own = np.einsum("ni,nij->nj", way, rotation)
            gain = gain + antenna_gain_db(self.scenario, self.world.phases, tags, own)
        return np.asarray(gain + np.array([tag.tx_power_db for tag in self.scenario.tags])[self.places[0]])

    def tags(self) -> tuple[Ints, Ints]:
        """Return the ids of the tags at the two ends, (n,) each."""
        ids = np.array([tag.id for tag in self.scenario.tags], dtype=np.int64)
        return ids[self.places[0]], ids[self.places[1]]
