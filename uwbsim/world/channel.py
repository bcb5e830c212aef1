"""Links between antennas, their ends, and the lengths and powers of their paths, by a table of effects.

Simulated flights, served boards, passive listeners and comparisons of protocols all call `link_between`, so each effect
of `CHANNEL_EFFECTS` applies to all of them equally.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from uwblink.arrays import ArrayRows, Floats, Ints
from uwblink.errors import ArgumentError, restating
from uwblink.plugins import Registry, check_row
from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.errors import ParameterError, ScenarioError
from uwbsim.scenario.bodies import Room, Shadow
from uwbsim.scenario.devices import Body
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.radio import TwoStateMultipath
from uwbsim.world.diffraction import body_gain, box_loss, ellipsoid_chord_m, near_body
from uwbsim.world.impulse_response import PathsHeard
from uwbsim.world.radio import antenna_gain_db, group_delay_m, path_gain_db

if TYPE_CHECKING:
    from uwbsim.world.geometric import GeometricResponses
    from uwbsim.world.world import World


@dataclass(frozen=True, slots=True)
class Link(ArrayRows):
    """n links between two antennas each, (n,).

    `distance_m` is the length of the straight line, `excess_m` the apparent additional length of the first detected
    path; `power_dbm` is that path's power, `total_dbm` that of all paths together. `paths_m` and `paths_dbm` are the
    lengths and powers of all paths, (n, paths), in any order. With geometric responses, which have their own paths,
    `noise_s` is the standard deviation of the leading edge of the first path by noise.
    """

    distance_m: Floats
    excess_m: Floats
    power_dbm: Floats
    total_dbm: Floats
    paths_m: Floats
    paths_dbm: Floats
    noise_s: Floats | None = None

    def weaker(self, loss_db: Floats) -> Link:
        """Return the links with a loss (n,) on all their paths."""
        return replace(
            self,
            power_dbm=self.power_dbm - loss_db,
            total_dbm=self.total_dbm - loss_db,
            paths_dbm=self.paths_dbm - loss_db[:, None],
        )


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


def paths_heard(link: Link, ends: Ends, detour_m: Floats) -> list[PathsHeard]:
    """Return the paths of n links for impulse responses; first paths have random detours (n,)."""
    first_m, responses = link.distance_m + link.excess_m, ends.world.responses
    if responses is not None:
        paths, read = responses.paths(ends.places, ends.time_s), responses.at(ends.places, ends.time_s)
        later_s = (paths.detour_m - (read.excess_m + detour_m)[:, None]) / SPEED_OF_LIGHT
        # Other effects on a link change all its paths equally.
        amplitude = paths.amplitude * 10 ** ((link.power_dbm - read.power_dbm) / 20)[:, None]
        return [PathsHeard(*path) for path in zip(link.power_dbm.tolist(), later_s, amplitude, strict=True)]
    later_m = link.paths_m - first_m[:, None] - detour_m[:, None]
    shares = 10 ** ((link.paths_dbm - link.power_dbm[:, None]) / 20)
    # Echoes within 1 cm of the first path, or 80 dB weaker, change no tap.
    kept = (later_m > 0.01) & (shares > 1e-4)
    return [
        PathsHeard(power, late[there] / SPEED_OF_LIGHT, share[there])
        for power, late, share, there in zip(link.power_dbm.tolist(), later_m, shares, kept, strict=True)
    ]


Effect = Callable[[Link, Ends], Link]
"""Returns n links between given ends after an effect; `dataclasses.replace` keeps what it does not change."""


@dataclass(frozen=True, slots=True)
class ChannelEffect:
    """An effect by its name; an entry point of the group `uwbcal.effects` names one, or a list of them."""

    name: str
    apply: Effect


def link_between(ends: Ends) -> Link:
    """Return the links between known ends, (n,), after all effects of `CHANNEL_EFFECTS` in their order."""
    responses = ends.world.responses
    link = _direct(ends) if responses is None else _of_responses(ends, responses)
    for effect in OWN_EFFECTS:
        link = effect.apply(link, ends)
    for effect in CHANNEL_EFFECTS.added():
        with CHANNEL_EFFECTS.calling(effect.name, ScenarioError):
            link = effect.apply(link, ends)
        _check(effect.name, link, ends)
    return link


def _direct(ends: Ends) -> Link:
    """Return links with direct paths alone, weaker and longer by what they cross: obstacles, bodies with a shadow."""
    scenario, distance, towards = ends.scenario, ends.distance_m, ends.towards
    power = path_gain_db(scenario.radio, distance) + ends.gain_towards_db(towards, -towards)
    link = Link(distance, np.zeros_like(distance), power, power, distance[:, None], power[:, None])
    if scenario.obstacles:
        loss, excess = box_loss(scenario.obstacles, *ends.antennas_m)
        link = replace(link.weaker(loss), excess_m=excess, paths_m=(distance + excess)[:, None])
    for body in ends.shadows:
        link = link.weaker(body.loss_db(*(spots[:, None] for spots in ends.antennas_m))[:, 0])
    return link


def _of_responses(ends: Ends, responses: GeometricResponses) -> Link:
    """Return links with excess length, powers and noise of geometric responses, which have their own paths."""
    distance, read = ends.distance_m, responses.at(ends.places, ends.time_s)
    nothing = np.zeros((len(distance), 1))
    return Link(distance, read.excess_m, read.power_dbm, read.total_dbm, distance[:, None], nothing, read.noise_s)


def _check(name: str, link: Link, ends: Ends) -> None:
    """Raise `ScenarioError` if the effect of a plug-in did not return n finite links."""
    if not isinstance(link, Link):
        raise ScenarioError(f"channel effect {name!r}: returned {link!r:.60}, expected a Link")
    for column in ("distance_m", "excess_m", "power_dbm", "total_dbm"):
        values = np.asarray(getattr(link, column))
        if values.shape != ends.distance_m.shape or not np.all(np.isfinite(values)):
            raise ScenarioError(
                f"channel effect {name!r}: {column}: returned {values!r:.60}, expected {len(ends.distance_m)} finite "
                "numbers"
            )


def _reflections(link: Link, ends: Ends) -> Link:
    """Add the reflections by the room's surfaces, with the losses by obstacles and bodies.

    The image method: the straight line to the image of the other end has the length of the reflected path, and crosses
    the surface at the point of reflection. The first detected path is the earliest whose power is within the dynamic
    range of the strongest.
    """
    room, radio = ends.scenario.room, ends.scenario.radio
    if room is None or room.reflection_loss_db is None:
        return link
    surfaces = 6
    spots = [np.repeat(end[:, None], surfaces, axis=1) for end in ends.antennas_m]
    images = [_images(room, end) for end in spots]
    way, back = images[1] - spots[0], images[0] - spots[1]
    length = np.linalg.norm(way, axis=2)
    scale = np.maximum(length, 1e-10)[:, :, None]
    # The distances of the two ends from the surface determine the point of reflection.
    near, far = (np.linalg.norm(image - end, axis=2) for image, end in zip(images, spots, strict=True))
    point = spots[0] + (near / np.maximum(near + far, 1e-10))[:, :, None] * way
    leaving, arriving = way / scale, back / scale
    gain = np.stack([ends.gain_towards_db(leaving[:, k], arriving[:, k]) for k in range(surfaces)], axis=1)
    loss, excess = np.zeros(length.shape), np.zeros(length.shape)
    for end in ends.antennas_m:
        if ends.scenario.obstacles:
            lost, late = box_loss(ends.scenario.obstacles, np.repeat(end, surfaces, axis=0), point.reshape(-1, 3))
            loss, excess = loss + lost.reshape(length.shape), excess + late.reshape(length.shape)
        for body in ends.shadows:
            loss = loss + body.loss_db(end[:, None], point)
    echoes = path_gain_db(radio, length) + gain - room.reflection_loss_db - loss
    lengths = np.column_stack([link.distance_m + link.excess_m, length + excess])
    power = np.column_stack([link.power_dbm, echoes])
    audible = power >= power.max(axis=1, keepdims=True) - radio.dynamic_range_db
    first = np.argmin(np.where(audible, lengths, np.inf), axis=1)
    rows = np.arange(len(first))
    return replace(
        link,
        excess_m=lengths[rows, first] - link.distance_m,
        power_dbm=power[rows, first],
        total_dbm=np.asarray(10 * np.log10(np.sum(10 ** (power / 10), axis=1))),
        paths_m=lengths,
        paths_dbm=power,
    )


def _images(room: Room, spots: Floats) -> Floats:
    """Return the images of points (n, 6, 3) in the surfaces of their columns, two across each axis."""
    image, surface, axis = spots.copy(), np.arange(6), np.repeat(np.arange(3), 2)
    image[:, surface, axis] = 2 * np.array([room.min_m, room.max_m]).T.ravel() - spots[:, surface, axis]
    return image


def _states(link: Link, ends: Ends) -> Link:
    """Apply lasting reflections: a weaker and later first path, and a strongest path after it."""
    model, states = ends.scenario.radio.multipath, ends.world.states
    if states is None or not isinstance(model, TwoStateMultipath):
        return link
    reflection, late_m, loss_db, rise_s = states.at(ends.places, ends.time_s)
    reflected = reflection > 0
    power = link.power_dbm - np.where(reflected, loss_db, 0.0)
    total = link.total_dbm - np.where(reflected, model.total_loss_db, 0.0)
    excess = link.excess_m + late_m
    # The strongest path comes after the first; after a direct path it has no power (1e-30 mW).
    nothing_mw = 1e-30
    rest = np.maximum(10 ** (total / 10) - 10 ** (power / 10), nothing_mw)
    later = np.where(reflected, 10 * np.log10(rest), 10 * np.log10(nothing_mw))
    last_m = link.distance_m + excess + np.where(reflected, rise_s, 0.0) * SPEED_OF_LIGHT
    return replace(
        link,
        excess_m=excess,
        power_dbm=power,
        total_dbm=total,
        paths_m=np.column_stack([link.paths_m, last_m]),
        paths_dbm=np.column_stack([link.paths_dbm, later]),
    )


def _levels(link: Link, ends: Ends) -> Link:
    """Apply fading and outages of pairs to all paths."""
    if not ends.world.levels:
        return link
    return link.weaker(-sum(levels.at(ends.places, ends.time_s)[0] for levels in ends.world.levels))


def _group_delays(link: Link, ends: Ends) -> Link:
    """Delay every path of a link by the group delays of both antennas in the direction of the direct path."""
    scenario, towards, late = ends.scenario, ends.towards, np.zeros(len(ends.distance_m))
    if scenario.radio.group_delay is None and all(tag.group_delay is None for tag in scenario.tags):
        return link
    for tags, rotation, way in zip(ends.places, ends.rotations, (towards, -towards), strict=True):
        late = late + group_delay_m(scenario, tags, np.einsum("ni,nij->nj", way, rotation))
    return replace(link, excess_m=link.excess_m + late, paths_m=link.paths_m + late[:, None])


OWN_EFFECTS: Final = (
    ChannelEffect("reflections", _reflections),
    ChannelEffect("lasting reflections", _states),
    ChannelEffect("fading and outages", _levels),
    ChannelEffect("group delays", _group_delays),
)
"""The project's own effects, in this order, which depend only on the scenario."""

CHANNEL_EFFECTS: Final[Registry[ChannelEffect]] = Registry(
    "channel effect",
    "uwbcal.effects",
    OWN_EFFECTS,
    partial(check_row, "channel effect", ChannelEffect, {"apply": (callable, "a function of link and ends")}),
)
"""Effects on every link of every scenario: the project's, then those of programs and of installed distributions."""


def register_channel_effect(name: str, effect: Effect) -> None:
    """Add an effect to every link that is simulated from now on; `CHANNEL_EFFECTS.remove` removes it.

    `effect(link, ends)` gets n links (`Link`: distances and excess lengths in metres, powers in dBm, (n,) each) and
    their two ends (`Ends`), and returns links. It must not depend on anything else, so that the same seed gives the
    same flight. It applies to flights, served boards, passive listeners, and predictions and comparisons of protocols.
    Raises `ParameterError` for a name that is taken.

    >>> import uwbsim
    >>> from uwbsim.world.channel import CHANNEL_EFFECTS
    >>> def rain(link, ends):
    ...     return link.weaker(0.2 * link.distance_m)
    >>> uwbsim.register_channel_effect("rain", rain)
    >>> [*CHANNEL_EFFECTS][-3:]
    ['fading and outages', 'group delays', 'rain']
    >>> CHANNEL_EFFECTS.remove("rain")
    """
    with restating(ParameterError, ArgumentError):
        CHANNEL_EFFECTS.register(ChannelEffect(name, effect))
