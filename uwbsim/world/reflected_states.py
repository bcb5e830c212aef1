"""Reflections that last: which path a pair of tags has at an instant (`radio.multipath` of the model "two-state")."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import Final, Self

import numpy as np

from uwblink.arrays import Bools, Floats, Ints
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.multipath import TwoStateMultipath

MARGIN_S: Final = 60.0
"""So long after the end of a run links are still asked for at most; later on the last path lasts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Paths:
    """The paths that n links have: whether reflections, and what tells them from direct ones, (n,) each.

    `excess_m` is the excess length of the first path; `first_loss_db` how much weaker it is than the direct one would
    be, and `rise_s` how much later the strongest path comes, zero for direct paths.
    """

    reflected: Bools
    excess_m: Floats
    first_loss_db: Floats
    rise_s: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class ReflectedStates:
    """All paths of all pairs, one pair after the other, each pair's in order of time.

    `begin` has their beginnings in seconds, moved by `span_s` for each pair before, so that one search finds a path;
    `pair` gives the pair of two tags by their places, (tags, tags).
    """

    pair: Ints
    span_s: float
    begin: Floats
    paths: Paths

    @classmethod
    def of(cls, scenario: Scenario) -> Self | None:
        """Draw the paths of all pairs over a run; None where the scenario does not ask for any."""
        model = scenario.radio.multipath
        if not isinstance(model, TwoStateMultipath):
            return None
        count, span = len(scenario.tags), scenario.run.duration_s + MARGIN_S
        pair = np.zeros((count, count), dtype=np.int64)
        begins, parts = [], []
        for number, (a, b) in enumerate(combinations(range(count), 2)):
            pair[a, b] = pair[b, a] = number
            ids = sorted((scenario.tags[a].id, scenario.tags[b].id))
            draw = partial(stream, scenario.run.seed, "reflected states", *ids)
            share, life_s = share_and_life(model, ids, draw("pair"))
            mean_m = next((p.mean_excess_m for p in model.pairs if set(p.tags) == set(ids) and p.mean_excess_m), None)
            begin = _instants(draw("instants"), life_s, span)
            begins.append(begin + number * span)
            parts.append(_paths(model, draw, share, mean_m or model.mean_excess_m, len(begin)))
        paths = Paths(
            reflected=np.concatenate([part.reflected for part in parts]),
            excess_m=np.concatenate([part.excess_m for part in parts]),
            first_loss_db=np.concatenate([part.first_loss_db for part in parts]),
            rise_s=np.concatenate([part.rise_s for part in parts]),
        )
        return cls(pair=pair, span_s=span, begin=np.concatenate(begins), paths=paths)

    def at(self, places: tuple[Ints, Ints], time_s: Floats) -> Paths:
        """Return the paths between tags at places (n,) at true times (n,); the same in both directions."""
        inside = np.clip(time_s, 0, np.nextafter(self.span_s, 0))
        k = np.searchsorted(self.begin, self.pair[places] * self.span_s + inside, side="right") - 1
        p = self.paths
        # A tag has no path to itself.
        reflected = p.reflected[k] & (places[0] != places[1])
        return Paths(
            reflected=reflected,
            excess_m=np.where(places[0] != places[1], p.excess_m[k], 0.0),
            first_loss_db=np.where(reflected, p.first_loss_db[k], 0.0),
            rise_s=np.where(reflected, p.rise_s[k], 0.0),
        )


def share_and_life(model: TwoStateMultipath, ids: list[int], rng: np.random.Generator) -> tuple[float, float]:
    """Return a pair's share of reflections and their life in seconds: known ones, or drawn."""
    uniform = rng.beta(*_beta(model)) if model.share_std else model.share
    life_s = model.life_s * float(np.exp(model.life_spread * rng.normal()))
    for known in model.pairs:
        if set(known.tags) == set(ids):
            uniform = known.share if known.share is not None else uniform
            life_s = known.life_s if known.life_s is not None else life_s
    return float(uniform), life_s


def _beta(model: TwoStateMultipath) -> tuple[float, float]:
    """Return the parameters of the beta distribution with the model's mean and standard deviation."""
    total = model.share * (1 - model.share) / model.share_std**2 - 1
    return model.share * total, (1 - model.share) * total


def _instants(rng: np.random.Generator, life_s: float, span_s: float) -> Floats:
    """Return when paths are drawn anew, from zero on."""
    gaps = [np.zeros(1)]
    while (reached := float(sum(gap.sum() for gap in gaps))) < span_s:
        gaps.append(rng.exponential(life_s, int((span_s - reached) / life_s * 1.1) + 8))
    begin = np.cumsum(np.concatenate(gaps))
    return np.asarray(begin[begin < span_s])


def _paths(
    model: TwoStateMultipath, draw: Callable[[str], np.random.Generator], share: float, mean_m: float, count: int
) -> Paths:
    """Draw paths (count,), each property from a stream of its own, so that a longer run continues a shorter one."""
    reflected = draw("state").random(count) < share
    excess = draw("excess").gamma(model.excess_shape, mean_m / model.excess_shape, count)
    about = draw("direct").normal(0, 1, count) * model.direct_std_m
    loss_db = draw("loss").normal(model.first_path_loss_db, model.loss_std_db, count)
    return Paths(
        reflected=reflected,
        excess_m=np.where(reflected, excess, about),
        first_loss_db=np.maximum(loss_db, model.total_loss_db),
        rise_s=draw("rise").exponential(model.rise_s, count),
    )
