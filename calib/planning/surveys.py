"""Plans of boards that stand still: which arrangements to make with what one has, and what comes of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from string import ascii_uppercase
from typing import Any

import numpy as np

from calib.errors import BadInputError, UnanswerableError
from calib.planning.predicted import Layout, delay_information, predict, random_layouts
from calib.planning.result import Halves, NextBest, Plan, PlannedArrangement, mean_std_ns
from calib.planning.settings import SurveyPlanSettings
from calib.spread import TWO_SIDED_95
from calib.surveys.outcome import students_factor, verdict_on_delays
from uwblink.arrays import Floats

RANGES_A_PAIR = 20
"""Noise of 4 cm leaves 9 mm in a mean of so many, which adds a tenth to a pair's constant error of 2 cm."""

CANDIDATES = 60
"""Random arrangements from which each is chosen."""

MOST_ARRANGEMENTS = 12
"""Arrangements after which no more is planned where no number is given: an hour's work."""

WORTH_IT = 0.06
"""Share by which one arrangement more must narrow the mean interval to be planned, where no number is given."""


def plan(boards: int | Sequence[int], settings: SurveyPlanSettings | None = None, **changes: Any) -> Plan:
    """Return how to calibrate boards without true distances: which arrangements to make, and what comes of them.

    `boards` is how many there are, or their ids. `settings` and keyword arguments named like its fields
    (`SurveyPlanSettings`, which explains them) say what one has. Each of the arrangements is the best of sixty random
    ones after those before it. Where pairs are reflected, what is promised is the mean over which pairs those are.
    Raises `BadInputError` for what cannot be.

    >>> import calib
    >>> calib.plan(3, on="line", arrangements=1).undetermined
    (1, 3)
    """
    tags = tuple(range(1, boards + 1)) if isinstance(boards, int) else tuple(int(tag) for tag in boards)
    if len(tags) < 2:
        raise BadInputError(f"found {boards!r:.60}, expected 2 to 30 boards, each once", parameter="boards")
    inputs = replace(settings or SurveyPlanSettings(), tags=tags, **changes)
    candidates = random_layouts(inputs, CANDIDATES)
    if not candidates:
        raise UnanswerableError(f"{len(tags)} boards find no room: they must stand 0.4 m from each other")
    informations = [delay_information(inputs, layout) for layout in candidates]
    chosen = [candidates[k] for k in _choose(informations, inputs.arrangements)]
    for _ in range(inputs.taped):
        chosen, _ = min(_taped(inputs, chosen), key=_mean_of_second, default=(chosen, None))
    names = [*ascii_uppercase, ascii_uppercase[-1]]
    total = np.sum([delay_information(inputs, layout) for layout in chosen], axis=0)
    wide, predictions = _interval(inputs, chosen), predict(inputs, chosen)
    curved = predict(inputs, chosen, curve=True)[-1]
    each, apart = (wide * float(np.sqrt(np.mean(std**2))) for std in (curved.each, curved.apart))
    now = wide * mean_std_ns(total)
    k = min(range(len(candidates)), key=lambda k: mean_std_ns(total + informations[k]))
    where = _named(names[len(chosen)], candidates[k], tags).where(inputs.on)
    more = [(f"an arrangement {where}", total + informations[k])]
    for after, information in sorted(_taped(inputs, chosen), key=_mean_of_second)[:1]:
        number = next(n for n, (old, new) in enumerate(zip(chosen, after, strict=True)) if old is not new)
        i, j = after[number].taped[-1]
        more.append((f"the distance of {tags[i]} and {tags[j]} in {names[number]} by tape", information))
    next_best = [NextBest(what, wide * mean_std_ns(information), now) for what, information in more]
    after_ns = [
        dict(zip(tags, (_interval(inputs, chosen[: n + 1]) * one.each).tolist(), strict=True))
        for n, one in enumerate(predictions)
    ]
    return Plan(
        on="" if inputs.on == "space" else inputs.on,
        tags=tags,
        arrangements=tuple(_named(name, layout, tags) for name, layout in zip(names, chosen, strict=False)),
        half_ns=after_ns[-1],
        after_ns=tuple(after_ns),
        common_ns=wide * predictions[-1].common,
        with_curve_ns=Halves(each, apart, wide * curved.common),
        verdict=verdict_on_delays(total, tags),
        next_best=tuple(sorted((one for one in next_best if one.mean_ns < now), key=lambda one: one.mean_ns)),
        rate_hz=inputs.rate_hz,
        seconds_each=max(30.0, math.ceil(RANGES_A_PAIR * math.comb(len(tags), 2) / inputs.rate_hz / 10) * 10.0),
        pair_error_m=inputs.pair_error_m,
        reflected=inputs.reflected,
        known_beside=bool(inputs.anchors or inputs.taped),
    )


def _choose(informations: list[Floats], count: int | None) -> list[int]:
    """Return `count` arrangements, or as many as are worth it: each the best after those before it."""
    total = np.zeros_like(informations[0])
    found: list[int] = []
    while len(found) < (count or MOST_ARRANGEMENTS):
        # The same once more would have the same errors, unless boards were taken away in between.
        left = [k for k in range(len(informations)) if k not in found] or list(range(len(informations)))
        best = min(left, key=lambda k: mean_std_ns(total + informations[k]))
        before, after = mean_std_ns(total), mean_std_ns(total + informations[best])
        if count is None and len(found) >= 2 and after > (1 - WORTH_IT) * before:
            break
        found.append(best)
        total = total + informations[best]
    return found


def _taped(inputs: SurveyPlanSettings, chosen: list[Layout]) -> Iterator[tuple[list[Layout], Floats]]:
    """Yield the arrangements with each further distance that may be taped, and what all then say."""
    each = [delay_information(inputs, layout) for layout in chosen]
    total = np.sum(each, axis=0)
    for k, layout in enumerate(chosen):
        for pair in set(combinations(range(len(inputs.tags)), 2)) - set(layout.taped):
            taped = replace(layout, taped=(*layout.taped, pair))
            yield [*chosen[:k], taped, *chosen[k + 1 :]], total - each[k] + delay_information(inputs, taped)


def _mean_of_second(one: tuple[list[Layout], Floats]) -> float:
    return mean_std_ns(one[1])


def _interval(inputs: SurveyPlanSettings, chosen: Sequence[Layout]) -> float:
    """Return the factor of a standard deviation that makes half an interval of 95 %, by the freedoms that are left."""
    boards, dimensions = len(inputs.tags), inputs.dimensions
    motions = 0 if inputs.anchors else math.comb(dimensions + 1, 2)
    rows, unknown = math.comb(boards, 2), boards * dimensions - motions
    known = len(inputs.anchors) * dimensions
    left = sum(rows + len(layout.taped) + known - min(unknown, rows) for layout in chosen)
    return TWO_SIDED_95 * students_factor(max(left - boards, 0.0))


def _named(name: str, layout: Layout, tags: tuple[int, ...]) -> PlannedArrangement:
    """Return an arrangement under a name, with boards by their ids."""
    place = {tag: tuple(p.tolist()) for tag, p in zip(tags, layout.place_m, strict=True)}
    return PlannedArrangement(name, place, tuple((tags[i], tags[j]) for i, j in layout.taped))
