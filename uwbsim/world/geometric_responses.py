"""Geometric responses of pairs of tags, one every few milliseconds, computed ahead and kept.

Flights, listeners and comparisons of protocols ask for many links at once, served boards for one sender at an instant.
All get the response of the nearest step, so all get the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Final, Self

import numpy as np

from uwblink.arrays import Floats, Ints
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.radio import GeometricMultipath
from uwbsim.world.geometric_paths import (
    Paths,
    Placed,
    PlacedBody,
    Surroundings,
    legs_to_scatterers,
    paths_between,
)
from uwbsim.world.impulse_response import Detected, detect
from uwbsim.world.trajectories import Trajectory

CHUNK: Final = 2048
"""Links computed at once: with fewer each takes longer, more do not fit into a core's cache."""

COLUMNS: Final = tuple(column.name for column in fields(Detected))


@dataclass(slots=True)
class GeometricResponses:
    """The responses of a scenario's pairs of tags; computed ones are kept.

    Both directions of a pair have one response, unless the tags' powers differ, which changes detection. `keys` are the
    sorted keys of kept responses, `columns` (`COLUMNS`, keys) their readings.
    """

    around: Surroundings
    trajectories: Mapping[str, Trajectory]
    model: GeometricMultipath
    keys: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    columns: Floats = field(default_factory=lambda: np.zeros((len(COLUMNS), 0)))

    @classmethod
    def of(cls, scenario: Scenario, trajectories: Mapping[str, Trajectory], phases: Floats) -> Self | None:
        """Return the responses of a scenario's world; None for a scenario without geometric multipath."""
        model = scenario.radio.multipath
        if not isinstance(model, GeometricMultipath):
            return None
        return cls(Surroundings.of(scenario, phases), trajectories, model)

    def at(self, places: tuple[Ints, Ints], time_s: Floats) -> Detected:
        """Return the readings of the responses between tags with indices (n,) at true times (n,)."""
        keys = self._key(places, self._step(time_s))
        self._add(self._missing(keys))
        return Detected(*self.columns[:, np.searchsorted(self.keys, keys)])

    def prepare(self, places: tuple[Ints, Ints], time_s: Floats) -> None:
        """Compute responses ahead: those of many pairs at once share the paths to scatterers."""
        keys = self._key(places, self._step(time_s))
        missing = self._missing(keys)
        # The readings of two million responses are kept at most: 80 MB.
        if len(missing) and len(self.keys) + len(missing) > 2_000_000:
            kept = np.isin(self.keys, keys)
            self.keys, self.columns = self.keys[kept], self.columns[:, kept]
        self._add(missing)

    def _missing(self, keys: Ints) -> Ints:
        """Return the keys that are not kept, sorted, each once."""
        if not len(self.keys):
            return np.unique(keys)
        rows = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return np.unique(keys[self.keys[rows] != keys])

    def _add(self, missing: Ints) -> None:
        """Compute responses and insert their readings."""
        if len(missing):
            keys = np.concatenate([self.keys, missing])
            order = np.argsort(keys, kind="stable")
            self.keys, self.columns = keys[order], np.hstack([self.columns, self._compute(missing)])[:, order]

    def look_ahead(self, sender: int, time_s: float) -> None:
        """Compute the responses from a sender to all tags for the next few steps, for calls in order of time."""
        # Such callers do not go back far: few responses are kept.
        ahead, most_kept = 16, 5_000
        here = np.arange(len(self.around.scenario.tags))
        origin, first = np.full(len(here), sender), self._step(np.array([time_s]))
        if not len(self._missing(self._key((origin, here), first))):
            return
        if len(self.keys) > most_kept:
            self.keys, self.columns = self.keys[:0], self.columns[:, :0]
        steps = first + np.arange(ahead)[:, None]
        self.prepare(
            (np.tile(origin, ahead), np.tile(here, ahead)), np.repeat(steps * (self.model.step_ms * 1e-3), len(here))
        )

    def paths(self, places: tuple[Ints, Ints], time_s: Floats) -> Paths:
        """Return the paths between tags with indices (n,) at the steps nearest to true times (n,)."""
        keys, rows = np.unique(self._key(places, self._step(time_s)), return_inverse=True)
        parts = [self._paths(keys[begin : begin + CHUNK]) for begin in range(0, len(keys), CHUNK)]
        detour_m = np.concatenate([part.detour_m for part in parts])
        return Paths(detour_m=detour_m[rows], amplitude=np.concatenate([part.amplitude for part in parts])[rows])

    def _step(self, time_s: Floats) -> Ints:
        return np.rint(np.maximum(time_s, 0) / (self.model.step_ms * 1e-3)).astype(np.int64)

    def _key(self, places: tuple[Ints, Ints], step: Ints) -> Ints:
        """Return one number for step, sender and receiver, increasing with time."""
        a, b = places
        count = len(self.around.scenario.tags)
        if not any(tag.tx_power_db for tag in self.around.scenario.tags):
            a, b = np.minimum(a, b), np.maximum(a, b)
        return (step * count + a) * count + b

    def _compute(self, keys: Ints) -> Floats:
        """Return the columns of responses, (`COLUMNS`, n)."""
        noise_share = 1 / self.model.threshold_to_noise if self.model.stamp_noise else 0.0
        chunks = (self._paths(keys[begin : begin + CHUNK]) for begin in range(0, len(keys), CHUNK))
        read = [detect(paths, self.around.scenario.radio, noise_share) for paths in chunks]
        return np.array([np.concatenate([getattr(one, name) for one in read]) for name in COLUMNS])

    def _paths(self, keys: Ints) -> Paths:
        scenario = self.around.scenario
        count = len(scenario.tags)
        pair_step, b = np.divmod(keys, count)
        step, a = np.divmod(pair_step, count)
        instants, at = np.unique(step, return_inverse=True)
        time_s = instants * (self.model.step_ms * 1e-3)
        poses = {name: self.trajectories[name].pose(time_s) for name in self.trajectories}
        bodies = [
            PlacedBody(
                shadow=body.shadow,
                position_m=poses[body.name][0],
                rotation=poses[body.name][1],
                carries=np.array([tag.body == body.name for tag in scenario.tags]),
            )
            for body in scenario.bodies
            if body.shadow is not None
        ]
        # The paths of an antenna to the scatterers at an instant are computed once for all its links.
        ends, which = np.unique(np.concatenate([at * count + a, at * count + b]), return_inverse=True)
        placed, instant = self._placed(ends % count, ends // count, poses), ends // count
        legs = legs_to_scatterers(self.around, placed, bodies, instant)
        one, other = which[: len(keys)], which[len(keys) :]
        both = (placed[one], placed[other])
        paths = paths_between(self.around, both, (legs[one], legs[other]), bodies, at)
        stronger = 10 ** (np.array([tag.tx_power_db for tag in scenario.tags]) / 20)
        return Paths(detour_m=paths.detour_m, amplitude=paths.amplitude * stronger[a][:, None])

    def _placed(self, tag: Ints, instant: Ints, poses: Mapping[str, tuple[Floats, Floats]]) -> Placed:
        position, rotation = np.empty((len(tag), 3)), np.empty((len(tag), 3, 3))
        for k, each in enumerate(self.around.scenario.tags):
            rows = np.flatnonzero(tag == k)
            spots, turns = poses[each.body]
            rotation[rows] = turns[instant[rows]]
            position[rows] = spots[instant[rows]] + rotation[rows] @ np.array(each.lever_arm_m)
        return Placed(tag=tag, antenna_m=position, rotation=rotation)
