"""Responses of pairs of tags from geometry, computed ahead: one every few milliseconds.

Flights, listeners and the workbench ask for many links at once, served boards for one sender at an instant; all have
the response of the nearest step, so all have the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
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
from uwbsim.world.impulse_response import Detected, Sensing, detect
from uwbsim.world.trajectories import Trajectory

CHUNK: Final = 2048
"""Links computed at once: fewer take longer each, more do not fit into a core's cache."""

COLUMNS: Final = ("excess_m", "power_dbm", "total_dbm", "noise_s")


@dataclass(slots=True)
class GeometricResponses:
    """The responses of a scenario's pairs of tags; those asked for once are kept.

    A pair is the same in both directions, unless a tag sends stronger than others: then what a receiver can tell
    differs. `keys` are those kept, in order, `columns` (`COLUMNS`, keys) what was read off them.
    """

    around: Surroundings
    trajectories: Mapping[str, Trajectory]
    model: GeometricMultipath
    keys: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    columns: Floats = field(default_factory=lambda: np.zeros((len(COLUMNS), 0)))

    @classmethod
    def of(cls, scenario: Scenario, trajectories: Mapping[str, Trajectory], phases: Floats) -> Self | None:
        """Return what knows the responses of a scenario's world; None where the scenario does not ask for them."""
        model = scenario.radio.multipath
        if not isinstance(model, GeometricMultipath):
            return None
        return cls(Surroundings.of(scenario, phases), trajectories, model)

    def at(self, places: tuple[Ints, Ints], time_s: Floats) -> Detected:
        """Return what is read off the responses between tags at places (n,) at true times (n,)."""
        keys = self._key(places, self._step(time_s))
        self._add(self._missing(keys))
        rows = np.searchsorted(self.keys, keys)
        return Detected(**dict(zip(COLUMNS, self.columns[:, rows], strict=True)))

    def prepare(self, places: tuple[Ints, Ints], time_s: Floats) -> None:
        """Compute responses that will be asked for; those of many pairs at once share what they have in common."""
        keys = self._key(places, self._step(time_s))
        missing = self._missing(keys)
        # Two million responses' figures are kept at most: 80 MB.
        if len(missing) and len(self.keys) + len(missing) > 2_000_000:
            kept = np.isin(self.keys, keys)
            self.keys, self.columns = self.keys[kept], self.columns[:, kept]
        self._add(missing)

    def _missing(self, keys: Ints) -> Ints:
        """Return those that are not kept, in order, each once."""
        if not len(self.keys):
            return np.unique(keys)
        rows = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return np.unique(keys[self.keys[rows] != keys])

    def _add(self, missing: Ints) -> None:
        """Compute responses and keep them among the others."""
        if len(missing):
            keys = np.concatenate([self.keys, missing])
            order = np.argsort(keys, kind="stable")
            self.keys, self.columns = keys[order], np.hstack([self.columns, self._compute(missing)])[:, order]

    def look_ahead(self, sender: int, time_s: float) -> None:
        """Compute what all tags will hear of a sender in the next few steps, for calls instant by instant."""
        # Who goes from instant to instant does not come back far: few responses are kept.
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
        """Return the paths between tags at places (n,) at the steps nearest to true times (n,)."""
        keys, rows = np.unique(self._key(places, self._step(time_s)), return_inverse=True)
        parts = [self._paths(keys[begin : begin + CHUNK]) for begin in range(0, len(keys), CHUNK)]
        detour_m = np.concatenate([part.detour_m for part in parts])
        return Paths(detour_m=detour_m[rows], amplitude=np.concatenate([part.amplitude for part in parts])[rows])

    def _step(self, time_s: Floats) -> Ints:
        return np.rint(np.maximum(time_s, 0) / (self.model.step_ms * 1e-3)).astype(np.int64)

    def _key(self, places: tuple[Ints, Ints], step: Ints) -> Ints:
        """One number for step, sender and receiver, in order of time."""
        a, b = places
        count = len(self.around.scenario.tags)
        if not any(tag.tx_power_db for tag in self.around.scenario.tags):
            a, b = np.minimum(a, b), np.maximum(a, b)
        return (step * count + a) * count + b

    def _compute(self, keys: Ints) -> Floats:
        """Return the columns of responses, (`COLUMNS`, n)."""
        radio, found = self.around.scenario.radio, []
        share = 1 / self.model.threshold_to_noise if self.model.stamp_noise else 0.0
        sensing = Sensing(
            dynamic_range_db=radio.dynamic_range_db, sensitivity_dbm=radio.sensitivity_dbm, noise_share=share
        )
        for begin in range(0, len(keys), CHUNK):
            seen = detect(self._paths(keys[begin : begin + CHUNK]), sensing)
            found.append(np.array([getattr(seen, name) for name in COLUMNS]))
        return np.hstack(found)

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
        # An antenna at an instant has its ways to the scatterers once, however many links it is an end of.
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
