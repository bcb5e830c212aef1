"""Plans of boards that stand still: which arrangements to make with what one has, and what comes of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from string import ascii_uppercase
from typing import Any

import numpy as np

from calib.errors import BadInputError, UnanswerableError
from calib.planning.predicted import delay_information, predict, random_arrangements
from calib.planning.result import NextBest, Plan, PlannedArrangement, Precision, mean_std_ns
from calib.planning.settings import SurveyPlanSettings
from calib.spread import TWO_SIDED_95
from calib.surveys.outcome import students_factor, verdict_on_delays
from uwblink.arrays import Floats

RANGES_A_PAIR = 20
"""Noise of 4 cm leaves 9 mm in a mean of so many, which adds a tenth to a pair's constant error of 2 cm."""

CANDIDATES = 60
"""Random arrangements from which each is chosen: the best of so many is in the best 5 % with a probability of 95 %."""

MOST_ARRANGEMENTS = 12
"""Arrangements after which no more is planned where no number is given: an hour's work."""

WORTH_IT = 0.06
"""Share by which one arrangement more must narrow the mean interval to be planned, where no number is given:
n arrangements narrow it by the root of n, so that about eight are planned."""


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
    candidates = random_arrangements(inputs, CANDIDATES)
    if not candidates:
        raise UnanswerableError(f"{len(tags)} boards find no room: they must stand 0.4 m from each other")
    informations = [delay_information(inputs, one)[0] for one in candidates]
    chosen = [candidates[k] for k in _choose(informations, inputs.arrangements)]
    chosen = [replace(one, name=name) for name, one in zip(ascii_uppercase, chosen, strict=False)]
    for _ in range(inputs.taped):
        best = _best_tape(inputs, chosen)
        if best is not None:
            chosen = [best[1] if one.name == best[1].name else one for one in chosen]
    total = np.sum([delay_information(inputs, one)[0] for one in chosen], axis=0)
    predictions, curved = predict(inputs, chosen), predict(inputs, chosen, curve=True)[-1]
    wide = [_interval(inputs, chosen[: k + 1]) for k in range(len(chosen))]
    after_ns = [
        dict(zip(tags, (factor * one.each).tolist(), strict=True))
        for factor, one in zip(wide, predictions, strict=True)
    ]
    k = min(range(len(candidates)), key=lambda k: mean_std_ns(total + informations[k]))
    more = [(f"an arrangement {candidates[k].where(inputs.on)}", total + informations[k])]
    best = _best_tape(inputs, chosen)
    if best is not None:
        i, j = best[1].taped[-1]
        more.append((f"the distance of {i} and {j} in {best[1].name} by tape", best[0]))
    now, *means = (wide[-1] * mean_std_ns(information) for information in (total, *(one[1] for one in more)))
    next_best = [NextBest(what, mean, now) for (what, _), mean in zip(more, means, strict=True) if mean < now]
    each, apart = (wide[-1] * float(np.sqrt(np.mean(std**2))) for std in (curved.each, curved.apart))
    return Plan(
        on="" if inputs.on == "space" else inputs.on,
        tags=tags,
        arrangements=tuple(chosen),
        half_ns=after_ns[-1],
        after_ns=tuple(after_ns),
        common_ns=wide[-1] * predictions[-1].common,
        with_curve_ns=Precision(each, apart, wide[-1] * curved.common),
        verdict=verdict_on_delays(total, tags),
        next_best=tuple(sorted(next_best, key=lambda one: one.mean_ns)),
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


def _best_tape(
    inputs: SurveyPlanSettings, chosen: Sequence[PlannedArrangement]
) -> tuple[Floats, PlannedArrangement] | None:
    """Return the arrangement with the further taped distance that brings most, and the information of all then."""
    found = []
    each = [delay_information(inputs, one)[0] for one in chosen]
    for one, own in zip(chosen, each, strict=True):
        for pair in combinations(inputs.tags, 2):
            if pair not in one.taped:
                taped = replace(one, taped=(*one.taped, pair))
                found.append((np.sum(each, axis=0) - own + delay_information(inputs, taped)[0], taped))
    return min(found, key=lambda one: mean_std_ns(one[0]), default=None)


def _interval(inputs: SurveyPlanSettings, chosen: Sequence[PlannedArrangement]) -> float:
    """Return the factor of a standard deviation that makes half an interval of 95 %, by the freedoms that are left."""
    boards, dimensions = len(inputs.tags), inputs.dimensions
    motions = 0 if inputs.anchors else math.comb(dimensions + 1, 2)
    rows, unknown = math.comb(boards, 2), boards * dimensions - motions
    known = len(inputs.anchors) * dimensions
    left = sum(rows + len(one.taped) + known - min(unknown, rows) for one in chosen)
    return TWO_SIDED_95 * students_factor(max(left - boards, 0.0))
