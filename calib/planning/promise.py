"""How well delays will be known by arrangements, with what a survey has to find along: reflections, a curve over power.

A reflected pair says nothing of the delays: which pairs those will be is drawn, and what is promised is the root mean
square over the draws. A curve is what a survey takes it for: a smooth function of the power, which falls with distance
as in free space, bent over 4 dB, by 5 cm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from calib.calibration.power_curves import ALPHA_DBM
from calib.information import Unknown, Verdict, judge
from calib.planning.candidates import Layout, beside, rows_of
from calib.planning.having import Having
from calib.surveys.power import PowerModel, power_model
from calib.surveys.scales import DELAY_SCALE_NS, M_PER_NS
from uwblink.arrays import Floats

DRAWS: Final = 100
CURVE_M: Final = 0.05
"""How large a curve over power is, as a standard deviation."""

POWER_AT_1_M_DBM: Final = -74.0


@dataclass(frozen=True, slots=True)
class Promise:
    """Standard deviations in ns, infinite where undetermined: of delays (tags,), each against their mean, that."""

    each: Floats
    apart: Floats
    common: float


def promises(given: Having, layouts: Sequence[Layout], *, curve: bool = False) -> list[Promise]:
    """Return what is promised by the first of the arrangements, by the first two, and so on."""
    model = _curve(layouts) if curve else None
    first, parts = 0, list[Floats]()
    for layout in layouts:
        pairs = math.comb(len(given.tags), 2)
        design = np.zeros((pairs, 0)) if model is None else model.design[first : first + pairs]
        parts.append(_drawn(given, layout, design, np.random.default_rng([given.seed, len(parts)])))
        first += pairs
    before = np.zeros(parts[0].shape[1:])
    if model is not None:
        boards = len(given.tags)
        before[boards:, boards:] = model.precision / CURVE_M**2
    return [_averaged([_verdict(one, given.tags) for one in draws + before]) for draws in np.cumsum(parts, axis=0)]


def _curve(layouts: Sequence[Layout]) -> PowerModel | None:
    length = np.concatenate(
        [[np.linalg.norm(p[i] - p[j]) for i, j in combinations(range(len(p)), 2)] for p in (o.place_m for o in layouts)]
    )
    return power_model(10 ** ((POWER_AT_1_M_DBM - 20 * np.log10(length) - ALPHA_DBM) / 10))


def _drawn(given: Having, layout: Layout, design: Floats, rng: np.random.Generator) -> Floats:
    """Return the information (draws, unknowns, unknowns) of an arrangement on delays in metres and the curve."""
    delays, places = rows_of(layout, given.pair_error_m, given.tape_sigma_m, given.known_places)
    beyond = np.zeros((len(delays) - len(design), design.shape[1]))
    wanted = np.hstack([delays, np.vstack([design / given.pair_error_m, beyond])])
    kept = np.ones((DRAWS if given.reflected else 1, len(wanted)), dtype=bool)
    if given.reflected:
        kept[:, : len(design)] = rng.uniform(size=(DRAWS, len(design))) >= given.reflected
    return np.array([beside(wanted[rows], places[rows]) for rows in kept])


def _verdict(information: Floats, tags: tuple[int, ...]) -> Verdict:
    """Return what is determined of the delays, whatever the curve is."""
    boards = len(tags)
    mixed, curve = information[:boards, boards:], information[boards:, boards:]
    left = information[:boards, :boards] - mixed @ np.linalg.solve(curve, mixed.T)
    left = (left + left.T) / 2 * M_PER_NS**2
    values, vectors = np.linalg.eigh(left)
    return judge(
        (vectors * np.maximum(values, 0.0)) @ vectors.T, [Unknown("delay", str(t), DELAY_SCALE_NS) for t in tags]
    )


def _averaged(verdicts: list[Verdict]) -> Promise:
    """Return root mean squares over the draws that determine it; infinite where most do not."""
    rows = []
    for one in verdicts:
        whole = one.determined.all()
        centre = np.eye(len(one.std)) - 1 / len(one.std)
        apart = np.sqrt(np.diag(centre @ one.covariance @ centre)) if whole else np.full(len(one.std), math.inf)
        common = math.sqrt(float(one.covariance.mean())) if whole else math.inf
        rows.append([*one.std, *apart, common])
    every = np.array(rows)
    good = np.isfinite(every)
    mean = np.sqrt((np.where(good, every, 0.0) ** 2).sum(axis=0) / np.maximum(good.sum(axis=0), 1))
    found = np.where(good.mean(axis=0) > 0.5, mean, math.inf)
    count = len(found) // 2
    return Promise(found[:count], found[count:-1], float(found[-1]))
