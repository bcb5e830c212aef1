"""Plans of surveys: which arrangements of boards to record, and the expected accuracy of the delays.

The expected accuracy is Fisher's information of the rows of a survey, without data; positions are unknown. If pairs are
reflected, the reflected pairs are drawn at random and the prediction is the root mean square over the draws, because a
reflected pair has hardly any information on the delays. A curve over power has the prior of a survey, with a standard
deviation of 5 cm; powers fall with distance as in free space.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations
from string import ascii_uppercase
from typing import Any

import numpy as np

from calib.calibration.power_curves import ALPHA_DBM
from calib.errors import BadInputError, UnanswerableError
from calib.information import reduced
from calib.planning.result import NextBest, Plan, PlannedArrangement, Precision, mean_std_ns
from calib.planning.settings import ROOMS_M, SurveyPlanSettings
from calib.settings import is_tag
from calib.spread import TWO_SIDED_95
from calib.surveys.knowledge import KnownPosition
from calib.surveys.network import Boards, Case, CurvePrior, Linear, Network
from calib.surveys.outcome import interval_factor, verdict_on_delays
from calib.surveys.recordings import PairMeans
from uwblink.arrays import Bools, Floats
from uwblink.recording.schema import KnownDistance

PLANNED_CURVE_STD_M = 0.05
"""Standard deviation of a curve over power: half that of the published curves (`CURVE_LENGTH_DB`). With the whole
standard deviation, plans of six boards in five arrangements would predict no delay beside a curve, but surveys find the
delays (`make surveys`)."""

POWER_AT_1_M_DBM = -74.0
"""First-path power at one metre: the upper quartile of power times squared distance in the MILUV flight among
obstacles, whose median is -77 dBm."""


def random_arrangements(inputs: SurveyPlanSettings, count: int) -> list[PlannedArrangement]:
    """Return random arrangements: orders on a line with equal distances, random positions on a table or in a room.

    There are fewer than `count` if a line has fewer orders, or a room has too little space. Anchors have the positions
    of the first arrangement in all others.
    """
    rng, tags, dimensions = np.random.default_rng(inputs.seed), inputs.tags, inputs.dimensions
    size = np.array(ROOMS_M[inputs.on] if inputs.size_m is None else inputs.size_m, dtype=float)
    if inputs.on == "line" and inputs.size_m is None:
        size = np.maximum(size, 0.8 * (len(tags) - 1))
    found: dict[tuple[int, ...] | int, PlannedArrangement] = {}
    for number in range(400):
        if len(found) == count:
            break
        key: tuple[int, ...] | int = number
        place = np.zeros((len(tags), 3))
        if inputs.on == "line":
            order = tuple(rng.permutation(len(tags)).tolist())
            # A line may be read from either end.
            key = min(order, order[::-1])
            place[list(order), 0] = np.round(np.linspace(0, float(size[0]), len(tags)), 1)
        else:
            place[:, :dimensions] = np.round(rng.uniform(0, size, (len(tags), dimensions)), 1)
            # Five wavelengths: at shorter distances powers saturate, and the far field does not begin.
            if min(np.linalg.norm(one - other) for one, other in combinations(place, 2)) < 0.4:
                continue
        spots = {tag: (x, y, z) for tag, (x, y, z) in zip(tags, place.tolist(), strict=True)}
        first = next(iter(found.values())).place_m if found else spots
        found.setdefault(key, PlannedArrangement("", spots | {tag: first[tag] for tag in inputs.anchors}, ()))
    return list(found.values())


def delay_information(
    inputs: SurveyPlanSettings,
    one: PlannedArrangement,
    curve: CurvePrior | None = None,
    reflected: Bools | Sequence[float] = (0.0,),
) -> Floats:
    """Return the information of an arrangement with unknown positions on delays, 1/ns^2, and on a curve.

    Its shape is (draws, k, k); `reflected` has a mask of the reflected pairs for each draw.
    """
    # A network has its tags in ascending order, but a plan in the given order: boards are numbered.
    boards, number = tuple(range(len(inputs.tags))), inputs.tags.index
    pairs = np.array(list(combinations(boards, 2)))
    none = np.zeros(len(pairs))
    means = PairMeans(
        arrangement=none.astype(int),
        ends=pairs,
        weights=np.full((len(pairs), 2), 0.5),
        range_m=none,
        std_m=none,
        noise_m=none,
        count=none.astype(int),
        lifted=none,
    )
    network = Network(
        means=means,
        arrangements=(Boards("", inputs.dimensions, boards),),
        tags=boards,
        distances=tuple(KnownDistance(number(i), number(j), 1.0, inputs.tape_sigma_m) for i, j in one.taped),
        positions=tuple(KnownPosition(number(tag), one.place_m[tag], inputs.anchor_sigma_m) for tag in inputs.anchors),
        fixed_ns={},
        curve=curve,
    )
    x, free = (
        network.with_positions(network.layout.start(), np.array(list(one.place_m.values()))),
        network.layout.free(),
    )
    cases = [Case(none + marks > 0, inputs.pair_error_m, PLANNED_CURVE_STD_M) for marks in reflected]
    return np.array(
        [reduced(Linear(network, x, case).known[np.ix_(free, free)], free >= 3 * len(boards)) for case in cases]
    )


def predict(
    inputs: SurveyPlanSettings, arrangements: Sequence[PlannedArrangement], *, curve: bool = False
) -> list[Precision[Floats]]:
    """Return the predicted standard deviations after the first of the arrangements, the first two, and so on."""
    places = np.array([list(one.place_m.values()) for one in arrangements])
    first, second = np.array(list(combinations(range(len(inputs.tags)), 2))).T
    powers = POWER_AT_1_M_DBM - 20 * np.log10(np.linalg.norm(places[:, first] - places[:, second], axis=2))
    prior = CurvePrior.at(10 ** ((powers.ravel() - ALPHA_DBM) / 10)) if curve else None
    own, parts = None, []
    for k, one in enumerate(arrangements):
        if prior is not None:
            # The prior counts once, below.
            design = prior.design.reshape(*powers.shape, -1)[k]
            own = replace(prior, design=design, precision=np.zeros_like(prior.precision))
        # The root mean square over a hundred draws of the reflected pairs has an error of a few per cent.
        shape = (100 if inputs.reflected else 1, len(first))
        drawn = np.random.default_rng([inputs.seed, k]).uniform(size=shape) < inputs.reflected
        parts.append(delay_information(inputs, one, own, drawn))
    totals, delays = np.cumsum(parts, axis=0), np.arange(parts[0].shape[-1]) < len(inputs.tags)
    if prior is not None:
        totals[..., len(inputs.tags) :, len(inputs.tags) :] += prior.precision / PLANNED_CURVE_STD_M**2
    return [_averaged(np.array([reduced(one, delays) for one in draws]), inputs.tags) for draws in totals]


def _averaged(informations: Floats, tags: Sequence[int]) -> Precision[Floats]:
    """Return root mean squares over the draws (k, tags, tags) that determine a value; infinite if most do not."""
    verdicts = [verdict_on_delays(one, tags) for one in informations]
    covariance = np.array([one.covariance for one in verdicts])
    centre = np.eye(len(tags)) - 1 / len(tags)
    apart = np.diagonal(centre @ covariance @ centre, axis1=1, axis2=2)
    common = covariance.mean(axis=(1, 2))[:, None]
    variances = np.hstack([np.array([one.std for one in verdicts]) ** 2, apart, common])
    good = np.isfinite(variances)
    mean = np.where(good, variances, 0.0).sum(axis=0) / np.maximum(good.sum(axis=0), 1)
    std = np.where(good.mean(axis=0) > 0.5, np.sqrt(mean), math.inf)
    return Precision(std[: len(tags)], std[len(tags) : -1], float(std[-1]))


def plan(boards: int | Sequence[int], settings: SurveyPlanSettings | None = None, **changes: Any) -> Plan:
    """Plan a calibration of boards without true distances: arrangements, and the expected accuracy of the delays.

    `boards` is the number of boards, or their ids. `settings` and keyword arguments named like its fields
    (`SurveyPlanSettings`, which explains them) state the equipment. Each arrangement is the best of sixty random ones,
    given those before it. If pairs are reflected, predictions are means over random choices of the reflected pairs.
    Raises `BadInputError` for boards or settings that are impossible.

    >>> import calib
    >>> calib.plan(3, on="line", arrangements=1).undetermined
    (1, 3)
    """
    tags = tuple(range(1, boards + 1) if isinstance(boards, int) else boards if isinstance(boards, Iterable) else ())
    if len(tags) < 2 or not all(map(is_tag, tags)):
        raise BadInputError(f"found {boards!r:.60}, expected 2 to 30 ids below 65536, or a count", parameter="boards")
    inputs = replace(settings or SurveyPlanSettings(), tags=tags, **changes)
    # The best of sixty is in the best 5 % with a probability of 95 %.
    candidates = random_arrangements(inputs, 60)
    if not candidates:
        raise UnanswerableError(f"there is no room for {len(tags)} boards, which must stand 0.4 m from each other")
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
        more.append((f"a measured distance of {i} and {j} in {best[1].name}", best[0]))
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
        # In a mean of 20 ranges noise of 4 cm leaves 9 mm, which adds a tenth to a pair's constant error of 2 cm.
        seconds_each=max(30.0, math.ceil(20 * math.comb(len(tags), 2) / inputs.rate_hz / 10) * 10.0),
        pair_error_m=inputs.pair_error_m,
        reflected=inputs.reflected,
        known_beside=bool(inputs.anchors or inputs.taped),
    )


def _choose(informations: list[Floats], count: int | None) -> list[int]:
    """Return the numbers of `count` arrangements, or of as many as improve the accuracy; each is the best one given
    those before it.
    """
    total = np.zeros_like(informations[0])
    found: list[int] = []
    # Twelve arrangements take about an hour.
    while len(found) < (count or 12):
        # An arrangement that is repeated has the same errors of pairs, unless the boards were removed in between.
        left = [k for k in range(len(informations)) if k not in found] or list(range(len(informations)))
        best = min(left, key=lambda k: mean_std_ns(total + informations[k]))
        before, after = mean_std_ns(total), mean_std_ns(total + informations[best])
        # The mean interval falls with the root of their number, so the eighth arrangement still reduces it by 6 %.
        if count is None and len(found) >= 2 and after > 0.94 * before:
            break
        found.append(best)
        total = total + informations[best]
    return found


def _best_tape(
    inputs: SurveyPlanSettings, chosen: Sequence[PlannedArrangement]
) -> tuple[Floats, PlannedArrangement] | None:
    """Return the information of all arrangements with the best additional taped distance, and the arrangement with it;
    None without any.
    """
    found = []
    each = [delay_information(inputs, one)[0] for one in chosen]
    for one, own in zip(chosen, each, strict=True):
        for pair in combinations(inputs.tags, 2):
            if pair not in one.taped:
                taped = replace(one, taped=(*one.taped, pair))
                found.append((np.sum(each, axis=0) - own + delay_information(inputs, taped)[0], taped))
    return min(found, key=lambda one: mean_std_ns(one[0]), default=None)


def _interval(inputs: SurveyPlanSettings, chosen: Sequence[PlannedArrangement]) -> float:
    """Return half the length of a 95 % interval over the standard deviation, for the remaining degrees of freedom."""
    boards, dimensions = len(inputs.tags), inputs.dimensions
    motions = 0 if inputs.anchors else math.comb(dimensions + 1, 2)
    rows, unknown = math.comb(boards, 2), boards * dimensions - motions
    known = len(inputs.anchors) * dimensions
    left = sum(rows + len(one.taped) + known - min(unknown, rows) for one in chosen)
    return TWO_SIDED_95 * interval_factor(max(left - boards, 0.0))
