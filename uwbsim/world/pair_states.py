"""Random states of pairs of tags over time: fading, outages, and lasting reflections ("two-state" multipath).

A state is constant between random instants, at which it is drawn again (`Redraws`), so its autocorrelation is
exp(-dt/life). Each property has a random stream named by its purpose and the two tags: a longer run continues a shorter
one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import Self

import numpy as np

from uwblink.arrays import Bools, Floats, Ints
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.radio import Fading, TwoStateMultipath

Draw = Callable[[str], np.random.Generator]
"""Returns the random stream of a pair, or of a body, for a purpose."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Redraws:
    """The instants at which the states of pairs are drawn again, ordered by pair and time.

    `begin` are the instants in seconds plus `span_s` times the number of their pair, so that one search finds a state;
    `pair` is the number of the pair of two tags by their indices, (tags, tags).
    """

    pair: Ints
    span_s: float
    begin: Floats

    @classmethod
    def of(
        cls,
        scenario: Scenario,
        purpose: str,
        life_s: Callable[[list[int], Draw], float],
        values: Callable[[list[int], Draw, int], Floats],
    ) -> tuple[Self, Floats]:
        """Return the instants of all pairs, and the values drawn at them, (..., instants).

        `life_s(ids, draw)` is the mean time between redraws of the pair with these tag ids, and
        `values(ids, draw, count)` draws its states, (..., count).
        """
        # Links are needed until a minute after the end of a run at most; beyond it the last state stays.
        count, span = len(scenario.tags), scenario.run.duration_s + 60.0
        pair, begins, drawn = np.zeros((count, count), dtype=np.int64), [], []
        for number, (a, b) in enumerate(combinations(range(count), 2)):
            pair[a, b] = pair[b, a] = number
            ids = sorted((scenario.tags[a].id, scenario.tags[b].id))
            draw = partial(stream, scenario.run.seed, purpose, *ids)
            begin = _instants(draw("instants"), life_s(ids, draw), span)
            begins.append(begin + number * span)
            drawn.append(values(ids, draw, len(begin)))
        return cls(pair=pair, span_s=span, begin=np.concatenate(begins)), np.concatenate(drawn, axis=-1)

    def at(self, places: tuple[Ints, Ints], time_s: Floats) -> Ints:
        """Return the indices (n,) of the states between tags (n,) at true times (n,); the same in both directions."""
        inside = np.clip(time_s, 0, np.nextafter(self.span_s, 0))
        return np.searchsorted(self.begin, self.pair[places] * self.span_s + inside, side="right") - 1


def _instants(rng: np.random.Generator, life_s: float, span_s: float) -> Floats:
    """Return the instants of redraws from zero to `span_s`, a Poisson process."""
    begin = np.zeros(1)
    while begin[-1] < span_s:
        more = rng.exponential(life_s, int((span_s - begin[-1]) / life_s * 1.1) + 8)
        begin = np.concatenate([begin, begin[-1] + np.cumsum(more)])
    return np.asarray(begin[begin < span_s])


@dataclass(frozen=True, slots=True)
class PairLevels:
    """Fading and outages (`radio.fading`, `radio.outages`): levels in dB and the instants at which they change."""

    parts: tuple[tuple[Redraws, Floats], ...]

    @classmethod
    def of(cls, scenario: Scenario) -> Self | None:
        """Draw fading and outages over a run; None for a scenario without either."""
        fading, outages, parts = scenario.radio.fading, scenario.radio.outages, []
        if fading is not None:
            parts.append(_levels(scenario, "fading", fading.life_s, partial(_fades, fading)))
        if outages is not None:
            parts.append(_levels(scenario, "outages", outages.life_s, partial(_outages, outages.share)))
        return cls(tuple(parts)) if parts else None

    def at_db(self, places: tuple[Ints, Ints], time_s: Floats) -> Floats:
        """Return the change of power between tags with indices (n,) at true times (n,), in dB."""
        total = np.asarray(sum(level[redraws.at(places, time_s)] for redraws, level in self.parts))
        return np.where(places[0] != places[1], total, 0.0)


def _levels(
    scenario: Scenario, purpose: str, life_s: float, levels: Callable[[np.random.Generator, int], Floats]
) -> tuple[Redraws, Floats]:
    return Redraws.of(scenario, purpose, lambda ids, draw: life_s, lambda ids, draw, n: levels(draw("levels"), n))


def _outages(share: float, rng: np.random.Generator, count: int) -> Floats:
    return np.where(rng.random(count) < share, -80.0, 0.0)  # -80 dB is below any sensitivity


def _fades(fading: Fading, rng: np.random.Generator, count: int) -> Floats:
    if not fading.levels_db:
        return fading.std_db * rng.standard_normal(count)
    return np.interp(rng.random(count), np.linspace(0, 1, len(fading.levels_db)), fading.levels_db)


@dataclass(frozen=True, slots=True, kw_only=True)
class FirstPaths:
    """The first paths of n links: whether they are reflections, and their properties, (n,) each.

    `excess_m` is the excess length of the first path; `first_loss_db` its loss relative to the direct path, and
    `rise_s` the delay of the strongest path after it, both zero for direct paths.
    """

    reflected: Bools
    excess_m: Floats
    first_loss_db: Floats
    rise_s: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class ReflectedStates:
    """Lasting reflections: the states of all pairs, rows in the order of the fields of `FirstPaths`, (4, states)."""

    redraws: Redraws
    states: Floats

    @classmethod
    def of(cls, scenario: Scenario) -> Self | None:
        """Draw the first paths of all pairs over a run; None for a scenario without two-state multipath."""
        model = scenario.radio.multipath
        if not isinstance(model, TwoStateMultipath):
            return None

        def life(ids: list[int], draw: Draw) -> float:
            return share_and_life(model, ids, draw("pair"))[1]

        def states(ids: list[int], draw: Draw, count: int) -> Floats:
            share, _ = share_and_life(model, ids, draw("pair"))
            means_m = [pair.mean_excess_m for pair in model.pairs if set(pair.tags) == set(ids) and pair.mean_excess_m]
            mean_m = means_m[0] if means_m else model.mean_excess_m
            reflected = draw("state").random(count) < share
            excess = draw("excess").gamma(model.excess_shape, mean_m / model.excess_shape, count)
            about = draw("direct").normal(0, 1, count) * model.direct_std_m
            loss_db = draw("loss").normal(model.first_path_loss_db, model.loss_std_db, count)
            rise_s = draw("rise").exponential((model.rise_ns * 1e-9), count)
            longer = np.where(reflected, excess, about)
            return np.array([reflected, longer, np.maximum(loss_db, model.total_loss_db), rise_s])

        redraws, drawn = Redraws.of(scenario, "reflected states", life, states)
        return cls(redraws=redraws, states=drawn)

    def at(self, places: tuple[Ints, Ints], time_s: Floats) -> FirstPaths:
        """Return the first paths between tags with indices (n,) at true times (n,); a tag has none to itself."""
        reflected, excess_m, loss_db, rise_s = self.states[:, self.redraws.at(places, time_s)]
        others = places[0] != places[1]
        late = (reflected > 0) & others
        return FirstPaths(
            reflected=late,
            excess_m=np.where(others, excess_m, 0.0),
            first_loss_db=np.where(late, loss_db, 0.0),
            rise_s=np.where(late, rise_s, 0.0),
        )


def share_and_life(model: TwoStateMultipath, ids: list[int], rng: np.random.Generator) -> tuple[float, float]:
    """Return a pair's share of reflections and their life in seconds: from the scenario, or else drawn."""
    share = model.share
    if model.share_std:
        # The beta distribution with the model's mean and standard deviation.
        total = model.share * (1 - model.share) / model.share_std**2 - 1
        share = rng.beta(model.share * total, (1 - model.share) * total)
    life_s = model.life_s * float(np.exp(model.life_spread * rng.normal()))
    for known in model.pairs:
        if set(known.tags) == set(ids):
            share = known.share if known.share is not None else share
            life_s = known.life_s if known.life_s is not None else life_s
    return float(share), life_s
