"""Positions of all tags and the links between them: computed exactly, or interpolated from blocks of a second."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final, Self

import numpy as np
from scipy.spatial.transform import Rotation

from uwblink.arrays import Floats, Ints
from uwblink.recording.schema import Poses
from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.errors import ScenarioError
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.world.channel import Ends, Link, link_between, paths_heard
from uwbsim.world.clocks import NS_PER_S, SUBTICKS_PER_SECOND
from uwbsim.world.diffraction import PlacedShadow
from uwbsim.world.geometric_responses import GeometricResponses
from uwbsim.world.impulse_response import PathsHeard
from uwbsim.world.pair_states import PairLevels, ReflectedStates
from uwbsim.world.radio import shadowing_phases
from uwbsim.world.trajectories import Trajectory, sample


@dataclass(frozen=True, slots=True)
class World:
    """Bodies on their trajectories, with tags on lever arms.

    `phases` are those of the tags' shadowing, `states` the lasting reflections of pairs, `levels` fading and outages of
    pairs, `responses` the geometric responses; None where the scenario has none.
    """

    scenario: Scenario
    trajectories: dict[str, Trajectory]
    phases: Floats
    states: ReflectedStates | None
    levels: PairLevels | None = None
    responses: GeometricResponses | None = None

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        """Draw all trajectories from the seed; raises `ScenarioError` where bodies cannot keep their distance."""
        phases, trajectories = shadowing_phases(scenario), _trajectories(scenario)
        responses = GeometricResponses.of(scenario, trajectories, phases)
        return cls(scenario, trajectories, phases, ReflectedStates.of(scenario), PairLevels.of(scenario), responses)

    def link(self, initiator: Ints, target: Ints, time: Ints) -> Link:
        """Return the links from the first tags to the second, (n,); reciprocal except for the sender's power.

        Tags are indices in the scenario's list, times true sub-ticks.
        """
        self.prepare(initiator, target, time)
        columns = np.zeros((5, len(time)))
        pair = initiator * len(self.scenario.tags) + target
        for key in np.unique(pair):
            rows = np.flatnonzero(pair == key)
            link = self._pair(*divmod(int(key), len(self.scenario.tags)), time[rows] / SUBTICKS_PER_SECOND)
            columns[:4, rows] = link.distance_m, link.excess_m, link.power_dbm, link.total_dbm
            if link.noise_s is not None:
                columns[4, rows] = link.noise_s
        return Link(*columns[:4], noise_s=None if self.responses is None else columns[4])

    def prepare(self, initiator: Ints, target: Ints, time: Ints) -> None:
        """Compute the responses of links (n,) ahead: faster for many pairs at once than pair by pair."""
        if self.responses is not None:
            self.responses.prepare((initiator, target), time / SUBTICKS_PER_SECOND)

    def paths(self, sender: int, receiver: int, time: int, detour_m: float = 0.0) -> PathsHeard:
        """Return the paths at one instant as a response shows them; `detour_m` is the random detour of the range."""
        (found,) = self.all_paths(np.array([sender]), np.array([receiver]), np.array([time]), np.array([detour_m]))
        return found

    def all_paths(self, sender: Ints, receiver: Ints, time: Ints, detour_m: Floats) -> list[PathsHeard]:
        """Return the paths of n links as responses show them."""
        time_s = time / SUBTICKS_PER_SECOND
        if self.responses is None:
            columns = zip(sender.tolist(), receiver.tolist(), time_s[:, None], detour_m.tolist(), strict=True)
            return [paths_heard(self._pair(i, j, now), detour) for i, j, now, detour in columns]
        link, read = self.link(sender, receiver, time), self.responses.at((sender, receiver), time_s)
        paths = self.responses.paths((sender, receiver), time_s)
        later_s = (paths.detour_m - (read.excess_m + detour_m)[:, None]) / SPEED_OF_LIGHT
        # Other effects on a link change all its paths alike.
        amplitude = paths.amplitude * 10 ** ((link.power_dbm - read.power_dbm) / 20)[:, None]
        return [PathsHeard(*path) for path in zip(link.power_dbm.tolist(), later_s, amplitude, strict=True)]

    def _pair(self, i: int, j: int, time_s: Floats) -> Link:
        tags = self.scenario.tags
        shadowing = [body.name for body in self.scenario.bodies if body.shadow is not None]
        # Each body once, whether it carries a tag, obstructs the link, or both.
        names = dict.fromkeys([tags[i].body, tags[j].body, *shadowing])
        bodies = {name: self.trajectories[name].pose(time_s) for name in names}
        return link_between(
            self.ends(
                (np.full(len(time_s), i), np.full(len(time_s), j)),
                time_s,
                (self._antenna_m(i, bodies), self._antenna_m(j, bodies)),
                (bodies[tags[i].body][1], bodies[tags[j].body][1]),
                bodies,
            )
        )

    def ends(
        self,
        places: tuple[Ints, Ints],
        time_s: Floats,
        antennas_m: tuple[Floats, Floats],
        rotations: tuple[Floats, Floats],
        bodies: Mapping[str, tuple[Floats, Floats]],
    ) -> Ends:
        """Return the ends of n links; `bodies` has positions and rotations of the bodies with a shadow, (n,) each."""
        shadows = [
            PlacedShadow(shadow=body.shadow, position_m=bodies[body.name][0], rotation=bodies[body.name][1])
            for body in self.scenario.bodies
            if body.shadow is not None
        ]
        return Ends(
            scenario=self.scenario,
            phases=self.phases,
            time_s=time_s,
            places=places,
            antennas_m=antennas_m,
            rotations=rotations,
            shadows=shadows,
            states=self.states,
            levels=self.levels,
            responses=self.responses,
        )

    def _antenna_m(self, index: int, bodies: dict[str, tuple[Floats, Floats]]) -> Floats:
        tag = self.scenario.tags[index]
        position, turn = bodies[tag.body]
        return np.asarray(position + turn @ np.array(tag.lever_arm_m))

    def motion_capture(self) -> Poses:
        """Return the poses that motion capture writes over the run, with its rate, noise, latency and gaps."""
        mocap, seed, parts = self.scenario.mocap, self.scenario.run.seed, []
        # A little longer than the run, so that the last exchange lies between two poses.
        count = int(np.ceil((self.scenario.run.duration_s + 0.05) * mocap.rate_hz)) + 2
        time_ns = np.rint(np.arange(count) * NS_PER_S / mocap.rate_hz).astype(np.int64)
        duration = float(time_ns[-1]) * 1e-9
        for name in self.trajectories:
            rng = stream(seed, "motion capture gaps", name)
            gaps_s = rng.uniform(0, duration, rng.poisson(mocap.gaps_per_min * duration / 60))
            parts.append(self.seen(name, time_ns, stream(seed, "motion capture", name), np.sort(gaps_s)))
        return Poses.concatenate(parts).in_time_order()

    def seen(self, name: str, time_ns: Ints, rng: np.random.Generator, gaps_s: Floats) -> Poses:
        """Return the poses of a body that motion capture takes at times (n,), except in gaps with these starts."""
        mocap, body = self.scenario.mocap, self.trajectories[name]
        time_s = np.asarray(time_ns * 1e-9, dtype=np.float64)
        position = body.position_m(time_s) + rng.normal(0, 1, (len(time_s), 3)) * mocap.position_noise_m
        error = Rotation.from_rotvec(rng.normal(0, 1, (len(time_s), 3)) * mocap.attitude_noise_rad)
        quaternion = (Rotation.from_quat(body.quaternion(time_s)) * error).as_quat()
        last = np.append(-np.inf, gaps_s)[np.searchsorted(gaps_s * NS_PER_S, time_ns, side="right")]
        latency_ns = round((mocap.latency_ms * 1e-3) * NS_PER_S)
        poses = Poses(time_ns + latency_ns, np.full(len(time_ns), name), position, quaternion)
        return poses[np.flatnonzero(time_ns > (last + mocap.gap_s) * NS_PER_S)]


def _trajectories(scenario: Scenario) -> dict[str, Trajectory]:
    """Draw the trajectories in turn; one that comes too close to an earlier one is drawn again."""
    seed, duration, least, tries = scenario.run.seed, scenario.run.duration_s, scenario.min_separation_m, 60
    time = np.arange(0, min(duration, 600.0) + 0.05, 0.05)
    found: dict[str, Trajectory] = {}
    for body in scenario.bodies:
        for attempt in range(tries if least else 1):
            names = (body.name, attempt) if attempt else (body.name,)
            path = sample(body.motion, duration, partial(stream, seed, "motion", *names))
            apart = (path.position_m(time) - other.position_m(time) for other in found.values() if least)
            if all(np.linalg.norm(vectors, axis=1).min() >= least for vectors in apart):
                break
        else:
            raise ScenarioError(
                f"min_separation_m: body {body.name!r} comes nearer than {least:g} m to another in {tries} tries; "
                "give bodies more room, or less separation"
            )
        found[body.name] = path
    return found


STEP_S: Final = 0.005
STEPS: Final = 200
"""Samples of a block, `STEP_S` apart. The error of linear interpolation is a (STEP_S)^2/8: 30 um or 0.01 ticks at
10 m/s^2."""


@dataclass(frozen=True, slots=True)
class _Samples:
    """A block of samples: positions (samples, k, 3) and rotations body to world (samples, k, 3, 3) of k objects."""

    spots: Floats
    turns: Floats

    def at(self, index: int, into: float) -> tuple[Floats, Floats]:
        """Interpolate between a sample and the next; `into` is the fraction of the step."""
        return (
            self.spots[index] + into * (self.spots[index + 1] - self.spots[index]),
            self.turns[index] + into * (self.turns[index + 1] - self.turns[index]),
        )


class SampledWorld:
    """The links of a world for single frames in order of time, interpolated within blocks of `STEPS` samples.

    An instant in another block than the last one computes that block.
    """

    def __init__(self, world: World) -> None:
        """Compute the first block."""
        self._world = world
        self._shadowing = [body.name for body in world.scenario.bodies if body.shadow is not None]
        self._prepare(0)

    def link(self, initiator: Ints, target: Ints, time: Ints) -> Link:
        """Return the links of one frame: all rows must have the same sender and time."""
        return self.from_sender(int(initiator[0]), int(time[0]))[target]

    def from_sender(self, sender: int, time: int) -> Link:
        """Return the links from a tag, by its index, to all tags, (tags,)."""
        step, into = divmod(time / SUBTICKS_PER_SECOND / STEP_S, 1)
        block, index = divmod(int(step), STEPS)
        if block != self._block:
            self._prepare(block)
        spots, turns = self._tags.at(index, into)
        count, time_s = len(spots), time / SUBTICKS_PER_SECOND
        origin, poses = np.full(count, sender), {}
        if self._world.responses is not None:
            self._world.responses.look_ahead(sender, time_s)
        if self._shadowing:
            for name, at, turn in zip(self._shadowing, *self._bodies.at(index, into), strict=True):
                poses[name] = np.broadcast_to(at, (count, 3)), np.broadcast_to(turn, (count, 3, 3))
        return link_between(
            self._world.ends(
                (origin, np.arange(count)),
                np.full(count, time_s),
                (spots[origin], spots),
                (turns[origin], turns),
                poses,
            )
        )

    def _prepare(self, block: int) -> None:
        """Compute the samples of a block."""
        world, self._block = self._world, block
        time = np.asarray((block * STEPS + np.arange(STEPS + 1)) * STEP_S, dtype=np.float64)
        bodies = {name: path.pose(time) for name, path in world.trajectories.items()}
        tags = world.scenario.tags
        position, turned = (np.stack([bodies[tag.body][k] for tag in tags], axis=1) for k in (0, 1))
        arms = np.array([tag.lever_arm_m for tag in tags])
        self._tags = _Samples(position + np.einsum("stij,tj->sti", turned, arms), turned)
        if self._shadowing:
            parts = [bodies[name] for name in self._shadowing]
            self._bodies = _Samples(*(np.stack(column, axis=1) for column in zip(*parts, strict=True)))
