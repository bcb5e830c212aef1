"""Where every tag is, how far apart two are, and how strongly one hears the other."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from uwblink.schema import Poses
from uwbsim.clock import SUBTICKS_PER_SECOND
from uwbsim.motion import Trajectory, sample
from uwbsim.radio import gain_db, path_gain_db, shadowing_phases
from uwbsim.scenario import Scenario
from uwbsim.streams import stream

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class World:
    """Bodies on their trajectories, with tags on lever arms."""

    scenario: Scenario
    trajectories: dict[str, Trajectory]
    phases: Floats

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        """Sample every body's trajectory from the scenario's seed."""
        duration, seed = scenario.scenario.duration_s, scenario.scenario.seed
        return cls(
            scenario,
            {b.name: sample(b.motion, duration, partial(stream, seed, "motion", b.name)) for b in scenario.bodies},
            np.array([shadowing_phases(seed, tag.id) for tag in scenario.tags]),
        )

    def link(self, initiator: Ints, target: Ints, time: Ints) -> tuple[Floats, Floats]:
        """Return distance in metres and first-path power in dBm between tags (n,) at times (n,).

        Tags are places in the scenario's list, times true sub-ticks. The link is reciprocal.
        """
        distance, power = np.empty(len(time)), np.empty(len(time))
        pair = initiator * len(self.scenario.tags) + target
        for key in np.unique(pair):
            rows = np.flatnonzero(pair == key)
            i, j = divmod(int(key), len(self.scenario.tags))
            distance[rows], power[rows] = self._pair(i, j, time[rows] / SUBTICKS_PER_SECOND)
        return distance, power

    def _pair(self, i: int, j: int, time_s: Floats) -> tuple[Floats, Floats]:
        spots, turns = zip(*(self._tag(k, time_s) for k in (i, j)), strict=True)
        apart = spots[1] - spots[0]
        distance = np.linalg.norm(apart, axis=1)
        towards = apart / np.maximum(distance, 1e-9)[:, None]
        radio = self.scenario.radio
        power = path_gain_db(radio, distance)
        for k, turn, sign in ((i, turns[0], 1.0), (j, turns[1], -1.0)):
            seen = turn.inv().apply(sign * towards)
            power = power + gain_db(radio, self.phases[k], seen)
        return distance, power

    def _tag(self, index: int, time_s: Floats) -> tuple[Floats, Rotation]:
        tag = self.scenario.tags[index]
        body = self.trajectories[tag.body]
        turn = Rotation.from_quat(body.quaternion(time_s))
        return body.position_m(time_s) + turn.apply(np.array(tag.lever_arm_m)), turn

    def motion_capture(self) -> Poses:
        """Return the poses that motion capture writes over the run, with its rate and noise."""
        mocap, heading = self.scenario.mocap, self.scenario.scenario
        # A little longer than the run, so that the last exchange lies between two poses.
        count = int(np.ceil((heading.duration_s + 0.05) * mocap.rate_hz)) + 2
        time_ns = np.rint(np.arange(count) * 1e9 / mocap.rate_hz).astype(np.int64)
        parts = [self._seen(name, time_ns) for name in self.trajectories]
        order = np.argsort(np.tile(time_ns, len(parts)), kind="stable")
        names = np.repeat(np.array(list(self.trajectories)), count)
        position = np.concatenate([p for p, _ in parts])
        quaternion = np.concatenate([q for _, q in parts])
        return Poses(np.tile(time_ns, len(parts))[order], names[order], position[order], quaternion[order])

    def _seen(self, name: str, time_ns: Ints) -> tuple[Floats, Floats]:
        mocap, body = self.scenario.mocap, self.trajectories[name]
        rng = stream(self.scenario.scenario.seed, "motion capture", name)
        time_s = np.asarray(time_ns * 1e-9, dtype=np.float64)
        position = body.position_m(time_s) + rng.normal(0, 1, (len(time_s), 3)) * mocap.position_noise_m
        wobble = Rotation.from_rotvec(rng.normal(0, 1, (len(time_s), 3)) * mocap.attitude_noise_rad)
        return position, (Rotation.from_quat(body.quaternion(time_s)) * wobble).as_quat()
