"""Fading and outages of pairs of tags (`radio.fading`, `radio.outages`): what they add to powers at an instant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import Final, Self

import numpy as np

from uwblink.arrays import Floats, Ints
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.multipath import Fading

MARGIN_S: Final = 60.0
"""So long after the end of a run links are still asked for at most; later on the last level lasts."""

OUT_DB: Final = -80.0
"""What an outage adds: nothing is heard."""

Levels = Callable[[np.random.Generator, int], Floats]
"""Draws so many levels in dB."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Redrawn:
    """Levels of all pairs that are drawn anew at random instants, one pair after the other, each in order of time.

    `begin` has their beginnings in seconds, moved by `span_s` for each pair before; `pair` gives the pair of two tags
    by their places, (tags, tags).
    """

    pair: Ints
    span_s: float
    begin: Floats
    level_db: Floats

    @classmethod
    def of(cls, scenario: Scenario, purpose: str, life_s: float, levels: Levels) -> Self:
        """Draw from streams named after the purpose and the two tags."""
        count, span = len(scenario.tags), scenario.run.duration_s + MARGIN_S
        pair, begins, drawn = np.zeros((count, count), dtype=np.int64), [], []
        for number, (a, b) in enumerate(combinations(range(count), 2)):
            pair[a, b] = pair[b, a] = number
            ids = sorted((scenario.tags[a].id, scenario.tags[b].id))
            draw = partial(stream, scenario.run.seed, purpose, *ids)
            begin = _instants(draw("instants"), life_s, span)
            begins.append(begin + number * span)
            drawn.append(levels(draw("levels"), len(begin)))
        return cls(pair=pair, span_s=span, begin=np.concatenate(begins), level_db=np.concatenate(drawn))

    def at_db(self, places: tuple[Ints, Ints], time_s: Floats) -> Floats:
        """Return the levels between tags at places (n,) at true times (n,); the same in both directions."""
        inside = np.clip(time_s, 0, np.nextafter(self.span_s, 0))
        k = np.searchsorted(self.begin, self.pair[places] * self.span_s + inside, side="right") - 1
        return np.where(places[0] != places[1], self.level_db[k], 0.0)


@dataclass(frozen=True, slots=True)
class PairLevels:
    """Everything of a scenario that comes and goes with pairs alone."""

    parts: tuple[Redrawn, ...]

    @classmethod
    def of(cls, scenario: Scenario) -> Self | None:
        """Draw fading and outages over a run; None where the scenario asks for neither."""
        fading, outages, parts = scenario.radio.fading, scenario.radio.outages, []
        if fading is not None:
            parts.append(Redrawn.of(scenario, "fading", fading.life_s, _fades(fading)))
        if outages is not None:
            share = outages.share
            out = Redrawn.of(
                scenario, "outages", outages.life_s, lambda rng, n: np.where(rng.random(n) < share, OUT_DB, 0.0)
            )
            parts.append(out)
        return cls(tuple(parts)) if parts else None

    def at_db(self, places: tuple[Ints, Ints], time_s: Floats) -> Floats:
        """Return what is added to powers between tags at places (n,) at true times (n,), in dB."""
        return np.asarray(sum(part.at_db(places, time_s) for part in self.parts))


def _fades(fading: Fading) -> Levels:
    if not fading.levels_db:
        return lambda rng, n: fading.std_db * rng.standard_normal(n)
    at = np.linspace(0, 1, len(fading.levels_db))
    return lambda rng, n: np.interp(rng.random(n), at, fading.levels_db)


def _instants(rng: np.random.Generator, life_s: float, span_s: float) -> Floats:
    """Return when levels are drawn anew, from zero on."""
    begin = np.zeros(1)
    while begin[-1] < span_s:
        more = rng.exponential(life_s, int((span_s - begin[-1]) / life_s * 1.1) + 8)
        begin = np.concatenate([begin, begin[-1] + np.cumsum(more)])
    return np.asarray(begin[begin < span_s])
