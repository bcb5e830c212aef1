"""All paths of waves between antennas in a scenario's surroundings: direct, reflected by faces, and by scatterers.

`paths_between` computes the paths of many links at once from `Surroundings` and the ends of the links.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from uwblink.arrays import Bools, Complexes, Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.random_streams import stream
from uwbsim.scenario.bodies import properties
from uwbsim.scenario.model import WAVELENGTH_M, Scenario
from uwbsim.scenario.radio import GeometricMultipath
from uwbsim.world.diffraction import (
    AXIAL,
    LIT_NU,
    WAVENUMBER,
    Mirrors,
    PlacedShadow,
    body_gain,
    box_chords_m,
    box_loss,
    boxes_blocked,
    face_fraction,
    planes,
    reflection_gain,
    roughness_factor,
)
from uwbsim.world.radio import NEAREST_PATH_M, antenna_gain_db, path_gain_db

CELLS: Final = 128
"""Cells along a side of the table of an antenna's gains: a resolution of a degree."""


@dataclass(frozen=True, slots=True)
class Patterns:
    """Amplitude gains of t different antennas with their bodies, (t * cells,), and the index of each tag's, (tags,).

    Directions are projected onto an octahedron, which is unfolded to a square, so that a look-up needs no trigonometry.
    `constant` says that all gains are one.
    """

    table: Floats
    which: Ints
    constant: bool

    @classmethod
    def of(cls, scenario: Scenario, phases: Floats) -> Self:
        """Tabulate the gains of a scenario's tags; `phases` (tags, harmonics) are those of their shadowing."""
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
                    # Seen from 3 m away, further than the shadow of its own body reaches.
                    gain = gain * body_gain(shadow, arm, arm + 3.0 * directions)
                tables.append(gain)
            places.append(which[kind])
        return cls(np.array(tables).ravel(), np.array(places), bool(np.all(np.array(tables) == 1)))

    def gain(self, tag: Ints, own: Sequence[Floats]) -> Floats:
        """Return the gains of tags (n,) in directions of any length whose three coordinates are (n, k) each, (n, k)."""
        x, y, z = own
        if self.constant:
            return np.ones(x.shape)
        wide = (CELLS / 2) / np.maximum(np.abs(x) + np.abs(y) + np.abs(z), 1e-12)
        u, v = x * wide, y * wide
        half = CELLS / 2
        folded_u, folded_v = np.copysign(half - np.abs(v), u), np.copysign(half - np.abs(u), v)
        below = z < 0
        cell = (np.where(below, folded_u, u) + (half + 0.5)).astype(np.int32) * (CELLS + 1)
        cell += (np.where(below, folded_v, v) + (half + 0.5)).astype(np.int32)
        return np.asarray(self.table[cell + (self.which[tag] * (CELLS + 1) ** 2)[:, None]])


def _directions() -> Floats:
    """Return the directions of all cells, (cells, 3)."""
    u, v = (np.ravel(w) for w in np.meshgrid(*[np.linspace(-1, 1, CELLS + 1)] * 2, indexing="ij"))
    z = 1 - np.abs(u) - np.abs(v)
    x = np.where(z < 0, np.copysign(1 - np.abs(v), u), u)
    y = np.where(z < 0, np.copysign(1 - np.abs(u), v), v)
    points = np.column_stack([x, y, z])
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))


@dataclass(frozen=True, slots=True, kw_only=True)
class Scatterers:
    """s scatterers: positions (s, 3) in metres, additional path length in metres and complex gain, (s,) each."""

    place_m: Floats
    extra_m: Floats
    gain: Complexes

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        """Draw the scatterers of a scenario; each property has a stream, so that more of them do not move the first."""
        model, room = scenario.radio.multipath, scenario.room
        if not isinstance(model, GeometricMultipath) or room is None:
            return cls(place_m=np.zeros((0, 3)), extra_m=np.zeros(0), gain=np.zeros(0, dtype=np.complex128))
        count, names = model.scatterers, ("places", "bounces", "fields")
        places, extra, field = (stream(scenario.run.seed, "scatterers", name) for name in names)
        parts = field.normal(size=(count, 2)) @ np.array([1, 1j]) / np.sqrt(2)
        return cls(
            place_m=places.uniform(room.min_m, room.max_m, (count, 3)),
            extra_m=extra.exponential(SPEED_OF_LIGHT * (model.decay_ns * 1e-9), count),
            gain=parts * 10 ** (-model.scatter_loss_db / 20),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Surroundings:
    """The parts of a scenario that paths depend on; `phases` (tags, harmonics) are those of the tags' shadowing."""

    scenario: Scenario
    mirrors: Mirrors
    scatterers: Scatterers
    patterns: Patterns
    phases: Floats

    @classmethod
    def of(cls, scenario: Scenario, phases: Floats) -> Self:
        """Collect faces and antenna patterns, and draw the scatterers."""
        return cls(
            scenario=scenario,
            mirrors=Mirrors.of(scenario),
            scatterers=Scatterers.of(scenario),
            patterns=Patterns.of(scenario, phases),
            phases=phases,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Placed:
    """m antennas at an instant each: indices of the tags, positions (m, 3), rotations (m, 3, 3)."""

    tag: Ints
    antenna_m: Floats
    rotation: Floats

    def __getitem__(self, rows: Ints) -> Placed:
        """Return the chosen antennas."""
        return Placed(tag=self.tag[rows], antenna_m=self.antenna_m[rows], rotation=self.rotation[rows])


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacedBody(PlacedShadow):
    """A body with a shadow at m instants; `carries` (tags,) says which tags it carries."""

    carries: Bools

    def gain(self, at: Ints, a: Floats, b: Floats) -> Floats:
        """Return the relative field behind it on segments (n, 3) to (n, 3) at instants `at` (n,)."""
        ends = (np.einsum("nj,njk->nk", end - self.position_m[at], self.rotation[at]) for end in (a, b))
        return body_gain(self.shadow, *ends)

    def fan_gain(self, end: Placed, at: Ints, spots: Floats, length_m: Floats) -> Floats | float:
        """Return the same for k segments of lengths (n, k) from each antenna (n,) to spots (n, k, 3) or (k, 3).

        It is 1, without further computation, for segments at more than the largest radius of a Fresnel zone, and for
        tags on the body, whose antenna patterns include it.
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
        widest = max(self.shadow.semi_axes_m) - LIT_NU * np.sqrt(WAVELENGTH_M / 8 * longest_m)
        allowed = np.where(self.carries[end.tag], -np.inf, widest**2 - (towards**2).sum(axis=1))
        rows, columns = np.nonzero(squared < allowed[:, None])
        if not len(rows):
            return 1.0
        gain = np.ones(length_m.shape)
        there = spots[columns] if spots.ndim == 2 else spots[rows, columns]
        gain[rows, columns] = self.gain(at[rows], a[rows], there)
        return gain


def obstruction_gain(
    around: Surroundings, end: Placed, bodies: Sequence[PlacedBody], at: Ints, spots: Floats, length: Floats
) -> Floats:
    """Return the relative field after obstacles and other bodies from antennas to spots (n, k, 3) or (k, 3), (n, k).

    A tag's own body is part of its antenna pattern.
    """
    left = np.ones(length.shape)
    if around.scenario.obstacles:
        begin = np.repeat(end.antenna_m, length.shape[1], axis=0)
        loss, _ = box_loss(around.scenario.obstacles, begin, np.broadcast_to(spots, (*length.shape, 3)).reshape(-1, 3))
        left = 10 ** (-loss.reshape(left.shape) / 20)
    for body in bodies:
        left = left * body.fan_gain(end, at, spots, length)
    return left


def free_space_field(scenario: Scenario, length: Floats) -> Floats:
    """Return the amplitude after a path length without antennas: its square is the power in mW."""
    radio = scenario.radio
    if radio.path_loss_exponent == 2.0:
        return np.asarray(10 ** (radio.first_path_at_1m_dbm / 20) / np.maximum(length, NEAREST_PATH_M))
    return np.asarray(10 ** (path_gain_db(radio, length) / 20))


def antenna_axes(scenario: Scenario, end: Placed) -> Floats:
    """Return the directions of the antennas' axes, along which they are polarised, (n, 3)."""
    if scenario.radio.antenna == "isotropic":
        return np.broadcast_to(np.array([0.0, 0.0, 1.0]), (len(end.tag), 3))
    return end.rotation[:, :, 2]


@dataclass(frozen=True, slots=True, kw_only=True)
class Paths:
    """p paths of n links: length less the straight line, in metres, and complex amplitude.

    Shapes (n, p); an amplitude's square is a power in mW, its phase that of the carrier.
    """

    detour_m: Floats
    amplitude: Complexes


@dataclass(frozen=True, slots=True, kw_only=True)
class Legs:
    """Legs from m antennas to s scatterers: lengths in metres, and amplitude gains with obstructions, (m, s) each."""

    length_m: Floats
    gain: Floats

    def __getitem__(self, rows: Ints) -> Legs:
        """Return the legs of the chosen antennas."""
        return Legs(length_m=self.length_m[rows], gain=self.gain[rows])


def legs_to_scatterers(around: Surroundings, ends: Placed, bodies: Sequence[PlacedBody], instant: Ints) -> Legs:
    """Return the legs from antennas (m,) to all scatterers; `instant` (m,) are the indices of the bodies' poses."""
    spots, a = around.scatterers.place_m, ends.antenna_m
    own = [
        ends.rotation[:, :, k] @ spots.T - np.einsum("mj,mj->m", ends.rotation[:, :, k], a)[:, None] for k in range(3)
    ]
    length = np.maximum(np.sqrt(own[0] ** 2 + own[1] ** 2 + own[2] ** 2), NEAREST_PATH_M)
    gain = around.patterns.gain(ends.tag, own)
    gain = gain * obstruction_gain(around, ends, bodies, instant, spots, length)
    return Legs(length_m=length, gain=gain)


def paths_between(
    around: Surroundings, ends: tuple[Placed, Placed], legs: tuple[Legs, Legs], bodies: Sequence[PlacedBody], at: Ints
) -> Paths:
    """Return all paths of n links between antennas, whose `legs` to the scatterers are known, at instants `at` (n,)."""
    a, b = (end.antenna_m for end in ends)
    distance = np.sqrt(np.einsum("nj,nj->n", b - a, b - a))
    parts = [
        _direct(around, ends, distance, bodies, at),
        _mirrored(around, ends, bodies, at),
        _scattered(around, legs),
    ]
    length = np.concatenate([part[0] for part in parts], axis=1)
    amplitude = np.concatenate([part[1] for part in parts], axis=1)
    return Paths(detour_m=length - distance[:, None], amplitude=amplitude * _phasors(length))


def _phasors(length: Floats) -> Complexes:
    """Return the phase factors of the carrier after path lengths, to single precision, which is much faster."""
    turns = length / WAVELENGTH_M
    angle = (-2 * np.pi * (turns - np.rint(turns))).astype(np.float32)
    turned = np.empty(length.shape, dtype=np.complex128)
    turned.real, turned.imag = np.cos(angle), np.sin(angle)
    return turned


def _direct(
    around: Surroundings, ends: tuple[Placed, Placed], distance: Floats, bodies: Sequence[PlacedBody], at: Ints
) -> tuple[Floats, Complexes]:
    """Return lengths and fields of the direct path around obstacles, and of that through them; (n, 2) each."""
    scenario = around.scenario
    a, b = (end.antenna_m for end in ends)
    towards = (b - a) / np.maximum(distance, 1e-10)[:, None]
    field = free_space_field(scenario, distance) * _polarisation_match(scenario, ends, towards)
    for end, way in zip(ends, (towards, -towards), strict=True):
        own = np.einsum("nj,njk->nk", way, end.rotation)
        field = field * 10 ** (antenna_gain_db(scenario, around.phases, end.tag, own) / 20)
    for body in bodies:
        field = field * body.gain(at, a, b)
    if not scenario.obstacles:
        return distance[:, None], field[:, None].astype(np.complex128)
    cover, edge = boxes_blocked(scenario.obstacles, a, b)
    loss, late = _inside_boxes(around, a, b)
    past = np.prod(1 - cover, axis=1)
    everything = np.prod(1 - cover * (1 - 10 ** (-loss / 20)), axis=1)
    # Deep in a shadow the path by the edge is nu^2/4 wavelengths longer; `cover` already has its phase.
    bent = np.maximum(edge.max(axis=1), 0) ** 2 / 4 * WAVELENGTH_M
    around_edges = field * past * np.exp(1j * WAVENUMBER * bent)
    slowed = np.minimum(np.abs(cover), 1.0) * late
    ways = np.column_stack([distance + bent, distance + slowed.sum(axis=1)])
    return ways, np.asarray(np.stack([around_edges, field * (everything - past)], axis=1), dtype=np.complex128)


def _inside_boxes(around: Surroundings, a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Return loss in dB and excess length in metres of paths through each box, (n, boxes) each.

    A path close to an edge goes through the least thickness of the box.
    """
    boxes = around.scenario.obstacles
    thinnest = np.array([min(hi - lo for lo, hi in zip(box.min_m, box.max_m, strict=True)) for box in boxes])
    chords = np.maximum(box_chords_m(boxes, a, b), thinnest)
    loss, index = np.array([properties(box.material) for box in boxes]).T
    return chords * loss, chords * (index - 1)


def _mirrored(
    around: Surroundings, ends: tuple[Placed, Placed], bodies: Sequence[PlacedBody], at: Ints
) -> tuple[Floats, Complexes]:
    """Return lengths and fields of the paths by walls and faces, (n, mirrors) each: single reflections by images."""
    mirrors, scenario = around.mirrors, around.scenario
    count, axis = len(at), mirrors.axis
    if not len(axis):
        return np.zeros((count, 0)), np.zeros((count, 0), dtype=np.complex128)
    a, b = (end.antenna_m for end in ends)
    plane, there = planes(mirrors, a, b)
    columns = np.arange(len(axis))
    # The vector to the image of the other end differs from that to the end in the coordinate across the mirror only.
    way = np.repeat((b - a).T[:, :, None], len(axis), axis=2)
    across = 2 * plane - a[:, axis] - b[:, axis]
    way[axis, :, columns] = across.T
    length = np.maximum(np.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2), NEAREST_PATH_M)
    share = np.clip((plane - a[:, axis]) / np.where(np.abs(across) < 1e-12, 1e-12, across), 0, 1)
    point = np.moveaxis(a.T[:, :, None] + share * way, 0, 2)
    cosine = across / length
    steep = np.abs(cosine)
    field = free_space_field(scenario, length) * roughness_factor(mirrors.roughness_m, steep)
    back = -way
    back[axis, :, columns] *= -1
    for end, leaving, legs in zip(ends, (way, back), (share, 1 - share), strict=True):
        own = [np.einsum("jnm,nj->nm", leaving, end.rotation[:, :, k]) for k in range(3)]
        leg = np.maximum(legs * length, NEAREST_PATH_M)
        field = field * around.patterns.gain(end.tag, own) * obstruction_gain(around, end, bodies, at, point, leg)
    axes = (antenna_axes(scenario, ends[0]), antenna_axes(scenario, ends[1]))
    reflected = reflection_gain(mirrors, axes, way / length, cosine)
    return length, np.where(there, field * reflected * face_fraction(mirrors, point, share, length), 0)


def _scattered(around: Surroundings, legs: tuple[Legs, Legs]) -> tuple[Floats, Complexes]:
    """Return lengths and fields of the paths by scatterers, (n, scatterers) each."""
    scatterers = around.scatterers
    length = legs[0].length_m + legs[1].length_m + scatterers.extra_m
    return length, (free_space_field(around.scenario, length) * legs[0].gain * legs[1].gain) * scatterers.gain


def _polarisation_match(scenario: Scenario, ends: tuple[Placed, Placed], towards: Floats) -> Floats:
    """Return the match of the antennas' polarisations on the direct path, (n,); 1 along their axes."""
    one, other = (antenna_axes(scenario, end) for end in ends)
    along = [np.einsum("nj,nj->n", axis, towards) for axis in (one, other)]
    size = np.sqrt(np.maximum((1 - along[0] ** 2) * (1 - along[1] ** 2), 0))
    match = (np.einsum("nj,nj->n", one, other) - along[0] * along[1]) / np.maximum(size, AXIAL)
    match = np.where(size < AXIAL, 1.0, match)
    # Chosen: cross-polarised antennas are coupled by a tenth of the field, -20 dB.
    return np.copysign(np.maximum(np.abs(match), 0.1), match)
