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
from calib.planning.predicted import (
    Layout,
    Prediction,
    delay_information,
    predict,
    random_layouts,
)
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
    known = "" if inputs.on == "space" else inputs.on
    candidates = random_layouts(inputs, CANDIDATES)
    if not candidates:
        raise UnanswerableError(f"{len(inputs.tags)} boards find no room: they must stand 0.4 m from each other")
    informations = [delay_information(inputs, layout) for layout in candidates]
    chosen = [candidates[k] for k in _choose(informations, inputs.arrangements)]
    for _ in range(inputs.taped):
        best = _best_tape(inputs, chosen)
        if best is not None:
            chosen[best[0]] = best[1]
    made = tuple(_named(ascii_uppercase[k], layout, inputs.tags) for k, layout in enumerate(chosen))
    seconds = max(30.0, math.ceil(RANGES_A_PAIR * math.comb(len(inputs.tags), 2) / inputs.rate_hz / 10) * 10.0)
    predictions = predict(inputs, chosen)
    after = [
        dict(zip(inputs.tags, (_interval(inputs, chosen[: k + 1]) * one.each).tolist(), strict=True))
        for k, one in enumerate(predictions)
    ]
    wide, total = _interval(inputs, chosen), _total(inputs, chosen)
    return Plan(
        on=known,
        tags=inputs.tags,
        arrangements=made,
        half_ns=after[-1],
        after_ns=tuple(after),
        common_ns=wide * predictions[-1].common,
        with_curve_ns=_halves(predict(inputs, chosen, curve=True)[-1], wide),
        verdict=verdict_on_delays(total, inputs.tags),
        next_best=tuple(_next_best(inputs, candidates, informations, chosen, wide, total)),
        rate_hz=inputs.rate_hz,
        seconds_each=seconds,
        pair_error_m=inputs.pair_error_m,
        reflected=inputs.reflected,
        known_beside=bool(inputs.anchors or inputs.taped),
        steps=tuple(_steps(inputs, made, seconds)),
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


def _best_tape(inputs: SurveyPlanSettings, chosen: list[Layout]) -> tuple[int, Layout, tuple[int, int], Floats] | None:
    """Return which arrangement is best taped, that with its tape, between whom, and what all then say, if any."""
    each = [delay_information(inputs, layout) for layout in chosen]
    total = np.sum(each, axis=0)
    best: tuple[float, int, Layout, tuple[int, int], Floats] | None = None
    for k, layout in enumerate(chosen):
        for pair in combinations(range(len(inputs.tags)), 2):
            if pair in layout.taped:
                continue
            taped = replace(layout, taped=(*layout.taped, pair))
            after = total - each[k] + delay_information(inputs, taped)
            if best is None or mean_std_ns(after) < best[0]:
                best = mean_std_ns(after), k, taped, pair, after
    return None if best is None else best[1:]


def _total(inputs: SurveyPlanSettings, chosen: Sequence[Layout]) -> Floats:
    return np.asarray(np.sum([delay_information(inputs, layout) for layout in chosen], axis=0))


def _interval(inputs: SurveyPlanSettings, chosen: Sequence[Layout]) -> float:
    """Return the factor of a standard deviation that makes half an interval of 95 %, by the freedoms that are left."""
    boards, dimensions = len(inputs.tags), inputs.dimensions
    motions = 0 if inputs.anchors else math.comb(dimensions + 1, 2)
    rows, unknown = math.comb(boards, 2), boards * dimensions - motions
    known = len(inputs.anchors) * dimensions
    left = sum(rows + len(layout.taped) + known - min(unknown, rows) for layout in chosen)
    return TWO_SIDED_95 * students_factor(max(left - boards, 0.0))


def _halves(prediction: Prediction, wide: float) -> Halves:
    each, apart = (wide * float(np.sqrt(np.mean(std**2))) for std in (prediction.each, prediction.apart))
    return Halves(each, apart, wide * prediction.common)


def _next_best(
    inputs: SurveyPlanSettings,
    candidates: list[Layout],
    informations: list[Floats],
    chosen: list[Layout],
    wide: float,
    total: Floats,
) -> list[NextBest]:
    """Return the next arrangement and the next taped distance, the one that brings more first.

    `wide` is the factor of intervals, `total` the information of the chosen arrangements.
    """
    now = wide * mean_std_ns(total)
    k = min(range(len(candidates)), key=lambda k: mean_std_ns(total + informations[k]))
    more = _named(ascii_uppercase[min(len(chosen), len(ascii_uppercase) - 1)], candidates[k], inputs.tags)
    found = [NextBest(f"an arrangement {more.where(inputs.on)}", wide * mean_std_ns(total + informations[k]), now)]
    best = _best_tape(inputs, chosen)
    if best is not None:
        number, _, (i, j), after = best
        what = f"the distance of {inputs.tags[i]} and {inputs.tags[j]} in {ascii_uppercase[number]} by tape"
        found.append(NextBest(what, wide * mean_std_ns(after), now))
    return sorted((one for one in found if one.mean_ns < now), key=lambda one: one.mean_ns)


def _named(name: str, layout: Layout, tags: tuple[int, ...]) -> PlannedArrangement:
    """Return an arrangement under a name, with boards by their ids."""
    place = {tag: (float(p[0]), float(p[1]), float(p[2])) for tag, p in zip(tags, layout.place_m, strict=True)}
    return PlannedArrangement(name, place, tuple((tags[i], tags[j]) for i, j in layout.taped))


def _steps(inputs: SurveyPlanSettings, made: tuple[PlannedArrangement, ...], seconds: float) -> list[str]:
    """Return what to do, a line each, pictures between."""
    held = {
        "line": "Stretch a string and keep it straight",
        "plane": "Take a flat table or floor",
        "space": "Use the room",
    }
    lines = [f"1. {held[inputs.on]}. Places are guides: nothing but what is taped is measured, orders matter."]
    for k, one in enumerate(made, start=2):
        lines.append(f"{k}. Arrangement {one.name}: boards {one.where(inputs.on)}.")
        lines += _picture(inputs.on, one)
        for i, j in one.taped:
            lines.append(f"   Tape the distance of {i} and {j}, antenna to antenna.")
        lines.append(f"   Record all pairs as arrangement {one.name} for {seconds:.0f} s.")
    shape = f", known to be on a {inputs.on}" if inputs.on != "space" else ""
    lines.append(f"{len(made) + 2}. Survey all recordings together{shape}.")
    if inputs.taped or inputs.anchors:
        lines.append("   A file says what is known beside: the taped distances, the anchors' places.")
    return lines


def _picture(on: str, one: PlannedArrangement, width: int = 56, height: int = 9) -> list[str]:
    """Return the arrangement drawn with letters, seen from above: a line of text for a line, a box for others."""
    place = np.array(list(one.place_m.values()))[:, :2]
    rows = 1 if on == "line" else height
    share = (place - place.min(axis=0)) / np.maximum(np.ptp(place, axis=0), 1e-6)
    cells = [["-" if on == "line" else " "] * width for _ in range(rows)]
    for tag, (x, y) in zip(one.place_m, share.tolist(), strict=True):
        column, row = round(x * (width - 3)), rows - 1 - round(y * (rows - 1))
        for k, letter in enumerate(str(tag)):
            cells[row][min(column + k, width - 1)] = letter
    return ["     " + "".join(line).rstrip() for line in cells]
