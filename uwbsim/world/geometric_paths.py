"""All ways of a wave from one antenna to another in a room: direct, by mirrors, by things that scatter.

`paths_between` takes antennas in their surroundings to their paths, many links at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from uwblink.arrays import Complexes, Floats, Ints
from uwbsim.scenario.model import WAVELENGTH_M, Scenario
from uwbsim.world.antenna_patterns import antenna_gain_db
from uwbsim.world.diffraction import box_cover
from uwbsim.world.fresnel_reflection import WAVENUMBER, roughness_factor
from uwbsim.world.mirrors import AXIAL, coupling, on_faces, planes
from uwbsim.world.propagation import box_chords_m
from uwbsim.world.surroundings import (
    SHORTEST_M,
    Placed,
    PlacedBody,
    Surroundings,
    antenna_axes,
    field_after,
    in_the_way,
)

CROSS_POLAR: Final = 0.1
"""So much of a field across its polarisation an antenna takes all the same."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Paths:
    """p paths of n links: how much longer than the straight line each is, in metres, and its complex amplitude.

    Shapes (n, p); an amplitude's square is a power in mW, its phase that of the carrier.
    """

    detour_m: Floats
    amplitude: Complexes


@dataclass(frozen=True, slots=True, kw_only=True)
class Legs:
    """From m antennas to s scatterers: lengths in metres, and amplitude gains with what is in the way, (m, s) each."""

    length_m: Floats
    gain: Floats


def legs_to_scatterers(around: Surroundings, ends: Placed, bodies: Sequence[PlacedBody], instant: Ints) -> Legs:
    """Return the ways between antennas (m,) at their `instant` (m,) of the bodies' and all scatterers."""
    spots, a = around.scatterers.place_m, ends.antenna_m
    own = [
        ends.rotation[:, :, k] @ spots.T - np.einsum("mj,mj->m", ends.rotation[:, :, k], a)[:, None] for k in range(3)
    ]
    length = np.maximum(np.sqrt(own[0] ** 2 + own[1] ** 2 + own[2] ** 2), SHORTEST_M)
    gain = around.patterns.gain(ends.tag, own)
    gain = gain * in_the_way(around, ends, bodies, instant, spots, length)
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
    """What the carrier turns by on ways of these lengths: to 1e-7, which takes much less than all digits."""
    turns = length / WAVELENGTH_M
    angle = (-2 * np.pi * (turns - np.rint(turns))).astype(np.float32)
    turned = np.empty(length.shape, dtype=np.complex128)
    turned.real, turned.imag = np.cos(angle), np.sin(angle)
    return turned


def _direct(
    around: Surroundings, ends: tuple[Placed, Placed], distance: Floats, bodies: Sequence[PlacedBody], at: Ints
) -> tuple[Floats, Complexes]:
    """The straight way, as what goes around obstacles and what goes through them and comes later; (n, 2) each."""
    scenario = around.scenario
    a, b = (end.antenna_m for end in ends)
    towards = (b - a) / np.maximum(distance, 1e-10)[:, None]
    field = field_after(scenario, distance) * _matched(scenario, ends, towards)
    for end, way in zip(ends, (towards, -towards), strict=True):
        own = np.einsum("nj,njk->nk", way, end.rotation)
        field = field * 10 ** (antenna_gain_db(scenario, around.phases, end.tag, own) / 20)
    for body in bodies:
        field = field * body.past(at, a, b)
    if not scenario.obstacles:
        return distance[:, None], field[:, None].astype(np.complex128)
    cover, edge = box_cover(scenario.obstacles, a, b)
    loss, late = _inside_boxes(around, a, b)
    past = np.prod(1 - cover, axis=1)
    everything = np.prod(1 - cover * (1 - 10 ** (-loss / 20)), axis=1)
    # Deep in a shadow waves take the longer way by the edge, nu^2/4 wavelengths; the cover has its phase already.
    bent = np.maximum(edge.max(axis=1), 0) ** 2 / 4 * WAVELENGTH_M
    around_edges = field * past * np.exp(1j * WAVENUMBER * bent)
    slowed = np.minimum(np.abs(cover), 1.0) * late
    ways = np.column_stack([distance + bent, distance + slowed.sum(axis=1)])
    return ways, np.asarray(np.stack([around_edges, field * (everything - past)], axis=1), dtype=np.complex128)


def _inside_boxes(around: Surroundings, a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """Loss in dB and excess length of what goes through each box, (n, boxes) each.

    What passes close by an edge goes through the box beside it, at its thinnest.
    """
    boxes = around.scenario.obstacles
    thinnest = np.array([min(hi - lo for lo, hi in zip(box.min_m, box.max_m, strict=True)) for box in boxes])
    chords = np.maximum(box_chords_m(boxes, a, b), thinnest)
    loss, index = np.array([box.properties() for box in boxes]).T
    return chords * loss, chords * (index - 1)


def _mirrored(
    around: Surroundings, ends: tuple[Placed, Placed], bodies: Sequence[PlacedBody], at: Ints
) -> tuple[Floats, Complexes]:
    """The ways by walls and faces, (n, mirrors) each: the image method, once."""
    mirrors, scenario = around.mirrors, around.scenario
    count, axis = len(at), mirrors.axis
    if not len(axis):
        return np.zeros((count, 0)), np.zeros((count, 0), dtype=np.complex128)
    a, b = (end.antenna_m for end in ends)
    plane, there = planes(mirrors, a, b)
    columns = np.arange(len(axis))
    # Straight to the image of the other end; only the coordinate across the mirror is another.
    way = np.repeat((b - a).T[:, :, None], len(axis), axis=2)
    across = 2 * plane - a[:, axis] - b[:, axis]
    way[axis, :, columns] = across.T
    length = np.maximum(np.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2), SHORTEST_M)
    share = np.clip((plane - a[:, axis]) / np.where(np.abs(across) < 1e-12, 1e-12, across), 0, 1)
    point = np.moveaxis(a.T[:, :, None] + share * way, 0, 2)
    cosine = across / length
    steep = np.abs(cosine)
    field = field_after(scenario, length) * roughness_factor(mirrors.roughness_m, steep)
    back = -way
    back[axis, :, columns] *= -1
    for end, leaving, legs in zip(ends, (way, back), (share, 1 - share), strict=True):
        own = [np.einsum("jnm,nj->nm", leaving, end.rotation[:, :, k]) for k in range(3)]
        leg = np.maximum(legs * length, SHORTEST_M)
        field = field * around.patterns.gain(end.tag, own) * in_the_way(around, end, bodies, at, point, leg)
    axes = (antenna_axes(scenario, ends[0]), antenna_axes(scenario, ends[1]))
    reflected = coupling(mirrors, axes, way / length, cosine)
    return length, np.where(there, field * reflected * on_faces(mirrors, point, share, length), 0)


def _scattered(around: Surroundings, legs: tuple[Legs, Legs]) -> tuple[Floats, Complexes]:
    """The ways by scatterers, (n, scatterers) each."""
    things = around.scatterers
    length = legs[0].length_m + legs[1].length_m + things.extra_m
    return length, (field_after(around.scenario, length) * legs[0].gain * legs[1].gain) * things.gain


def _matched(scenario: Scenario, ends: tuple[Placed, Placed], towards: Floats) -> Floats:
    """How well the two antennas' polarisations agree on the straight way, (n,); along their axes perfectly."""
    one, other = (antenna_axes(scenario, end) for end in ends)
    along = [np.einsum("nj,nj->n", axis, towards) for axis in (one, other)]
    size = np.sqrt(np.maximum((1 - along[0] ** 2) * (1 - along[1] ** 2), 0))
    match = (np.einsum("nj,nj->n", one, other) - along[0] * along[1]) / np.maximum(size, AXIAL)
    match = np.where(size < AXIAL, 1.0, match)
    return np.copysign(np.maximum(np.abs(match), CROSS_POLAR), match)
