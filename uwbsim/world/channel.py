"""What reaches one antenna from another: the one place where the length and the powers of a link are computed.

Flight loop, served boards, passive listeners and the protocol workbench all ask here, wherever they have the places of
the antennas from; so an effect of `CHANNEL_EFFECTS` shows in all of them, by the same decibels and metres.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from uwblink.arrays import Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.errors import ParameterError, ScenarioError
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.multipath import TwoStateMultipath
from uwbsim.scenario.surroundings import Shadow
from uwbsim.world.geometric_responses import GeometricResponses
from uwbsim.world.group_delay import group_delay_m, has_group_delays
from uwbsim.world.pair_levels import PairLevels
from uwbsim.world.patterns import pattern_gain_db
from uwbsim.world.propagation import SURFACES, Link, ellipsoid_chord_m, first_path, reflections, through, with_path
from uwbsim.world.radio import gain_db, path_gain_db
from uwbsim.world.reflected_states import ReflectedStates

SHORTEST_M: Final = 1e-10
"""Nearer than this two antennas have no direction."""

NOTHING_MW: Final = 1e-30


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacedShadow:
    """The shadow of a body, where the body is: centre (n, 3) in metres, rotation body to world (n, 3, 3)."""

    shadow: Shadow
    position_m: Floats
    rotation: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Ends:
    """The two ends of n links at an instant each, in the world's frame.

    `time_s` (n,) is true time; `places` are the tags at the two ends as places in the scenario's list, (n,) each;
    `antennas_m` where their antennas are, (n, 3) each, and `rotations` how they are turned, body to world, (n, 3, 3)
    each. `shadows` are the bodies that may stand in between; `phases` (tags, harmonics) those of the tags' shadowing;
    `states` the reflections that last by pair, `levels` fading and outages of pairs, `responses` those from geometry,
    where the scenario has such.
    `distance_m` and `gain_db`, (n,) each, follow from these: the lengths of the straight lines, and what the sender's
    power and the two antennas together add along them. The first end sends.
    """

    scenario: Scenario
    phases: Floats
    time_s: Floats
    places: tuple[Ints, Ints]
    antennas_m: tuple[Floats, Floats]
    rotations: tuple[Floats, Floats]
    shadows: Sequence[PlacedShadow]
    states: ReflectedStates | None = None
    levels: PairLevels | None = None
    responses: GeometricResponses | None = None
    distance_m: Floats = field(init=False)

    def __post_init__(self) -> None:
        """Work out what all effects need, once."""
        apart = self.antennas_m[1] - self.antennas_m[0]
        object.__setattr__(self, "distance_m", np.sqrt(np.einsum("ij,ij->i", apart, apart)))

    @property
    def gain_db(self) -> Floats:
        """What the sender's power and the antennas add along the straight lines; worked out when asked for."""
        towards = (self.antennas_m[1] - self.antennas_m[0]) / np.maximum(self.distance_m, SHORTEST_M)[:, None]
        return self.gain_towards_db(towards, -towards)

    def gain_towards_db(self, leaving: Floats, arriving: Floats) -> Floats:
        """Return what the sender's power and the antennas add to paths, (n,).

        `leaving` are the unit vectors (n, 3) in which they leave the sender, `arriving` those in which the receiver
        sees them come.
        """
        radio, gain = self.scenario.radio, np.zeros(len(leaving))
        for tags, rotation, way in zip(self.places, self.rotations, (leaving, arriving), strict=True):
            phases = self.phases[tags] if radio.shadowing_db else self.phases
            there = np.einsum("ni,nij->nj", way, rotation)
            gain = gain + gain_db(radio, phases, there)
            for place in np.unique(tags).tolist() if any(tag.pattern_db for tag in self.scenario.tags) else ():
                mine, own = np.flatnonzero(tags == place), self.scenario.tags[place].pattern_db
                if own:
                    gain[mine] += pattern_gain_db(own, there[mine])
        if any(tag.tx_power_db for tag in self.scenario.tags):
            gain = gain + np.array([tag.tx_power_db for tag in self.scenario.tags])[self.places[0]]
        return gain

    def tags(self) -> tuple[Ints, Ints]:
        """Return the ids of the tags at the two ends, (n,) each."""
        ids = np.array([tag.id for tag in self.scenario.tags], dtype=np.int64)
        return ids[self.places[0]], ids[self.places[1]]


ChannelEffect = Callable[[Link, Ends], Link]
"""Returns what becomes of n links between given ends; what it does not change it takes over (`dataclasses.replace`)."""


def link_between(ends: Ends) -> Link:
    """Return the links of tags at known places, (n,), with every effect of `CHANNEL_EFFECTS` in its order."""
    nothing = np.zeros_like(ends.distance_m)
    # A response from geometry has the powers, too.
    power = nothing if ends.responses is not None else path_gain_db(ends.scenario.radio, ends.distance_m) + ends.gain_db
    link = Link(ends.distance_m, nothing, power, power)
    for name, effect in CHANNEL_EFFECTS.items():
        link = effect(link, ends)
        if name not in OWN_EFFECTS:
            _check(name, link, ends)
    return link


def _check(name: str, link: Link, ends: Ends) -> None:
    """Raise `ScenarioError` where a stranger's effect returned something else than n finite links."""
    if not isinstance(link, Link):
        raise ScenarioError(f"channel effect {name!r}: returned {link!r:.60}, expected a Link")
    for column in ("distance_m", "excess_m", "power_dbm", "total_dbm"):
        values = np.asarray(getattr(link, column))
        if values.shape != ends.distance_m.shape or not np.all(np.isfinite(values)):
            raise ScenarioError(
                f"channel effect {name!r}: {column}: returned {values!r:.60}, expected {len(ends.distance_m)} finite "
                "numbers"
            )


def _obstacles(link: Link, ends: Ends) -> Link:
    if not ends.scenario.obstacles or ends.responses is not None:
        return link
    loss, excess = through(ends.scenario.obstacles, *ends.antennas_m)
    return replace(link, excess_m=excess, power_dbm=link.power_dbm - loss, total_dbm=link.total_dbm - loss)


def _shadows(link: Link, ends: Ends) -> Link:
    """Bodies in the way of the direct path, before the first path is chosen."""
    for body in ends.shadows if ends.responses is None else ():
        loss = _shadow_db(body, *(spots[:, None] for spots in ends.antennas_m))[:, 0]
        link = replace(link, power_dbm=link.power_dbm - loss, total_dbm=link.total_dbm - loss)
    return link


def _reflections(link: Link, ends: Ends) -> Link:
    """Ways by the room's surfaces, through obstacles and bodies as the direct one, with their own antenna gains."""
    room, radio = ends.scenario.room, ends.scenario.radio
    if room is None or room.reflection_loss_db is None:
        return link
    by, shape = reflections(room, *ends.antennas_m), (len(ends.distance_m), SURFACES)
    gain = np.stack([ends.gain_towards_db(by.leaving[:, k], by.arriving[:, k]) for k in range(SURFACES)], axis=1)
    loss, excess = np.zeros(shape), np.zeros(shape)
    for end in ends.antennas_m:
        if ends.scenario.obstacles:
            lost, late = through(ends.scenario.obstacles, np.repeat(end, SURFACES, axis=0), by.point_m.reshape(-1, 3))
            loss, excess = loss + lost.reshape(shape), excess + late.reshape(shape)
        for body in ends.shadows:
            loss = loss + _shadow_db(body, end[:, None], by.point_m)
    echoes = path_gain_db(radio, by.length_m) + gain - room.reflection_loss_db - loss
    return first_path(link, by.length_m + excess, echoes, radio.dynamic_range_db)


def _shadow_db(body: PlacedShadow, one: Floats, other: Floats) -> Floats:
    """Return what a body takes away from straight segments (n, k or 1, 3) to (n, k, 3), in dB, (n, k)."""
    a, b = ((spots - body.position_m[:, None]) @ body.rotation for spots in (one, other))
    return ellipsoid_chord_m(body.shadow, a, b) * body.shadow.loss_db_per_m


def _states(link: Link, ends: Ends) -> Link:
    """Reflections that last: a weaker and later first path, and most of the power later still."""
    model = ends.scenario.radio.multipath
    if ends.states is None or not isinstance(model, TwoStateMultipath):
        return link
    paths = ends.states.at(ends.places, ends.time_s)
    power = link.power_dbm - paths.first_loss_db
    total = link.total_dbm - np.where(paths.reflected, model.total_loss_db, 0.0)
    rest = np.maximum(10 ** (total / 10) - 10 ** (power / 10), NOTHING_MW)
    excess = link.excess_m + paths.excess_m
    # The strongest path comes after the first; with a direct path there is none.
    later = with_path(
        link,
        link.distance_m + excess + paths.rise_s * SPEED_OF_LIGHT,
        np.where(paths.reflected, 10 * np.log10(rest), 10 * np.log10(NOTHING_MW)),
    )
    return replace(later, excess_m=excess, power_dbm=power, total_dbm=total)


def _response(link: Link, ends: Ends) -> Link:
    """All that geometry does, read off one response: instead of the effects above, which leave such links alone."""
    if ends.responses is None:
        return link
    read = ends.responses.at(ends.places, ends.time_s)
    return replace(
        link, excess_m=read.excess_m, power_dbm=read.power_dbm, total_dbm=read.total_dbm, noise_s=read.noise_s
    )


def _levels(link: Link, ends: Ends) -> Link:
    """Fading and outages of pairs, of all paths alike."""
    if ends.levels is None:
        return link
    level = ends.levels.at_db(ends.places, ends.time_s)
    dbm = None if link.paths_dbm is None else link.paths_dbm + level[:, None]
    return replace(link, power_dbm=link.power_dbm + level, total_dbm=link.total_dbm + level, paths_dbm=dbm)


def _group_delays(link: Link, ends: Ends) -> Link:
    """Antennas delay by direction: every path of a link as much as the direct one."""
    if not has_group_delays(ends.scenario):
        return link
    apart = (ends.antennas_m[1] - ends.antennas_m[0]) / np.maximum(ends.distance_m, SHORTEST_M)[:, None]
    late = np.zeros(len(apart))
    for tags, rotation, way in zip(ends.places, ends.rotations, (apart, -apart), strict=True):
        late = late + group_delay_m(ends.scenario, tags, np.einsum("ni,nij->nj", way, rotation))
    paths = None if link.paths_m is None else link.paths_m + late[:, None]
    return replace(link, excess_m=link.excess_m + late, paths_m=paths)


CHANNEL_EFFECTS: Final[dict[str, ChannelEffect]] = {
    "obstacles": _obstacles,
    "shadows": _shadows,
    "reflections": _reflections,
    "lasting reflections": _states,
    "response": _response,
    "fading and outages": _levels,
    "group delays": _group_delays,
}
"""What happens to waves on their way, in this order, for every link of every scenario; strangers' effects come last."""

OWN_EFFECTS: Final = tuple(CHANNEL_EFFECTS)
"""Those that a scenario alone decides on."""


def register_channel_effect(name: str, effect: ChannelEffect) -> None:
    """Add an effect to every link that is simulated from now on; `del CHANNEL_EFFECTS[name]` takes it away again.

    `effect(link, ends)` is given n links (`Link`: distances and excess lengths in metres, powers in dBm, (n,) each) and
    their two ends (`Ends`), and returns links. It must depend on nothing else, so that the same seed gives the same
    flight. Flights, served boards, passive listeners, and the predictions and comparisons of protocols all show it.
    Raises `ParameterError` for a name that is taken.

    >>> from dataclasses import replace
    >>> import uwbsim
    >>> from uwbsim.world.channel import CHANNEL_EFFECTS
    >>> def rain(link, ends):
    ...     loss_db = 0.2 * link.distance_m
    ...     return replace(link, power_dbm=link.power_dbm - loss_db, total_dbm=link.total_dbm - loss_db)
    >>> uwbsim.register_channel_effect("rain", rain)
    >>> [*CHANNEL_EFFECTS][-3:]
    ['fading and outages', 'group delays', 'rain']
    >>> del CHANNEL_EFFECTS["rain"]
    """
    if not isinstance(name, str) or not name:
        raise ParameterError(f"found {name!r:.40}, expected a word", parameter="name")
    if name in CHANNEL_EFFECTS:
        raise ParameterError(
            f"found {name!r}, which is taken; the effects are {', '.join(CHANNEL_EFFECTS)}", parameter="name"
        )
    if not callable(effect):
        raise ParameterError(f"found {effect!r}, expected a function of link and ends", parameter="effect")
    CHANNEL_EFFECTS[name] = effect
