"""Plans of boards that stand still: which arrangements to make with what one has, and what comes of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Final

import numpy as np

from calib.errors import BadInputError
from calib.information import Unknown, Verdict, judge
from calib.planning.candidates import Layout
from calib.planning.choosing import Choice, best_tape, choose, mean_std
from calib.planning.having import Having, having
from calib.planning.procedure import named, steps, where
from calib.planning.promise import Promise, promises
from calib.planning.result import Halves, NextBest, Plan
from calib.spread import TWO_SIDED_95
from calib.surveys.network import DIMENSIONS
from calib.surveys.scales import DELAY_SCALE_NS, M_PER_NS, widened
from uwblink.arrays import Floats

RANGES_A_PAIR: Final = 20
"""Noise of 4 cm leaves 9 mm in a mean of so many, which adds a tenth to a pair's constant error of 2 cm."""

FEWEST_S: Final = 30.0
NAMES: Final = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"


def plan(  # noqa: PLR0913 - what somebody may have, each with its default
    boards: int | Sequence[int],
    *,
    on: str = "line",
    arrangements: int | None = None,
    size_m: Sequence[float] | None = None,
    taped: int = 0,
    tape_sigma_m: float = 0.005,
    anchors: Sequence[int] = (),
    anchor_sigma_m: float = 0.01,
    pair_error_m: float = 0.02,
    reflected: float = 0.0,
    rate_hz: float = 50.0,
    seed: int = 1,
) -> Plan:
    """Return how to calibrate boards without true distances: which arrangements to make, and what comes of them.

    `boards` is how many there are, or their ids; `on` is "line" (a string), "plane" (a table) or "space" (a room), of
    `size_m` (up to three lengths). `taped` distances will be measured, to `tape_sigma_m`; `anchors` are boards that
    stay where they are, at places known to `anchor_sigma_m`. Each of `arrangements` (by default as many as are worth
    it, at most 12) is the best of sixty random ones after those before it. `pair_error_m` is the constant error that a
    pair has in an arrangement, and `reflected` the share of pairs that are reflected and say nothing: what is promised
    is then the mean over which pairs those are. Raises `BadInputError` for what cannot be.

    >>> import calib
    >>> calib.plan(3, on="line", arrangements=1).undetermined
    (1, 3)
    """
    given = having(boards, on, size_m, taped, tape_sigma_m, anchors, anchor_sigma_m, pair_error_m, seed, reflected)
    if arrangements is not None and not 1 <= arrangements <= len(NAMES):
        raise BadInputError(f"found {arrangements}, expected 1 to {len(NAMES)}", parameter="arrangements")
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        raise BadInputError(f"found {rate_hz}, expected more than 0", parameter="rate_hz")
    return _promised(choose(given, arrangements), rate_hz)


def _promised(choice: Choice, rate_hz: float) -> Plan:
    given, total = choice.given, choice.total
    verdict = _verdict(total, given.tags)
    wide = _wide(given, choice.chosen)
    said = promises(given, choice.chosen)
    curved = promises(given, choice.chosen, curve=True)[-1]
    after = tuple(_halves(given, choice.chosen[:count], one.each) for count, one in enumerate(said, start=1))
    made = tuple(named(NAMES[k], layout, given.tags) for k, layout in enumerate(choice.chosen))
    pairs = len(list(combinations(given.tags, 2)))
    seconds = max(FEWEST_S, math.ceil(RANGES_A_PAIR * pairs / rate_hz / 10) * 10.0)
    return Plan(
        on=given.on,
        tags=given.tags,
        arrangements=made,
        half_ns=after[-1],
        after_ns=after,
        common_ns=wide * said[-1].common,
        with_curve_ns=_halved(curved, wide),
        verdict=verdict,
        next_best=tuple(_next_best(choice, total, wide)),
        rate_hz=rate_hz,
        seconds_each=seconds,
        pair_error_m=given.pair_error_m,
        reflected=given.reflected,
        known_beside=bool(given.anchors) or given.taped > 0,
        steps=tuple(steps(given, made, seconds)),
    )


def _verdict(total: Floats, tags: tuple[int, ...]) -> Verdict:
    return judge(total * M_PER_NS**2, [Unknown("delay", str(tag), DELAY_SCALE_NS) for tag in tags])


def _wide(given: Having, chosen: list[Layout]) -> float:
    """Return the factor of a standard deviation that makes half an interval of 95 %."""
    return TWO_SIDED_95 * widened(_freedom(given, chosen))


def _halves(given: Having, chosen: list[Layout], std_ns: Floats) -> dict[int, float]:
    """Return the half interval of each delay (ns) from standard deviations by so many arrangements."""
    wide = _wide(given, chosen)
    return {tag: wide * float(s) for tag, s in zip(given.tags, std_ns, strict=True)}


def _halved(promise: Promise, wide: float) -> Halves:
    each, apart = (wide * float(np.sqrt(np.mean(std**2))) for std in (promise.each, promise.apart))
    return Halves(each, apart, wide * promise.common)


def _freedom(given: Having, chosen: list[Layout]) -> float:
    """Return the degrees of freedom that will be left to tell the errors of pairs."""
    boards, dimensions = len(given.tags), DIMENSIONS[given.on]
    motions = 0 if given.anchors else {1: 1, 2: 3, 3: 6}[dimensions]
    rows = boards * (boards - 1) // 2
    unknown = boards * dimensions - motions
    left = sum(rows + len(c.taped) + len(given.anchors) * dimensions - min(unknown, rows) for c in chosen)
    return max(left - boards, 0.0)


def _next_best(choice: Choice, total: Floats, wide: float) -> list[NextBest]:
    """Return the next arrangement and the next taped distance, the one that brings more first."""

    def mean_ns(information: Floats) -> float:
        return wide * mean_std(information) / M_PER_NS

    now, k = mean_ns(total), choice.best_next()
    more = named(NAMES[min(len(choice.chosen), len(NAMES) - 1)], choice.candidates[k], choice.given.tags)
    found = [
        NextBest(f"an arrangement {where(choice.given.on, more)}", mean_ns(total + choice.informations[k]), now),
        *_next_tape(choice, total, mean_ns),
    ]
    return sorted((one for one in found if one.mean_ns < now), key=lambda one: one.mean_ns)


def _next_tape(choice: Choice, total: Floats, mean_ns: Callable[[Floats], float]) -> Iterator[NextBest]:
    given = choice.given
    best = best_tape(given, choice.chosen)
    if best is None:
        return
    n, pair = best
    layout = choice.chosen[n]
    after = given.information(replace(layout, taped=(*layout.taped, pair)))
    i, j = given.tags[pair[0]], given.tags[pair[1]]
    what = f"the distance of {i} and {j} in {NAMES[n]} by tape"
    yield NextBest(what, mean_ns(total - given.information(layout) + after), mean_ns(total))
