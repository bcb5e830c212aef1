"""Where every tag is, how far apart two are, and how one hears the other."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Final, Self

import numpy as np
from scipy.spatial.transform import Rotation

from uwblink.arrays import Bools, Floats, Ints
from uwblink.recording.schema import Poses
from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.errors import ScenarioError
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.units import NS, NS_PER_S
from uwbsim.world.channel import Ends, PlacedShadow, link_between
from uwbsim.world.propagation import Link, reflected_lengths_m
from uwbsim.world.radio import path_gain_db, shadowing_phases
from uwbsim.world.trajectories import Trajectory, sample
from uwbsim.world.true_time import SUBTICKS_PER_SECOND

SEPARATION_STEP_S: Final = 0.05
TRIES: Final = 60


@dataclass(frozen=True, slots=True)
class World:
    """Bodies on their trajectories, with tags on lever arms; `phases` are those of the tags' shadowing."""

    scenario: Scenario
    trajectories: dict[str, Trajectory]
    phases: Floats

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        """Sample every body's trajectory from the seed; raises `ScenarioError` where they cannot keep apart."""
        phases = [shadowing_phases(scenario.run.seed, tag.id) for tag in scenario.tags]
        return cls(scenario, _trajectories(scenario), np.array(phases))

    def link(self, initiator: Ints, target: Ints, time: Ints) -> Link:
        """Return what reaches one tag from another, shape (n,); the link is reciprocal.

        Tags are places in the scenario's list, times true sub-ticks.
        """
        columns = np.empty((4, len(time)))
        pair = initiator * len(self.scenario.tags) + target
        for key in np.unique(pair):
            rows = np.flatnonzero(pair == key)
            i, j = divmod(int(key), len(self.scenario.tags))
            found = self._pair(i, j, time[rows] / SUBTICKS_PER_SECOND)
            columns[:, rows] = found.distance_m, found.excess_m, found.power_dbm, found.total_dbm
        return Link(*columns)

    def echoes(self, sender: int, receiver: int, time: int) -> list[tuple[float, float]]:
        """Return the paths after the first at one instant: delays in seconds, amplitudes as shares of the first's."""
        room, radio = self.scenario.room, self.scenario.radio
        if room is None or room.reflection_loss_db is None:
            return []
        at = np.array([time / SUBTICKS_PER_SECOND])
        spots = self._tag(sender, at)[0], self._tag(receiver, at)[0]
        first = self.link(np.array([sender]), np.array([receiver]), np.array([time]))
        lengths = reflected_lengths_m(room, *spots)[0]
        power = path_gain_db(radio, lengths) - room.reflection_loss_db
        later = lengths - float(first.distance_m[0] + first.excess_m[0])
        direct = path_gain_db(radio, first.distance_m + first.excess_m)[0]
        share = 10 ** ((power - direct) / 20)
        return [(x / SPEED_OF_LIGHT, a) for x, a in zip(later.tolist(), share.tolist(), strict=True) if x > 0.01]

    def _pair(self, i: int, j: int, time_s: Floats) -> Link:
        (one, turn), (other, turned) = (self._tag(k, time_s) for k in (i, j))
        return link_between(
            Ends(
                scenario=self.scenario,
                phases=self.phases,
                time_s=time_s,
                places=(np.full(len(time_s), i), np.full(len(time_s), j)),
                antennas_m=(one, other),
                rotations=(turn, turned),
                shadows=self._shadows(time_s),
            )
        )

    def _shadows(self, time_s: Floats) -> list[PlacedShadow]:
        """Place the bodies that have a shadow."""
        return [
            PlacedShadow(shadow=body.shadow, position_m=path.position_m(time_s), rotation=_matrices(path, time_s))
            for body in self.scenario.bodies
            for path in [self.trajectories[body.name]]
            if body.shadow is not None
        ]

    def _tag(self, index: int, time_s: Floats) -> tuple[Floats, Floats]:
        tag = self.scenario.tags[index]
        body = self.trajectories[tag.body]
        turn = _matrices(body, time_s)
        return body.position_m(time_s) + turn @ np.array(tag.lever_arm_m), turn

    def motion_capture(self) -> Poses:
        """Return the poses that motion capture writes over the run, with its rate, noise, latency and gaps."""
        mocap, settings = self.scenario.mocap, self.scenario.run
        # A little longer than the run, so that the last exchange lies between two poses.
        count = int(np.ceil((settings.duration_s + 0.05) * mocap.rate_hz)) + 2
        time_ns = np.rint(np.arange(count) * NS_PER_S / mocap.rate_hz).astype(np.int64)
        parts = [
            (name, rows, *self._seen(name, time_ns))
            for name in self.trajectories
            for rows in [self._gaps(name, time_ns)]
        ]
        names = np.concatenate([np.full(np.count_nonzero(rows), name) for name, rows, _, _ in parts])
        times = np.concatenate([time_ns[rows] for _, rows, _, _ in parts]) + round(mocap.latency_s * NS_PER_S)
        position = np.concatenate([p[rows] for _, rows, p, _ in parts])
        quaternion = np.concatenate([q[rows] for _, rows, _, q in parts])
        order = np.argsort(times, kind="stable")
        return Poses(times[order], names[order], position[order], quaternion[order])

    def _gaps(self, name: str, time_ns: Ints) -> Bools:
        """Which poses of a body are seen."""
        mocap = self.scenario.mocap
        seen = np.ones(len(time_ns), dtype=bool)
        if mocap.gaps_per_min:
            rng = stream(self.scenario.run.seed, "motion capture gaps", name)
            duration = float(time_ns[-1]) * NS
            for begin in rng.uniform(0, duration, rng.poisson(mocap.gaps_per_min * duration / 60)):
                seen &= (time_ns < begin * NS_PER_S) | (time_ns > (begin + mocap.gap_s) * NS_PER_S)
        return seen

    def _seen(self, name: str, time_ns: Ints) -> tuple[Floats, Floats]:
        mocap, body = self.scenario.mocap, self.trajectories[name]
        rng = stream(self.scenario.run.seed, "motion capture", name)
        time_s = np.asarray(time_ns * NS, dtype=np.float64)
        position = body.position_m(time_s) + rng.normal(0, 1, (len(time_s), 3)) * mocap.position_noise_m
        wobble = Rotation.from_rotvec(rng.normal(0, 1, (len(time_s), 3)) * mocap.attitude_noise_rad)
        return position, (Rotation.from_quat(body.quaternion(time_s)) * wobble).as_quat()


def _matrices(path: Trajectory, time_s: Floats) -> Floats:
    """Return rotations body to world, (n, 3, 3)."""
    return np.asarray(Rotation.from_quat(path.quaternion(time_s)).as_matrix())


def _trajectories(scenario: Scenario) -> dict[str, Trajectory]:
    """Sample trajectories one after the other, trying again where a body would come too near an earlier one."""
    seed, duration = scenario.run.seed, scenario.run.duration_s
    least = scenario.min_separation_m
    time = np.arange(0, min(duration, 600.0) + SEPARATION_STEP_S, SEPARATION_STEP_S)
    found: dict[str, Trajectory] = {}
    for body in scenario.bodies:
        for attempt in range(TRIES if least else 1):
            names = (body.name, attempt) if attempt else (body.name,)
            path = sample(body.motion, duration, partial(stream, seed, "motion", *names))
            if not least or all(_nearest_m(path, other, time) >= least for other in found.values()):
                break
        else:
            raise ScenarioError(
                f"min_separation_m: body {body.name!r} comes nearer than {least:g} m to another in {TRIES} tries; "
                "give bodies more room, or less separation"
            )
        found[body.name] = path
    return found


def _nearest_m(one: Trajectory, other: Trajectory, time_s: Floats) -> float:
    return float(np.linalg.norm(one.position_m(time_s) - other.position_m(time_s), axis=1).min())
