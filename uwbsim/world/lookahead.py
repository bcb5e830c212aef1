"""Where all tags are, sampled a second ahead: for boards that need one instant at a time, and soon.

Between samples positions and attitudes are interpolated linearly, which at 10 m/s^2 is wrong by 30 um at most, a
hundredth of a tick.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from uwblink.arrays import Floats, Ints
from uwbsim.world.channel import Ends, PlacedShadow, link_between
from uwbsim.world.propagation import Link
from uwbsim.world.true_time import SUBTICKS_PER_SECOND
from uwbsim.world.world import World

STEP_S: Final = 0.005
STEPS: Final = 200


@dataclass(frozen=True, slots=True)
class _Samples:
    """A block: positions (samples, things, 3) and rotations body to world (samples, things, 3, 3)."""

    spots: Floats
    turns: Floats

    def at(self, index: int, into: float) -> tuple[Floats, Floats]:
        """Interpolate between a sample and the next."""
        return (
            self.spots[index] + into * (self.spots[index + 1] - self.spots[index]),
            self.turns[index] + into * (self.turns[index + 1] - self.turns[index]),
        )


class SampledWorld:
    """The tags of a world at one instant after another; going back a little is cheap, going back far is not."""

    def __init__(self, world: World) -> None:
        """Begin at time zero."""
        self._world = world
        self._places = np.arange(len(world.scenario.tags))
        self._shadowing = [body for body in world.scenario.bodies if body.shadow is not None]
        self._prepare(0)

    def link(self, initiator: Ints, target: Ints, time: Ints) -> Link:
        """Return what `World.link` does, for one frame: all rows have the same sender and time."""
        return self.from_sender(int(initiator[0]), int(time[0]))[target]

    def from_sender(self, sender: int, time: int) -> Link:
        """Return what reaches every tag from a tag's place, shape (tags,)."""
        block, index, into = self._step(time)
        if block != self._block:
            self._prepare(block)
        spots, turns = self._tags.at(index, into)
        count = len(spots)
        origin = np.full(count, sender)
        if self._world.responses is not None:
            self._world.responses.look_ahead(sender, time / SUBTICKS_PER_SECOND)
        return link_between(
            Ends(
                scenario=self._world.scenario,
                phases=self._world.phases,
                time_s=np.full(count, time / SUBTICKS_PER_SECOND),
                places=(origin, self._places),
                antennas_m=(spots[origin], spots),
                rotations=(turns[origin], turns),
                shadows=self._shadows(index, into, count),
                states=self._world.states,
                levels=self._world.levels,
                responses=self._world.responses,
            )
        )

    def _step(self, time: int) -> tuple[int, int, float]:
        step, into = divmod(time / SUBTICKS_PER_SECOND / STEP_S, 1)
        return *divmod(int(step), STEPS), into

    def _shadows(self, index: int, into: float, count: int) -> list[PlacedShadow]:
        """Place the bodies that have a shadow, the same for `count` links."""
        if not self._shadowing:
            return []
        spots, turns = self._bodies.at(index, into)
        return [
            PlacedShadow(
                shadow=body.shadow,
                position_m=np.broadcast_to(spots[k], (count, 3)),
                rotation=np.broadcast_to(turns[k], (count, 3, 3)),
            )
            for k, body in enumerate(self._shadowing)
            if body.shadow
        ]

    def _prepare(self, block: int) -> None:
        """Sample a block."""
        world = self._world
        time = np.asarray((block * STEPS + np.arange(STEPS + 1)) * STEP_S, dtype=np.float64)
        bodies = {name: (b.position_m(time), b.quaternion(time)) for name, b in world.trajectories.items()}
        turns = {name: Rotation.from_quat(q).as_matrix() for name, (_, q) in bodies.items()}
        tags = world.scenario.tags
        turned = np.stack([turns[tag.body] for tag in tags], axis=1)
        arms = np.array([tag.lever_arm_m for tag in tags])
        middle = np.stack([bodies[tag.body][0] for tag in tags], axis=1)
        self._tags = _Samples(middle + np.einsum("stij,tj->sti", turned, arms), turned)
        if self._shadowing:
            names = [body.name for body in self._shadowing]
            self._bodies = _Samples(
                np.stack([bodies[name][0] for name in names], axis=1), np.stack([turns[name] for name in names], axis=1)
            )
        self._block = block
