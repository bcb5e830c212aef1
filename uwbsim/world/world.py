"""Positions of all tags, states of their pairs, and the links between them: exact, or interpolated from blocks.

Pairs have lasting states: fading, outages, and reflections ("two-state" multipath). A state is constant between random
instants, at which it is drawn again, so its autocorrelation is exp(-dt/life). Each property has a random stream with
the name of its purpose and the two tags, so a longer run continues a shorter one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import Final, Self

import numpy as np
from scipy.spatial.transform import Rotation

from uwblink.arrays import Floats, Ints
from uwblink.recording.schema import Poses
from uwbsim.errors import ScenarioError
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.radio import Fading, GeometricMultipath, Outages, TwoStateMultipath
from uwbsim.world.channel import Ends, Link, PlacedBody, link_between, paths_heard
from uwbsim.world.clocks import NS_PER_S, SUBTICKS_PER_SECOND
from uwbsim.world.geometric import GeometricResponses
from uwbsim.world.impulse_response import PathsHeard
from uwbsim.world.radio import shadowing_phases
from uwbsim.world.trajectories import Draw, Trajectory, sample


@dataclass(frozen=True, slots=True, kw_only=True)
class PairStates:
    """The states of all pairs of tags, ordered by pair and time.

    `pair` (tags, tags) is the number of the pair of two tags by their indices. `begin` (states,) are the instants in
    seconds at which states are drawn, plus `span_s` times the number of their pair, so that one search finds a state;
    `values` (rows, states) are the states.
    """

    pair: Ints
    span_s: float
    begin: Floats
    values: Floats

    @classmethod
    def draw(
        cls,
        scenario: Scenario,
        purpose: str,
        life_s: Callable[[list[int], Draw], float],
        values: Callable[[list[int], Draw, int], Floats],
    ) -> Self:
        """Draw the states of all pairs over a run.

        `life_s(ids, draw)` is the mean time between the instants of the pair with these tag ids, and
        `values(ids, draw, count)` draws its states, (rows, count).
        """
        # Links are needed until at most a minute after the end of a run; after that the last state remains.
        count, span = len(scenario.tags), scenario.run.duration_s + 60.0
        pair, begins, drawn = np.zeros((count, count), dtype=np.int64), [], []
        for number, (a, b) in enumerate(combinations(range(count), 2)):
            pair[a, b] = pair[b, a] = number
            ids = sorted((scenario.tags[a].id, scenario.tags[b].id))
            draw = partial(stream, scenario.run.seed, purpose, *ids)
            begin = _instants(draw("instants"), life_s(ids, draw), span)
            begins.append(begin + number * span)
            drawn.append(values(ids, draw, len(begin)))
        return cls(pair=pair, span_s=span, begin=np.concatenate(begins), values=np.concatenate(drawn, axis=-1))

    def at(self, places: tuple[Ints, Ints], time_s: Floats) -> Floats:
        """Return the states (rows, n) between tags (n,) at true times (n,); zero between a tag and itself.

        States are the same in both directions.
        """
        inside = np.clip(time_s, 0, np.nextafter(self.span_s, 0))
        found = np.searchsorted(self.begin, self.pair[places] * self.span_s + inside, side="right") - 1
        return np.where(places[0] != places[1], self.values[:, found], 0.0)


def _instants(rng: np.random.Generator, life_s: float, span_s: float) -> Floats:
    """Return the instants of draws from zero to `span_s`, a Poisson process."""
    begin = np.zeros(1)
    while begin[-1] < span_s:
        more = rng.exponential(life_s, int((span_s - begin[-1]) / life_s * 1.1) + 8)
        begin = np.concatenate([begin, begin[-1] + np.cumsum(more)])
    return np.asarray(begin[begin < span_s])


def pair_levels(scenario: Scenario) -> list[PairStates]:
    """Draw fading and outages (`radio.fading`, `radio.outages`) over a run: changes of power, in dB, (1, states)."""
    models = {"fading": scenario.radio.fading, "outages": scenario.radio.outages}
    return [_levels_of(scenario, purpose, model) for purpose, model in models.items() if model is not None]


def _levels_of(scenario: Scenario, purpose: str, model: Fading | Outages) -> PairStates:
    return PairStates.draw(
        scenario, purpose, lambda *_: model.life_s, lambda _, draw, count: model.draw_db(draw("levels"), count)
    )


def reflected_states(scenario: Scenario, model: TwoStateMultipath) -> PairStates:
    """Draw the first paths of all pairs over a run, (4, states).

    The rows are: whether the first path is a reflection; its excess length in metres; for reflections the loss in dB
    relative to the direct path; and the delay in seconds of the strongest path after it.
    """

    def life(ids: list[int], draw: Draw) -> float:
        return pair_reflections(model, ids, draw("pair"))[1]

    def states(ids: list[int], draw: Draw, count: int) -> Floats:
        share, _, mean_m = pair_reflections(model, ids, draw("pair"))
        reflected = draw("state").random(count) < share
        excess = draw("excess").gamma(model.excess_shape, mean_m / model.excess_shape, count)
        about = draw("direct").normal(0, 1, count) * model.direct_std_m
        loss_db = draw("loss").normal(model.first_path_loss_db, model.loss_std_db, count)
        rise_s = draw("rise").exponential((model.rise_ns * 1e-9), count)
        longer = np.where(reflected, excess, about)
        return np.array([reflected, longer, np.maximum(loss_db, model.total_loss_db), rise_s])

    return PairStates.draw(scenario, "reflected states", life, states)


def pair_reflections(model: TwoStateMultipath, ids: list[int], rng: np.random.Generator) -> tuple[float, float, float]:
    """Return a pair's share of reflections, their life in seconds and their mean excess length in metres.

    They are the scenario's values for the pair; otherwise the first two are random.
    """
    share, mean_m = model.share, model.mean_excess_m
    if model.share_std:
        # The beta distribution with the model's mean and standard deviation.
        total = model.share * (1 - model.share) / model.share_std**2 - 1
        share = rng.beta(model.share * total, (1 - model.share) * total)
    life_s = model.life_s * float(np.exp(model.life_spread * rng.normal()))
    for known in model.pairs:
        if set(known.tags) == set(ids):
            share = known.share if known.share is not None else share
            life_s, mean_m = known.life_s or life_s, known.mean_excess_m or mean_m
    return float(share), life_s, mean_m


PIECE: Final = 4096
"""Links computed at once: more do not fit into a core's cache."""


class World:
    """Bodies on their trajectories, with tags on lever arms.

    `phases` are the phases of the tags' shadowing, `states` the lasting reflections of pairs, `levels` their fading and
    outages, `responses` the geometric responses; None or empty if the scenario has none.
    """

    def __init__(self, scenario: Scenario) -> None:
        """Draw all random values; raises `ScenarioError` if bodies cannot keep their distance."""
        model = scenario.radio.multipath
        self.scenario, self.trajectories = scenario, _trajectories(scenario)
        self.phases = shadowing_phases(scenario)
        self.states = reflected_states(scenario, model) if isinstance(model, TwoStateMultipath) else None
        self.levels = pair_levels(scenario)
        self.obstructing = [(body, body.shadow) for body in scenario.bodies if body.shadow is not None]
        self.responses = GeometricResponses(self, model) if isinstance(model, GeometricMultipath) else None

    def link(self, initiator: Ints, target: Ints, time: Ints) -> Link:
        """Return the links from the first tags to the second, (n,); reciprocal except for the sender's power.

        Tags are indices in the scenario's list, times true sub-ticks.
        """
        return Link.concatenate([link_between(ends) for ends in self._pieces(initiator, target, time)])

    def paths(self, sender: Ints, receiver: Ints, time: Ints, detour_m: Floats) -> list[PathsHeard]:
        """Return the paths of n links for impulse responses; `detour_m` are random detours of first paths."""
        found: list[PathsHeard] = []
        for ends in self._pieces(sender, receiver, time):
            found += paths_heard(link_between(ends), ends, detour_m[len(found) : len(found) + PIECE])
        return found

    def _pieces(self, sender: Ints, receiver: Ints, time: Ints) -> Iterator[Ends]:
        for begin in range(0, max(len(time), 1), PIECE):
            rows = slice(begin, begin + PIECE)
            yield self.ends((sender[rows], receiver[rows]), time[rows] / SUBTICKS_PER_SECOND)

    def ends(self, places: tuple[Ints, Ints], time_s: Floats) -> Ends:
        """Return the ends of links between tags with indices (n,) at true times (n,)."""
        one, other = (self.antennas(tags, time_s) for tags in places)
        poses = [self.trajectories[body.name].pose(time_s) for body, _ in self.obstructing]
        return Ends(
            world=self,
            time_s=time_s,
            places=places,
            antennas_m=(one[0], other[0]),
            rotations=(one[1], other[1]),
            shadows=self.shadows(poses),
        )

    def shadows(self, poses: Iterable[tuple[Floats, Floats]]) -> list[PlacedBody]:
        """Return the bodies with a shadow at their poses: positions (n, 3) and rotations (n, 3, 3) of each."""
        return [PlacedBody(*body, *pose) for body, pose in zip(self.obstructing, poses, strict=True)]

    def antennas(self, tags: Ints, time_s: Floats) -> tuple[Floats, Floats]:
        """Return positions (n, 3) and rotations (n, 3, 3) of the antennas of tags (n,) at true times (n,)."""
        position, rotation = np.empty((len(tags), 3)), np.empty((len(tags), 3, 3))
        names = sorted(self.trajectories)
        body = np.array([names.index(tag.body) for tag in self.scenario.tags])[tags]
        for number in np.unique(body).tolist():
            rows = np.flatnonzero(body == number)
            position[rows], rotation[rows] = self.trajectories[names[number]].pose(time_s[rows])
        arms_m = np.array([tag.lever_arm_m for tag in self.scenario.tags])[tags]
        return position + (rotation @ arms_m[:, :, None])[:, :, 0], rotation

    def motion_capture(self) -> Poses:
        """Return the poses that motion capture records during the run, with its rate, noise, latency and gaps."""
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
        """Return the poses of a body that motion capture records at times (n,), except in gaps with these starts."""
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
    """Draw the trajectories one by one; a trajectory that comes too close to an earlier one is drawn again."""
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
                f"min_separation_m: in {tries} tries body {body.name!r} comes closer than {least:g} m to another; "
                f"give bodies more space, or less separation"
            )
        found[body.name] = path
    return found


STEP_S: Final = 0.005
STEPS: Final = 200
"""Number of samples of a block, `STEP_S` apart. The error of linear interpolation at an acceleration a is a
(STEP_S)^2/8: 30 um or 0.01 ticks at 10 m/s^2."""


class SampledWorld:
    """The links of a world for single frames in order of time, interpolated within blocks of `STEPS` samples.

    A time in another block than the last one computes this block.
    """

    def __init__(self, world: World) -> None:
        """Compute the first block."""
        self._world = world
        self._block, self._samples = 0, self._sample(0)

    def link(self, initiator: Ints, target: Ints, time: Ints) -> Link:
        """Return the links of one frame: all rows must have the same sender and time."""
        return self.from_sender(int(initiator[0]), int(time[0]))[target]

    def from_sender(self, sender: int, time: int) -> Link:
        """Return the links from a tag, by its index, to all tags, (tags,)."""
        time_s, count = time / SUBTICKS_PER_SECOND, len(self._world.scenario.tags)
        step, into = divmod(time_s / STEP_S, 1)
        block, index = divmod(int(step), STEPS)
        if block != self._block:
            self._block, self._samples = block, self._sample(block)
        spots, turns = (column[index] + into * (column[index + 1] - column[index]) for column in self._samples)
        origin = np.full(count, sender)
        ends = Ends(
            world=self._world,
            time_s=np.full(count, time_s),
            places=(origin, np.arange(count)),
            antennas_m=(spots[origin], spots[:count]),
            rotations=(turns[origin], turns[:count]),
            shadows=self._world.shadows(
                (np.broadcast_to(spot, (count, 3)), np.broadcast_to(turn, (count, 3, 3)))
                for spot, turn in zip(spots[count:], turns[count:], strict=True)
            ),
        )
        return link_between(ends)

    def _sample(self, block: int) -> tuple[Floats, Floats]:
        """Return positions (steps, k, 3) and rotations (steps, k, 3, 3) of antennas, then of bodies with a shadow."""
        world, time = self._world, np.asarray((block * STEPS + np.arange(STEPS + 1)) * STEP_S, dtype=np.float64)
        poses = {name: path.pose(time) for name, path in world.trajectories.items()}
        names = [tag.body for tag in world.scenario.tags] + [body.name for body, _ in world.obstructing]
        arms = np.zeros((len(names), 3))
        arms[: len(world.scenario.tags)] = [tag.lever_arm_m for tag in world.scenario.tags]
        position, turned = (np.stack([poses[name][k] for name in names], axis=1) for k in (0, 1))
        return position + np.einsum("stij,tj->sti", turned, arms), turned
