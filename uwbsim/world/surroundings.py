"""A scenario as waves see it: what reflects and scatters, what stands in the way, and antennas among it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from uwblink.arrays import Bools, Complexes, Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.random_streams import stream
from uwbsim.scenario.model import WAVELENGTH_M, Scenario
from uwbsim.scenario.multipath import GeometricMultipath
from uwbsim.scenario.surroundings import Shadow
from uwbsim.world.antenna_patterns import Patterns
from uwbsim.world.diffraction import LIT, body_gain
from uwbsim.world.mirrors import Mirrors
from uwbsim.world.propagation import through
from uwbsim.world.radio import path_gain_db

SHORTEST_M: Final = 0.05
FREE_SPACE: Final = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Scatterers:
    """Things at places (s, 3) in metres; what each adds to a way, in metres, and its complex gain as a mirror, (s,)."""

    place_m: Floats
    extra_m: Floats
    gain: Complexes

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        """Draw those of a scenario; each property has a stream, so that more of them leave the first where they are."""
        model, room = scenario.radio.multipath, scenario.room
        count = model.scatterers if isinstance(model, GeometricMultipath) and room else 0
        if not isinstance(model, GeometricMultipath) or room is None:
            return cls(place_m=np.zeros((0, 3)), extra_m=np.zeros(0), gain=np.zeros(0, dtype=np.complex128))
        places, extra, field = (
            stream(scenario.run.seed, "scatterers", what) for what in ("places", "bounces", "fields")
        )
        extra_m = extra.exponential(SPEED_OF_LIGHT * model.decay_s, count)
        parts = field.normal(size=(count, 2)) @ np.array([1, 1j]) / np.sqrt(2)
        return cls(
            place_m=places.uniform(room.min_m, room.max_m, (count, 3)),
            extra_m=extra_m,
            gain=parts * 10 ** (-model.scatter_loss_db / 20),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Surroundings:
    """A scenario as waves see it; `phases` (tags, harmonics) are those of the tags' shadowing."""

    scenario: Scenario
    mirrors: Mirrors
    scatterers: Scatterers
    patterns: Patterns
    phases: Floats

    @classmethod
    def of(cls, scenario: Scenario, phases: Floats) -> Self:
        """Collect what stands still, and draw the scatterers."""
        return cls(
            scenario=scenario,
            mirrors=Mirrors.of(scenario),
            scatterers=Scatterers.of(scenario),
            patterns=Patterns.of(scenario, phases),
            phases=phases,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Placed:
    """m antennas at an instant each: the tags' places in the scenario's list, positions (m, 3), rotations (m, 3, 3)."""

    tag: Ints
    antenna_m: Floats
    rotation: Floats

    def __getitem__(self, rows: Ints) -> Placed:
        """Return the chosen antennas."""
        return Placed(tag=self.tag[rows], antenna_m=self.antenna_m[rows], rotation=self.rotation[rows])


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacedBody:
    """A body with a shadow at m instants: its centre (m, 3) and rotation (m, 3, 3); `carries` (tags,) says whom."""

    shadow: Shadow
    position_m: Floats
    rotation: Floats
    carries: Bools

    def past(self, at: Ints, a: Floats, b: Floats) -> Floats:
        """Return the share of the field past it, of segments (n, 3) to (n, 3) at instants `at` (n,)."""
        spots = (self._inside(at, ends) for ends in (a, b))
        return body_gain(self.shadow, *spots)

    def past_fans(self, end: Placed, at: Ints, spots: Floats, length_m: Floats) -> Floats | float:
        """Return the same of k segments each, of known lengths (n, k), from antennas (n,) to spots (n, k, 3) or (k, 3).

        Those that pass further away than a zone at its widest are not looked at any closer, nor is a body's own tag:
        its pattern has its body.
        """
        a, k = end.antenna_m, self.shadow.centre_m
        towards = self.position_m[at] - a
        if any(k):
            towards = towards + self.rotation[at] @ np.array(k)
        along = towards @ spots.T if spots.ndim == 2 else np.einsum("nj,nkj->nk", towards, spots)
        along -= (towards * a).sum(axis=1)[:, None]
        squared = length_m**2
        share = along / squared
        np.clip(share, 0, 1, out=share)
        # |towards - share way|^2, less |towards|^2.
        squared *= share
        squared -= 2 * along
        squared *= share
        longest_m = float(length_m.max(initial=0.0))
        widest = max(self.shadow.semi_axes_m) - LIT * np.sqrt(WAVELENGTH_M / 8 * longest_m)
        allowed = np.where(self.carries[end.tag], -np.inf, widest**2 - (towards**2).sum(axis=1))
        rows, columns = np.nonzero(squared < allowed[:, None])
        if not len(rows):
            return 1.0
        gain = np.ones(length_m.shape)
        there = spots[columns] if spots.ndim == 2 else spots[rows, columns]
        gain[rows, columns] = self.past(at[rows], a[rows], there)
        return gain

    def _inside(self, at: Ints, spots: Floats) -> Floats:
        away = spots - self.position_m[at]
        return np.asarray(np.einsum("nj,njk->nk", away, self.rotation[at]))


def in_the_way(
    around: Surroundings, end: Placed, bodies: Sequence[PlacedBody], at: Ints, spots: Floats, length: Floats
) -> Floats:
    """What obstacles and others' bodies leave of the field from antennas to spots (n, k, 3) or (k, 3), (n, k).

    A tag's own body is part of its pattern.
    """
    left = np.ones(length.shape)
    if around.scenario.obstacles:
        begin = np.repeat(end.antenna_m, length.shape[1], axis=0)
        loss, _ = through(around.scenario.obstacles, begin, np.broadcast_to(spots, (*length.shape, 3)).reshape(-1, 3))
        left = 10 ** (-loss.reshape(left.shape) / 20)
    for body in bodies:
        left = left * body.past_fans(end, at, spots, length)
    return left


def field_after(scenario: Scenario, length: Floats) -> Floats:
    """Amplitude after a way without antennas: its square is the power in mW."""
    radio = scenario.radio
    if radio.path_loss_exponent == FREE_SPACE:
        return np.asarray(10 ** (radio.first_path_at_1m_dbm / 20) / np.maximum(length, SHORTEST_M))
    return np.asarray(10 ** (path_gain_db(radio, length) / 20))


def antenna_axes(scenario: Scenario, end: Placed) -> Floats:
    """Directions of the antennas, along which they are polarised: (n, 3)."""
    if scenario.radio.antenna == "isotropic":
        return np.broadcast_to(np.array([0.0, 0.0, 1.0]), (len(end.tag), 3))
    return end.rotation[:, :, 2]
