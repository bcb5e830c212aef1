"""What antennas add to stamps, as delays that follow temperature and supply voltage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from uwblink.arrays import Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.scenario.devices import TX_SHARE
from uwbsim.scenario.model import Scenario
from uwbsim.world.clocks import SUBTICKS_PER_SECOND
from uwbsim.world.temperature import lengthening_m


@dataclass(frozen=True, slots=True)
class AntennaDelays:
    """What antennas add to stamps, of tags by their places in the scenario.

    `fixed` (tags, 2) is what they add to transmit and to receive stamps at the references, in seconds; the tags in
    `moving` are longer or shorter with temperature and voltage. A range is longer by x where the tag's aggregate delay,
    transmit less receive, is shorter by 2 x/c: frames leave later than stamped by 0.44 of that and are stamped later
    than they come by 0.56 of it.
    """

    scenario: Scenario
    fixed: Floats
    moving: tuple[int, ...]

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        """Return the antenna delays of a scenario's tags."""
        now = np.zeros(1)
        moving = [k for k, tag in enumerate(scenario.tags) if lengthening_m(scenario, tag, now) is not None]
        return cls(scenario, np.array([tag.antenna_delays_s for tag in scenario.tags]), tuple(moving))

    def transmit_s(self, tag: Ints, time: Ints) -> Floats:
        """Return what is added to the transmit stamps of tags (n,) at true times (n,) in sub-ticks, in seconds."""
        return np.asarray(self.fixed[tag, 0] - TX_SHARE * self._longer_s(tag, time))

    def receive_s(self, tag: Ints, time: Ints) -> Floats:
        """Return what is added to the receive stamps of tags (n,) at true times (n,) in sub-ticks, in seconds."""
        return np.asarray(self.fixed[tag, 1] + (1 - TX_SHARE) * self._longer_s(tag, time))

    def _longer_s(self, tag: Ints, time: Ints) -> Floats:
        """Return by how much the ways through the tags' antennas, transmission and reception together, are longer."""
        longer = np.zeros(len(tag))
        for place in self.moving:
            rows = np.flatnonzero(tag == place)
            if len(rows):
                found = lengthening_m(self.scenario, self.scenario.tags[place], time[rows] / SUBTICKS_PER_SECOND)
                longer[rows] = 0.0 if found is None else 2 * found / SPEED_OF_LIGHT
        return longer
