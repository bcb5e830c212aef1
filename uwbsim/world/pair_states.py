"""Random states of pairs of tags over time: fading, outages, and lasting reflections ("two-state" multipath).

A state is constant between random instants, at which it is drawn again, so its autocorrelation is exp(-dt/life). Each
property has a random stream named by its purpose and the two tags: a longer run continues a shorter one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import Self

import numpy as np

from uwblink.arrays import Floats, Ints
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.radio import TwoStateMultipath

Draw = Callable[[str], np.random.Generator]
"""Returns the random stream of a pair, or of a body, for a purpose."""


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
        return cls(pair=pair, span_s=span, begin=np.concatenate(begins), values=np.concatenate(drawn, axis=-1))

    def at(self, places: tuple[Ints, Ints], time_s: Floats) -> Floats:
        """Return the states (rows, n) between tags (n,) at true times (n,); zero between a tag and itself.

        They are the same in both directions.
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
    fading, outages, found = scenario.radio.fading, scenario.radio.outages, []
    if fading is not None:

        def fades(_ids: list[int], draw: Draw, count: int) -> Floats:
            rng = draw("levels")
            if not fading.levels_db:
                return fading.std_db * rng.standard_normal((1, count))
            return np.interp(rng.random((1, count)), np.linspace(0, 1, len(fading.levels_db)), fading.levels_db)

        found.append(PairStates.draw(scenario, "fading", lambda *_: fading.life_s, fades))
    if outages is not None:

        def silences(_ids: list[int], draw: Draw, count: int) -> Floats:
            return np.where(draw("levels").random((1, count)) < outages.share, -80.0, 0.0)  # below any sensitivity

        found.append(PairStates.draw(scenario, "outages", lambda *_: outages.life_s, silences))
    return found


def reflected_states(scenario: Scenario, model: TwoStateMultipath) -> PairStates:
    """Draw the first paths of all pairs over a run, (4, states).

    The rows are whether the first path is a reflection; its excess length in metres; and of reflections the loss in dB
    relative to the direct path, and the delay in seconds of the strongest path after it.
    """

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

    return PairStates.draw(scenario, "reflected states", life, states)


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
