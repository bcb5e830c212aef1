"""Each tag's antenna with the body that carries it, as a table over all directions: for many directions at once.

Directions are folded onto an octahedron and that onto a square, so that a look-up takes no trigonometry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from uwblink.arrays import Floats, Ints
from uwbsim.scenario.model import Scenario
from uwbsim.world.diffraction import body_gain
from uwbsim.world.patterns import pattern_gain_db
from uwbsim.world.radio import gain_db

CELLS: Final = 128
"""A side of the square: a direction is known to a degree."""

AWAY_M: Final = 3.0
"""So far away what an antenna sends is looked at: further than the shadow of its own body reaches."""

NOWHERE: Final = 1e-12


@dataclass(frozen=True, slots=True)
class Patterns:
    """Amplitude gains of t different antennas with their bodies, (t, cells), and which each tag has, (tags,)."""

    table: Floats
    which: Ints
    level: bool

    @classmethod
    def of(cls, scenario: Scenario, phases: Floats) -> Self:
        """Tabulate those of a scenario's tags; `phases` (tags, harmonics) are those of their shadowing."""
        directions, radio = _directions(), scenario.radio
        shadows = {body.name: body.shadow for body in scenario.bodies}
        tables: list[Floats] = []
        which: dict[object, int] = {}
        places = []
        for place, (tag, own) in enumerate(zip(scenario.tags, phases, strict=True)):
            shadow = shadows[tag.body]
            shape = tuple(own) if radio.shadowing_db else None
            kind = (shadow, tag.lever_arm_m if shadow else None, shape, tag.pattern_db)
            if kind not in which:
                which[kind] = len(tables)
                me = np.full(len(directions), place)
                gain = 10 ** (antenna_gain_db(scenario, phases, me, directions) / 20)
                if shadow:
                    arm = np.broadcast_to(np.array(tag.lever_arm_m), directions.shape)
                    gain = gain * body_gain(shadow, arm, arm + AWAY_M * directions)
                tables.append(gain)
            places.append(which[kind])
        level = all(bool(np.all(table == 1)) for table in tables)
        return cls(np.array(tables).ravel(), np.array(places), level)

    def gain(self, tag: Ints, own: Sequence[Floats]) -> Floats:
        """Return the gains of tags (n,) in directions of any length whose three coordinates are (n, k) each, (n, k)."""
        x, y, z = own
        if self.level:
            return np.ones(x.shape)
        wide = (CELLS / 2) / np.maximum(np.abs(x) + np.abs(y) + np.abs(z), NOWHERE)
        u, v = x * wide, y * wide
        half = CELLS / 2
        folded_u, folded_v = np.copysign(half - np.abs(v), u), np.copysign(half - np.abs(u), v)
        below = z < 0
        cell = (np.where(below, folded_u, u) + (half + 0.5)).astype(np.int32) * (CELLS + 1)
        cell += (np.where(below, folded_v, v) + (half + 0.5)).astype(np.int32)
        return np.asarray(self.table[cell + (self.which[tag] * (CELLS + 1) ** 2)[:, None]])


def antenna_gain_db(scenario: Scenario, phases: Floats, tags: Ints, direction: Floats) -> Floats:
    """Return the gains in dB of tags at places (n,) towards unit vectors (n, 3) in their bodies' frames, (n,).

    `phases` (tags, harmonics) are those of the tags' shadowing.
    """
    gain = gain_db(scenario.radio, phases[tags] if scenario.radio.shadowing_db else phases, direction)
    for place, tag in enumerate(scenario.tags):
        if tag.pattern_db:
            mine = np.flatnonzero(tags == place)
            gain[mine] += pattern_gain_db(tag.pattern_db, direction[mine])
    return gain


def _directions() -> Floats:
    """Return the directions of all cells, (cells, 3)."""
    u, v = (np.ravel(w) for w in np.meshgrid(*[np.linspace(-1, 1, CELLS + 1)] * 2, indexing="ij"))
    z = 1 - np.abs(u) - np.abs(v)
    x = np.where(z < 0, np.copysign(1 - np.abs(v), u), u)
    y = np.where(z < 0, np.copysign(1 - np.abs(u), v), v)
    points = np.column_stack([x, y, z])
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))
