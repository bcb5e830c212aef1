"""Impulse responses of links from geometry: direct path, reflections by faces, and scatterers.
`GeometricResponses.paths` computes the paths of many links at once, and `at` the readings of receivers from their
responses. A pair has one response every few milliseconds; each call returns the response of the nearest step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self

import numpy as np

from uwblink.arrays import Complexes, Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.random_streams import stream
from uwbsim.scenario.bodies import Obstacle, properties
from uwbsim.scenario.model import WAVELENGTH_M, Scenario
from uwbsim.scenario.radio import GeometricMultipath
from uwbsim.world.channel import Ends
from uwbsim.world.diffraction import (
    AXIAL,
    WAVENUMBER,
    Mirrors,
    body_gain,
    box_chords_m,
    box_loss,
    boxes_blocked,
    face_fraction,
    planes,
    reflection_gain,
    roughness_factor,
)
from uwbsim.world.impulse_response import Detected, Paths, detect
from uwbsim.world.radio import NEAREST_PATH_M, antenna_gain_db, path_gain_db

if TYPE_CHECKING:
    from uwbsim.world.world import World

CELLS: Final = 128
"""Cells along a side of the table of an antenna's gains: a resolution of a degree."""


def antenna_tables(scenario: Scenario, phases: Floats) -> Floats:
    """Return the amplitude gains of antennas with their bodies by direction, (tags, cells).

    Directions are projected onto an octahedron, which is unfolded to a square, so that a look-up needs no trigonometry.
    `phases` (tags, harmonics) are those of the tags' shadowing.
    """
    u, v = (np.ravel(w) for w in np.meshgrid(*[np.linspace(-1, 1, CELLS + 1)] * 2, indexing="ij"))
    z = 1 - np.abs(u) - np.abs(v)
    x = np.where(z < 0, np.copysign(1 - np.abs(v), u), u)
    y = np.where(z < 0, np.copysign(1 - np.abs(u), v), v)
    points = np.column_stack([x, y, z])
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    shadows = {body.name: body.shadow for body in scenario.bodies}
    tables = []
    for place, tag in enumerate(scenario.tags):
        gain = 10 ** (antenna_gain_db(scenario, phases, np.full(len(directions), place), directions) / 20)
        if shadow := shadows[tag.body]:
            arm = np.broadcast_to(np.array(tag.lever_arm_m), directions.shape)
            # From a distance of 3 m, further than the shadow of the tag's own body.
            gain = gain * body_gain(shadow, arm, arm + 3.0 * directions)
        tables.append(gain)
    return np.array(tables)


def look_up_gain(tables: Floats, tag: Ints, own: Sequence[Floats]) -> Floats:
    """Return the gains of tags (n,) in directions of any length whose three coordinates are (n, k) each, (n, k)."""
    x, y, z = own
    half = CELLS / 2
    wide = half / np.maximum(np.abs(x) + np.abs(y) + np.abs(z), 1e-12)
    u, v = x * wide, y * wide
    folded_u, folded_v = np.copysign(half - np.abs(v), u), np.copysign(half - np.abs(u), v)
    below = z < 0
    cell = (np.where(below, folded_u, u) + (half + 0.5)).astype(np.int32) * (CELLS + 1)
    cell += (np.where(below, folded_v, v) + (half + 0.5)).astype(np.int32)
    return np.asarray(tables[tag[:, None], cell])


@dataclass(frozen=True, slots=True, kw_only=True)
class Scatterers:
    """s scatterers: positions (s, 3) in metres, additional path length in metres and complex gain, (s,) each."""

    place_m: Floats
    extra_m: Floats
    gain: Complexes

    @classmethod
    def of(cls, scenario: Scenario, model: GeometricMultipath) -> Self:
        """Draw the scatterers of a scenario; each property has its own random stream, so that more scatterers do not
        change the first ones.
        """
        room, names = scenario.room, ("places", "bounces", "fields")
        count = model.scatterers if room else 0
        places, extra, field = (stream(scenario.run.seed, "scatterers", name) for name in names)
        parts = field.normal(size=(count, 2)) @ np.array([1, 1j]) / np.sqrt(2)
        return cls(
            place_m=places.uniform(room.min_m, room.max_m, (count, 3)) if room else np.zeros((0, 3)),
            extra_m=extra.exponential(SPEED_OF_LIGHT * (model.decay_ns * 1e-9), count),
            gain=parts * 10 ** (-model.scatter_loss_db / 20),
        )


def free_space_field(scenario: Scenario, length: Floats) -> Floats:
    """Return the amplitude after a path length without antennas: its square is the power in mW."""
    radio = scenario.radio
    if radio.path_loss_exponent == 2.0:
        return np.asarray(10 ** (radio.first_path_at_1m_dbm / 20) / np.maximum(length, NEAREST_PATH_M))
    return np.asarray(10 ** (path_gain_db(radio, length) / 20))


def _phasors(length: Floats) -> Complexes:
    """Return the phase factors of the carrier after path lengths, to single precision, which is much faster."""
    turns = length / WAVELENGTH_M
    angle = (-2 * np.pi * (turns - np.rint(turns))).astype(np.float32)
    turned = np.empty(length.shape, dtype=np.complex128)
    turned.real, turned.imag = np.cos(angle), np.sin(angle)
    return turned


def _inside_boxes(boxes: Sequence[Obstacle], a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Return loss in dB and excess length in metres of paths through each box, (n, boxes) each.

    A path close to an edge goes through the least thickness of the box.
    """
    thinnest = np.array([min(hi - lo for lo, hi in zip(box.min_m, box.max_m, strict=True)) for box in boxes])
    chords = np.maximum(box_chords_m(boxes, a, b), thinnest)
    loss, index = np.array([properties(box.material) for box in boxes]).T
    return chords * loss, chords * (index - 1)


class GeometricResponses:
    """The paths of a world's pairs of tags, and readings of receivers from their responses; computed readings are kept.

    Both directions of a pair have one response, unless the tags' powers differ, which changes detection.
    """

    def __init__(self, world: World, model: GeometricMultipath) -> None:
        """Collect the faces, draw the scatterers, tabulate the antennas; responses are computed when needed."""
        self.world, self.model, self.scenario = world, model, world.scenario
        self.mirrors = Mirrors.of(world.scenario)
        self.scatterers = Scatterers.of(world.scenario, model)
        self.tables = antenna_tables(world.scenario, world.phases)
        self._known: dict[int, list[float]] = {}

    def at(self, places: tuple[Ints, Ints], time_s: Floats) -> Detected:
        """Return the readings of the responses between tags with indices (n,) at true times (n,)."""
        keys = self._key(places, time_s).tolist()
        if len(self._known) > 500_000:  # some 100 MB
            self._known.clear()
        missing = set(keys).difference(self._known)
        # Served boards need few new responses at a time, and soon the next steps, too: computing 16 at once takes a
        # third of the time.
        if len(missing) <= 100:
            step = len(self.scenario.tags) ** 2
            missing = {key + step * k for key in missing for k in range(16)}.difference(self._known)
        if missing:
            noise_share = 1 / self.model.threshold_to_noise if self.model.stamp_noise else 0.0
            read = detect(self._paths(np.array([*missing])), self.scenario.radio, noise_share)
            columns = (read.excess_m, read.power_dbm, read.total_dbm, read.noise_s)
            self._known.update(zip(missing, np.column_stack(columns).tolist(), strict=True))
        return Detected(*np.array([self._known[key] for key in keys]).reshape(-1, 4).T)

    def paths(self, places: tuple[Ints, Ints], time_s: Floats) -> Paths:
        """Return the paths between tags with indices (n,) at the steps nearest to true times (n,)."""
        return self._paths(self._key(places, time_s))

    def _key(self, places: tuple[Ints, Ints], time_s: Floats) -> Ints:
        """Return one number for step, sender and receiver, increasing with time."""
        (a, b), tags = places, self.scenario.tags
        if not any(tag.tx_power_db for tag in tags):
            a, b = np.minimum(a, b), np.maximum(a, b)
        step = np.rint(np.maximum(time_s, 0) / (self.model.step_ms * 1e-3)).astype(np.int64)
        return (step * len(tags) + a) * len(tags) + b

    def _paths(self, keys: Ints) -> Paths:
        pair_step, b = np.divmod(keys, len(self.scenario.tags))
        step, a = np.divmod(pair_step, len(self.scenario.tags))
        ends = self.world.ends((a, b), step * (self.model.step_ms * 1e-3))
        parts = [self._direct(ends), self._mirrored(ends), self._scattered(ends)]
        length, field = (np.concatenate(columns, axis=1) for columns in zip(*parts, strict=True))
        stronger = 10 ** (np.array([tag.tx_power_db for tag in self.scenario.tags]) / 20)
        amplitude = field * _phasors(length) * stronger[ends.places[0]][:, None]
        return Paths(detour_m=length - ends.distance_m[:, None], amplitude=amplitude)

    def _axes(self, rotation: Floats) -> Floats:
        """Return the directions of antennas' axes, along which they are polarised, (n, 3)."""
        if self.scenario.radio.antenna == "isotropic":
            return np.broadcast_to(np.array([0.0, 0.0, 1.0]), (len(rotation), 3))
        return rotation[:, :, 2]

    def _obstruction_gain(self, ends: Ends, side: int, spots: Floats, length: Floats) -> Floats:
        """Return the relative field after obstacles and other bodies from the antennas of one end to points (n, k, 3).

        The table of a tag's antenna includes its own body.
        """
        left = np.ones(length.shape)
        rows, to = np.repeat(np.arange(len(length)), length.shape[1]), spots.reshape(-1, 3)
        begin, tags = ends.antennas_m[side][rows], self.scenario.tags
        if self.scenario.obstacles:
            loss, _ = box_loss(self.scenario.obstacles, begin, to)
            left = 10 ** (-loss.reshape(left.shape) / 20)
        for placed in ends.shadows:
            carries = np.array([tag.body == placed.body.name for tag in tags])[ends.places[side]]
            gain = placed.gain(rows, begin, to).reshape(left.shape)
            left = left * np.where(carries[:, None], 1.0, gain)
        return left

    def _direct(self, ends: Ends) -> tuple[Floats, Complexes]:
        """Return lengths and fields of the direct path around obstacles, and of the path through them; (n, 2) each."""
        scenario, distance, towards = self.scenario, ends.distance_m, ends.towards
        a, b = ends.antennas_m
        field = free_space_field(scenario, distance) * self._polarisation_match(ends, towards)
        for tag, rotation, way in zip(ends.places, ends.rotations, (towards, -towards), strict=True):
            own = np.einsum("nj,njk->nk", way, rotation)
            field = field * 10 ** (antenna_gain_db(scenario, self.world.phases, tag, own) / 20)
        for placed in ends.shadows:
            field = field * placed.gain(np.arange(len(field)), a, b)
        if not scenario.obstacles:
            return distance[:, None], field[:, None].astype(np.complex128)
        cover, edge = boxes_blocked(scenario.obstacles, a, b)
        loss, late = _inside_boxes(scenario.obstacles, a, b)
        past = np.prod(1 - cover, axis=1)
        everything = np.prod(1 - cover * (1 - 10 ** (-loss / 20)), axis=1)
        # Deep in a shadow the path by the edge is nu^2/4 wavelengths longer; `cover` already has its phase.
        bent = np.maximum(edge.max(axis=1), 0) ** 2 / 4 * WAVELENGTH_M
        around_edges = field * past * np.exp(1j * WAVENUMBER * bent)
        slowed = np.minimum(np.abs(cover), 1.0) * late
        ways = np.column_stack([distance + bent, distance + slowed.sum(axis=1)])
        return ways, np.asarray(np.stack([around_edges, field * (everything - past)], axis=1), dtype=np.complex128)

    def _mirrored(self, ends: Ends) -> tuple[Floats, Complexes]:
        """Return lengths and fields of the paths by walls and faces, (n, mirrors) each, by the image method."""
        mirrors, axis, (a, b) = self.mirrors, self.mirrors.axis, ends.antennas_m
        plane, there = planes(mirrors, a, b)
        columns = np.arange(len(axis))
        # The vectors to the other end and to its image differ only in the coordinate across the mirror.
        way = np.repeat((b - a).T[:, :, None], len(axis), axis=2)
        across = 2 * plane - a[:, axis] - b[:, axis]
        way[axis, :, columns] = across.T
        length = np.maximum(np.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2), NEAREST_PATH_M)
        share = np.clip((plane - a[:, axis]) / np.where(np.abs(across) < 1e-12, 1e-12, across), 0, 1)
        point = np.moveaxis(a.T[:, :, None] + share * way, 0, 2)
        cosine = across / length
        field = free_space_field(self.scenario, length) * roughness_factor(mirrors.roughness_m, np.abs(cosine))
        back = -way
        back[axis, :, columns] *= -1
        for side, leaving, legs in ((0, way, share), (1, back, 1 - share)):
            own = [np.einsum("jnm,nj->nm", leaving, ends.rotations[side][:, :, k]) for k in range(3)]
            leg = np.maximum(legs * length, NEAREST_PATH_M)
            gain = look_up_gain(self.tables, ends.places[side], own)
            field = field * gain * self._obstruction_gain(ends, side, point, leg)
        one, other = (self._axes(rotation) for rotation in ends.rotations)
        reflected = reflection_gain(mirrors, (one, other), way / length, cosine)
        return length, np.where(there, field * reflected * face_fraction(mirrors, point, share, length), 0)

    def _scattered(self, ends: Ends) -> tuple[Floats, Complexes]:
        """Return lengths and fields of the paths by scatterers, (n, scatterers) each."""
        spots, legs, gains = self.scatterers.place_m, [], []
        for side, (a, rotation) in enumerate(zip(ends.antennas_m, ends.rotations, strict=True)):
            own = [rotation[:, :, k] @ spots.T - np.einsum("mj,mj->m", rotation[:, :, k], a)[:, None] for k in range(3)]
            legs.append(np.maximum(np.sqrt(own[0] ** 2 + own[1] ** 2 + own[2] ** 2), NEAREST_PATH_M))
            gain = look_up_gain(self.tables, ends.places[side], own)
            to = np.broadcast_to(spots, (*legs[side].shape, 3))
            gains.append(gain * self._obstruction_gain(ends, side, to, legs[side]))
        length = legs[0] + legs[1] + self.scatterers.extra_m
        return length, (free_space_field(self.scenario, length) * gains[0] * gains[1]) * self.scatterers.gain

    def _polarisation_match(self, ends: Ends, towards: Floats) -> Floats:
        """Return the match of the antennas' polarisations on the direct path, (n,); 1 along their axes."""
        one, other = (self._axes(rotation) for rotation in ends.rotations)
        along = [np.einsum("nj,nj->n", axis, towards) for axis in (one, other)]
        size = np.sqrt(np.maximum((1 - along[0] ** 2) * (1 - along[1] ** 2), 0))
        match = (np.einsum("nj,nj->n", one, other) - along[0] * along[1]) / np.maximum(size, AXIAL)
        match = np.where(size < AXIAL, 1.0, match)
        # A judgement: cross-polarised antennas are coupled by a tenth of the field, -20 dB.
        return np.copysign(np.maximum(np.abs(match), 0.1), match)
