"""Where all tags are, sampled a second ahead: for boards that need one instant at a time, and soon.

Between samples positions and attitudes are interpolated linearly, which at 10 m/s^2 is wrong by 30 um at most, a
hundredth of a tick.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from uwblink.arrays import Floats, Ints
from uwbsim.world.clocks import SUBTICKS_PER_SECOND
from uwbsim.world.propagation import Link
from uwbsim.world.radio import gain_db
from uwbsim.world.world import World

STEP_S: Final = 0.005
STEPS: Final = 200


class SampledWorld:
    """The tags of a world at one instant after another; going back a little is cheap, going back far is not."""

    def __init__(self, world: World) -> None:
        """Begin at time zero."""
        self._world = world
        self._block = -1
        self._spots: Floats = np.empty(0)
        self._turns: Floats = np.empty(0)
        self._prepare(0)

    def link(self, initiator: Ints, target: Ints, time: Ints) -> Link:
        """Return what `World.link` does, for one exchange: arrays of shape (1,)."""
        return self.from_sender(int(initiator[0]), int(time[0]))[target]

    def from_sender(self, sender: int, time: int) -> Link:
        """Return what reaches every tag from a tag's place, shape (tags,); shadows of bodies are left out."""
        spots, turns = self._at(time)
        apart = spots - spots[sender]
        distance = np.sqrt(np.einsum("ij,ij->i", apart, apart))
        towards = apart / np.maximum(distance, 1e-9)[:, None]
        radio, phases = self._world.scenario.radio, self._world.phases
        leaving = towards @ turns[sender]
        arriving = -np.einsum("ij,ijk->ik", towards, turns)
        gain = gain_db(radio, phases[sender], leaving) + gain_db(radio, phases, arriving)
        starts = np.broadcast_to(spots[sender], spots.shape)
        return self._world.surroundings(distance, gain, (starts, spots))

    def _at(self, time: int) -> tuple[Floats, Floats]:
        step, into = divmod(time / SUBTICKS_PER_SECOND / STEP_S, 1)
        block, index = divmod(int(step), STEPS)
        if block != self._block:
            self._prepare(block)
        return (
            self._spots[index] + into * (self._spots[index + 1] - self._spots[index]),
            self._turns[index] + into * (self._turns[index + 1] - self._turns[index]),
        )

    def _prepare(self, block: int) -> None:
        """Sample a block: positions (samples, tags, 3) and rotations body to world (samples, tags, 3, 3)."""
        world = self._world
        time = np.asarray((block * STEPS + np.arange(STEPS + 1)) * STEP_S, dtype=np.float64)
        bodies = {name: (b.position_m(time), b.quaternion(time)) for name, b in world.trajectories.items()}
        turns = {name: Rotation.from_quat(q).as_matrix() for name, (_, q) in bodies.items()}
        tags = world.scenario.tags
        self._turns = np.stack([turns[tag.body] for tag in tags], axis=1)
        arms = np.array([tag.lever_arm_m for tag in tags])
        middle = np.stack([bodies[tag.body][0] for tag in tags], axis=1)
        self._spots = middle + np.einsum("stij,tj->sti", self._turns, arms)
        self._block = block
