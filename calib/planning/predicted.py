"""What arrangements of boards would say of their delays: Fisher's information of a survey's own rows, without data.

Places are unknown. With reflections, which pairs are reflected is drawn, and what is promised is the root mean square
over the draws: a reflected pair says nearly nothing of the delays. A curve over power is what a survey takes it for, a
smooth function of the power, which falls with distance as in free space, of 5 cm.
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
from calib.surveys.knowledge import KnownPosition
from calib.surveys.network import Boards, Case, CurvePrior, Network
from calib.surveys.outcome import verdict_on_delays
from calib.surveys.recordings import PairMeans
from uwblink.arrays import Bools, Floats
from uwblink.recording.schema import KnownDistance

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

    def powers_dbm(self) -> Floats:
        """Return the received powers of all pairs, which fall with distance as in free space."""
        length = [float(np.linalg.norm(one - other)) for one, other in combinations(self.place_m, 2)]
        return np.asarray(POWER_AT_1_M_DBM - 20 * np.log10(length))


def random_layouts(inputs: SurveyPlanSettings, count: int, tries: int = 400) -> list[Layout]:
    """Return random arrangements: orders on a line at even steps, random places on a table or in a room.

    Fewer than `count` where a line has fewer orders, or a room too little space. Anchors stay where the first one has
    them: the corners of a room are as good a guess as any.
    """
    rng, boards, dimensions = np.random.default_rng(inputs.seed), len(inputs.tags), inputs.dimensions
    size = np.array(SIZES_M[inputs.on] if inputs.size_m is None else inputs.size_m, dtype=float)[:dimensions]
    if inputs.on == "line" and inputs.size_m is None:
        size = np.maximum(size, 0.8 * (boards - 1))
    anchors = [inputs.tags.index(tag) for tag in inputs.anchors]
    found: dict[tuple[int, ...] | int, Layout] = {}
    for number in range(tries):
        if len(found) == count:
            break
        if inputs.on == "line":
            order = tuple(rng.permutation(boards).tolist())
            found.setdefault(min(order, order[::-1]), on_line(order, float(size[0])))
            continue
        place = np.zeros((boards, 3))
        place[:, :dimensions] = np.round(rng.uniform(0, size, (boards, dimensions)), 1)
        if min(np.linalg.norm(one - other) for one, other in combinations(place, 2)) >= NEAREST_M:
            place[anchors] = next(iter(found.values())).place_m[anchors] if found else place[anchors]
            found[number] = Layout(place, dimensions)
    return list(found.values())


def on_line(order: tuple[int, ...], length_m: float) -> Layout:
    """Return boards (by number) in an order, at even steps along a line."""
    place = np.zeros((len(order), 3))
    place[list(order), 0] = np.round(np.linspace(0, length_m, len(order)), 1)
    return Layout(place, 1)


def delay_information(
    inputs: SurveyPlanSettings, layout: Layout, curve: CurvePrior | None = None, reflected: Bools | None = None
) -> Floats:
    """Return the information on delays, 1/ns^2, and on a curve, that an arrangement gives, whatever its places.

    `reflected` (pairs,) tells which pairs are. Boards are numbered.
    """
    boards = range(len(inputs.tags))
    pairs = np.array(list(combinations(boards, 2)))
    none, number = np.zeros(len(pairs)), np.zeros(len(pairs), dtype=np.int64)
    means = PairMeans(
        arrangement=number,
        ends=pairs,
        weights=np.full((len(pairs), 2), 0.5),
        range_m=none,
        std_m=none,
        noise_m=none,
        count=number,
        lifted=none,
    )
    anchors = [(inputs.tags.index(tag), inputs.anchor_sigma_m) for tag in inputs.anchors]
    network = Network(
        means=means,
        arrangements=(Boards("", layout.dimensions, tuple(boards)),),
        tags=tuple(boards),
        distances=tuple(KnownDistance(i, j, 1.0, inputs.tape_sigma_m) for i, j in layout.taped),
        positions=tuple(KnownPosition(k, tuple(layout.place_m[k].tolist()), sigma) for k, sigma in anchors),
        fixed_ns={},
        curve=curve,
    )
    case = Case(none > 0 if reflected is None else reflected, inputs.pair_error_m, CURVE_M)
    x, free = network.with_positions(network.layout.start(), layout.place_m), network.layout.free()
    return reduced(network.at(x, case).known[np.ix_(free, free)], free >= layout.place_m.size)


@dataclass(frozen=True, slots=True)
class Prediction:
    """Standard deviations in ns, infinite where undetermined: of delays (tags,), each against their mean, that."""

    each: Floats
    apart: Floats
    common: float


def predict(inputs: SurveyPlanSettings, layouts: Sequence[Layout], *, curve: bool = False) -> list[Prediction]:
    """Return what is predicted of the first of the arrangements, of the first two, and so on."""
    powers = np.array([one.powers_dbm() for one in layouts])
    prior = CurvePrior.at(10 ** ((powers.ravel() - ALPHA_DBM) / 10)) if curve else None
    boards, own, parts = len(inputs.tags), None, []
    for k, layout in enumerate(layouts):
        if prior is not None:
            rows = slice(k * powers.shape[1], (k + 1) * powers.shape[1])
            # The prior counts once, below.
            own = replace(prior, design=prior.design[rows], precision=np.zeros_like(prior.precision))
        shape = (DRAWS if inputs.reflected else 1, powers.shape[1])
        drawn = np.random.default_rng([inputs.seed, k]).uniform(size=shape) < inputs.reflected
        parts.append([delay_information(inputs, layout, own, marks) for marks in drawn])
    totals = np.cumsum(parts, axis=0)
    if prior is not None:
        totals[:, :, boards:, boards:] += prior.precision / CURVE_M**2
    delays = np.arange(totals.shape[-1]) < boards
    return [_averaged([verdict_on_delays(reduced(one, delays), inputs.tags) for one in draws]) for draws in totals]


def _averaged(verdicts: list[Verdict]) -> Prediction:
    """Return root mean squares over the draws that determine it; infinite where most do not."""
    covariance = np.array([one.covariance for one in verdicts])
    centre = np.eye(covariance.shape[1]) - 1 / covariance.shape[1]
    apart = np.diagonal(centre @ covariance @ centre, axis1=1, axis2=2)
    common = covariance.mean(axis=(1, 2))[:, None]
    each = np.array([one.std for one in verdicts]) ** 2
    return Prediction(_root_mean(each), _root_mean(apart), float(_root_mean(common)[0]))


def _root_mean(variances: Floats) -> Floats:
    """Return roots of means (n,) over the draws (k, n) that are finite; infinite where most are not."""
    good = np.isfinite(variances)
    mean = np.where(good, variances, 0.0).sum(axis=0) / np.maximum(good.sum(axis=0), 1)
    return np.where(good.mean(axis=0) > 0.5, np.sqrt(mean), math.inf)
