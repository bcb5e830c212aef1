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
from uwbsim.errors import ParameterError
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.radio import Shadow
from uwbsim.world.propagation import Link, ellipsoid_chord_m, first_path, reflected_lengths_m, through
from uwbsim.world.radio import gain_db, path_gain_db

SHORTEST_M: Final = 1e-10
"""Nearer than this two antennas have no direction."""


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
    each. `shadows` are the bodies that may stand in between; `phases` (tags, harmonics) those of the tags' shadowing.
    `distance_m` and `gain_db`, (n,) each, follow from these: the lengths of the straight lines, and what the two
    antennas together add along them.
    """

    scenario: Scenario
    phases: Floats
    time_s: Floats
    places: tuple[Ints, Ints]
    antennas_m: tuple[Floats, Floats]
    rotations: tuple[Floats, Floats]
    shadows: Sequence[PlacedShadow]
    distance_m: Floats = field(init=False)
    gain_db: Floats = field(init=False)

    def __post_init__(self) -> None:
        """Work out what follows, once for all effects."""
        apart = self.antennas_m[1] - self.antennas_m[0]
        distance = np.sqrt(np.einsum("ij,ij->i", apart, apart))
        towards = apart / np.maximum(distance, SHORTEST_M)[:, None]
        radio, gain = self.scenario.radio, np.zeros(len(distance))
        for tags, rotation, way in zip(self.places, self.rotations, (towards, -towards), strict=True):
            phases = self.phases[tags] if radio.shadowing_db else self.phases
            gain = gain + gain_db(radio, phases, np.einsum("ni,nij->nj", way, rotation))
        object.__setattr__(self, "distance_m", distance)
        object.__setattr__(self, "gain_db", gain)

    def tags(self) -> tuple[Ints, Ints]:
        """Return the ids of the tags at the two ends, (n,) each."""
        ids = np.array([tag.id for tag in self.scenario.tags], dtype=np.int64)
        return ids[self.places[0]], ids[self.places[1]]


ChannelEffect = Callable[[Link, Ends], Link]
"""Returns what becomes of n links between given ends; what it does not change it takes over (`dataclasses.replace`)."""


def link_between(ends: Ends) -> Link:
    """Return the links of tags at known places, (n,), with every effect of `CHANNEL_EFFECTS` in its order."""
    power = path_gain_db(ends.scenario.radio, ends.distance_m) + ends.gain_db
    link = Link(ends.distance_m, np.zeros_like(ends.distance_m), power, power)
    for effect in CHANNEL_EFFECTS.values():
        link = effect(link, ends)
    return link


def _obstacles(link: Link, ends: Ends) -> Link:
    if not ends.scenario.obstacles:
        return link
    loss, excess = through(ends.scenario.obstacles, *ends.antennas_m)
    return replace(link, excess_m=excess, power_dbm=link.power_dbm - loss, total_dbm=link.total_dbm - loss)


def _reflections(link: Link, ends: Ends) -> Link:
    room, radio = ends.scenario.room, ends.scenario.radio
    if room is None or room.reflection_loss_db is None:
        return link
    lengths = reflected_lengths_m(room, *ends.antennas_m)
    echoes = path_gain_db(radio, lengths) + ends.gain_db[:, None] - room.reflection_loss_db
    return first_path(link, lengths, echoes, radio.dynamic_range_db)


def _shadows(link: Link, ends: Ends) -> Link:
    for body in ends.shadows:
        a, b = (np.einsum("nkj,nk->nj", body.rotation, spot - body.position_m) for spot in ends.antennas_m)
        loss = ellipsoid_chord_m(body.shadow, a, b) * body.shadow.loss_db_per_m
        link = replace(link, power_dbm=link.power_dbm - loss, total_dbm=link.total_dbm - loss)
    return link


CHANNEL_EFFECTS: Final[dict[str, ChannelEffect]] = {
    "obstacles": _obstacles,
    "reflections": _reflections,
    "shadows": _shadows,
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
    >>> list(CHANNEL_EFFECTS)
    ['obstacles', 'reflections', 'shadows', 'rain']
    >>> del CHANNEL_EFFECTS["rain"]
    """
    if name in CHANNEL_EFFECTS:
        raise ParameterError("name", f"found {name!r}, which is taken; the effects are {', '.join(CHANNEL_EFFECTS)}")
    if not callable(effect):
        raise ParameterError("effect", f"found {effect!r}, expected a function of link and ends")
    CHANNEL_EFFECTS[name] = effect
