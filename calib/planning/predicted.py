"""What arrangements of boards would say of their delays: Fisher's information of a survey's own rows, without data.

Places are unknown. With reflections, which pairs are reflected is drawn, and what is promised is the root mean square
over the draws: a reflected pair says nothing of the delays. A curve over power is what a survey takes it for, a smooth
function of the power, which falls with distance as in free space, of 5 cm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from calib.calibration.power_curves import ALPHA_DBM
from calib.information import Verdict, reduced
from calib.planning.settings import SurveyPlanSettings
from calib.surveys.network import Boards, Case, CurvePrior, Known, Network
from calib.surveys.outcome import verdict_on_delays
from calib.surveys.recordings import PairMeans
from uwblink.arrays import Bools, Floats

SIZES_M = {"line": (5.0, 0.0, 0.0), "plane": (3.0, 2.0, 0.0), "space": (6.0, 5.0, 2.5)}
"""Where boards may stand if nobody says: a string across a room, a large table, a room."""

NEAREST_M = 0.4
"""Boards stand no nearer to each other; nearer, powers saturate and fields are not yet waves."""

CURVE_M = 0.05
"""Standard deviation of a curve over power: that of the published curves (`CURVE_LENGTH_DB`) is 0.1 m."""

POWER_AT_1_M_DBM = -74.0
"""Received power at a metre, as DW1000 boards report it."""

DRAWS = 100
"""Draws of which pairs are reflected: a root mean square over them is good to a few per cent."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Places (boards, 3) of an arrangement in metres, and the pairs of boards (by number) whose distance is taped."""

    place_m: Floats
    dimensions: int
    taped: tuple[tuple[int, int], ...] = ()


def lengths_m(settings: SurveyPlanSettings) -> Floats:
    """Return how large the line, table or room is (3,)."""
    if settings.size_m is None:
        x, y, z = SIZES_M[settings.on]
        return np.array([max(x, 0.8 * (len(settings.tags) - 1)) if settings.on == "line" else x, y, z])
    return np.pad(np.array(settings.size_m, dtype=float), (0, 3 - len(settings.size_m)))


def random_layouts(inputs: SurveyPlanSettings, count: int, tries: int = 400) -> list[Layout]:
    """Return random arrangements: orders on a line at even steps, random places on a table or in a room.

    Fewer than `count` where a line has fewer orders, or a room too little space. Anchors stay where the first one has
    them: the corners of a room are as good a guess as any.
    """
    rng, boards, size = np.random.default_rng(inputs.seed), len(inputs.tags), lengths_m(inputs)
    anchors = [inputs.tags.index(tag) for tag in inputs.anchors]
    found: list[Layout] = []
    seen: set[tuple[int, ...]] = set()
    for _ in range(tries):
        if len(found) == count:
            break
        if inputs.on == "line":
            order = tuple(rng.permutation(boards).tolist())
            if order not in seen:
                seen |= {order, order[::-1]}
                found.append(on_line(order, float(size[0])))
            continue
        place = np.zeros((boards, 3))
        dimensions = inputs.dimensions
        place[:, :dimensions] = np.round(rng.uniform(0, size[:dimensions], (boards, dimensions)), 1)
        if min(np.linalg.norm(place[i] - place[j]) for i, j in combinations(range(boards), 2)) >= NEAREST_M:
            place[anchors] = found[0].place_m[anchors] if found else place[anchors]
            found.append(Layout(place, dimensions))
    return found


def on_line(order: tuple[int, ...], length_m: float) -> Layout:
    """Return boards (by number) in an order, at even steps along a line."""
    place = np.zeros((len(order), 3))
    place[list(order), 0] = np.round(np.linspace(0, length_m, len(order)), 1)
    return Layout(place, 1)


def rows_of(inputs: SurveyPlanSettings, layout: Layout, curve: CurvePrior | None = None) -> tuple[Floats, Bools]:
    """Return the derivatives (n, k) of an arrangement's rows over their errors, and which are by delays and curve.

    Those come first, the coordinates of places after them. Of rows the first are those of all pairs, as
    `itertools.combinations` has them, then taped distances and known coordinates.
    """
    boards = len(inputs.tags)
    pairs = np.array(list(combinations(range(boards), 2)))
    none, ids = np.zeros(len(pairs)), np.zeros(len(pairs), dtype=np.int64)
    taped = np.array(layout.taped, dtype=np.int64).reshape(-1, 2)
    anchors = np.array([inputs.tags.index(tag) for tag in inputs.anchors], dtype=np.int64)
    network = Network(
        means=PairMeans(
            arrangement=ids,
            ends=pairs,
            weights=np.full((len(pairs), 2), 0.5),
            range_m=none,
            std_m=none,
            noise_m=none,
            count=ids,
            lifted=none,
        ),
        arrangements=(Boards("", layout.dimensions, tuple(range(boards))),),
        tags=tuple(range(boards)),
        known=Known(
            ends=taped,
            distance_m=np.zeros(len(taped)),
            distance_std_m=np.full(len(taped), inputs.tape_sigma_m),
            statement=np.arange(len(taped)),
            at=anchors,
            position_m=layout.place_m[anchors],
            position_std_m=np.full(len(anchors), inputs.anchor_sigma_m),
        ),
        fixed_ns={},
        curve=curve,
    )
    case = Case(marks=none.astype(bool), pair_m=inputs.pair_error_m, curve_m=CURVE_M)
    here = network.at(network.with_positions(network.layout.start(), layout.place_m), case)
    wanted = network.layout.indices(["delay", "curve"])
    columns = np.concatenate([wanted, np.setdiff1d(here.free, wanted)])
    return here.jacobian[:, columns] / here.std[:, None], np.arange(len(columns)) < len(wanted)


def delay_information(inputs: SurveyPlanSettings, layout: Layout) -> Floats:
    """Return the information (boards, boards) on delays, 1/ns^2, that an arrangement gives, whatever its places."""
    rows, wanted = rows_of(inputs, layout)
    return reduced(rows.T @ rows, wanted)


@dataclass(frozen=True, slots=True)
class Prediction:
    """Standard deviations in ns, infinite where undetermined: of delays (tags,), each against their mean, that."""

    each: Floats
    apart: Floats
    common: float


def predict(inputs: SurveyPlanSettings, layouts: Sequence[Layout], *, curve: bool = False) -> list[Prediction]:
    """Return what is predicted of the first of the arrangements, of the first two, and so on."""
    boards, pairs = len(inputs.tags), np.array(list(combinations(range(len(inputs.tags)), 2)))
    lengths = [np.linalg.norm(one.place_m[pairs[:, 0]] - one.place_m[pairs[:, 1]], axis=1) for one in layouts]
    powers = POWER_AT_1_M_DBM - 20 * np.log10(np.concatenate(lengths))
    prior = CurvePrior.at(10 ** ((powers - ALPHA_DBM) / 10)) if curve else None
    parts = []
    for k, layout in enumerate(layouts):
        here = slice(k * len(pairs), (k + 1) * len(pairs))
        own = None if prior is None else replace(prior, design=prior.design[here])
        rows, wanted = rows_of(inputs, layout, own)
        kept = np.ones((DRAWS if inputs.reflected else 1, len(rows)), dtype=bool)
        if inputs.reflected:
            rng = np.random.default_rng([inputs.seed, k])
            kept[:, : len(pairs)] = rng.uniform(size=(DRAWS, len(pairs))) >= inputs.reflected
        parts.append(np.array([reduced((rows.T * some) @ rows, wanted) for some in kept]))
    before = np.zeros(parts[0].shape[1:])
    if prior is not None:
        before[boards:, boards:] = prior.precision / CURVE_M**2
    delays = np.arange(len(before)) < boards
    return [
        _averaged([verdict_on_delays(reduced(one, delays), inputs.tags) for one in draws + before])
        for draws in np.cumsum(parts, axis=0)
    ]


def _averaged(verdicts: list[Verdict]) -> Prediction:
    """Return root mean squares over the draws that determine it; infinite where most do not."""
    rows = []
    for one in verdicts:
        whole = one.determined.all()
        centre = np.eye(len(one.std)) - 1 / len(one.std)
        apart = np.sqrt(np.diag(centre @ one.covariance @ centre)) if whole else np.full(len(one.std), math.inf)
        rows.append([*one.std, *apart, math.sqrt(float(one.covariance.mean())) if whole else math.inf])
    every = np.array(rows)
    good = np.isfinite(every)
    mean = np.sqrt((np.where(good, every, 0.0) ** 2).sum(axis=0) / np.maximum(good.sum(axis=0), 1))
    found = np.where(good.mean(axis=0) > 0.5, mean, math.inf)
    count = len(found) // 2
    return Prediction(found[:count], found[count:-1], float(found[-1]))
