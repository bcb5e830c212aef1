"""Path loss, antennas, offsets of tags, fading and noise of readings, from first-path powers over distance."""

from __future__ import annotations

from dataclasses import dataclass
from math import isqrt
from typing import Final

import numpy as np

from uwblink.arrays import Floats
from uwbsim.twins.flight import Flight, Lasting, autocovariance, bulk_spread, effective_size, lasting
from uwbsim.world.radio import ANTENNAS, harmonics

LEAST_SPREAD: Final = 0.05
"""Of the decimal logarithm of distance, below which nothing is told of path loss."""

DEFAULT_EXPONENT: Final = 2.0
DEGREES: Final = ((800, 3), (250, 2), (80, 1))
"""Of antenna patterns, by how many readings a tag has at least."""

OFFSET_STD_DB: Final = 4.0
"""How different offsets of tags are thought to be before anything is seen."""

PATTERN_STD_DB: Final = 2.0
"""The same for a harmonic of degree 1 of an antenna; higher ones are as much smaller as their degree."""

BETTER: Final = 0.97
"""Of the variance that is left, below which an antenna with a shape is taken instead of none."""

HUBER: Final = 1.5
"""Times their spread, beyond which readings count less: fades are deep more often than normal."""

REWEIGHTED: Final = 5
LEVELS: Final = 41
LEAST_WEIGHT: Final = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PowerFit:
    """What powers are made of: levels in dBm and dB.

    `exponent` is None where distances do not differ enough. `tx_db`, `offset_db` (tags,) and `pattern_db`
    (tags, harmonics) are of tags, by place. `reflection_loss_db` with `reflection_loss_std_db` about it is what a
    reflection takes off, None where there are too few. `fading_db` is how much fading both ends share,
    `fading_levels_db` its quantiles; it lasts `fading_life_s`, None where the recording does not tell;
    `noise_db` is of a reading. `left_db` (2, n) is what all but fading and noise leave.
    """

    at_1m_dbm: float
    exponent: float | None
    antenna: str
    tx_db: Floats
    offset_db: Floats
    pattern_db: Floats
    reflection_loss_db: float | None
    reflection_loss_std_db: float
    fading_db: float
    fading_levels_db: Floats
    fading_life_s: float | None
    noise_db: float
    left_db: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class _Solved:
    antenna: str
    at_1m_dbm: float
    exponent: float
    loss_db: float
    tags_db: Floats
    pattern_db: Floats
    left_db: Floats


@dataclass(frozen=True, slots=True)
class _Doubt:
    """How often readings are weighed anew, and the variance in dB^2 with which one tells something of an antenna."""

    rounds: int
    scale_db2: float = 100.0


def fit_powers(flight: Flight, reflected: Floats) -> PowerFit:
    """Fit powers of a flight whose ranges are reflected with known probabilities (n,)."""
    share = float(reflected.sum())
    tries = [_solve(flight, reflected, antenna, _Doubt(rounds=1)) for antenna in ANTENNAS]
    enough = share >= LEAST_WEIGHT
    plain = tries[0]
    best = min(tries[1:], key=lambda one: float(np.var(one.left_db)))
    antenna = (best if np.var(best.left_db) < BETTER * np.var(plain.left_db) else plain).antenna
    doubt = _Doubt(rounds=REWEIGHTED, scale_db2=_worth_db2(flight, best if antenna == best.antenna else plain))
    solved = _solve(flight, reflected, antenna, doubt)
    if solved.loss_db < 0:
        # Reflections are not stronger than what they replace; what looks like that is something else.
        reflected = np.zeros(len(flight))
        solved = _solve(flight, reflected, antenna, doubt)
    told = np.std(np.log10(flight.distance_m)) >= LEAST_SPREAD
    # Where a tag was seen from one side only, its antenna can take its offsets over; towards there they count together.
    seen = _mean_gains(flight, solved.pattern_db)
    level, own, tx, offset = _split(*(solved.tags_db + seen))
    fading, loss_std = _common(solved, reflected)
    both = solved.left_db.mean(axis=0)
    noise = _spread(solved.left_db[0] - solved.left_db[1]) / np.sqrt(2)
    span = float(flight.time_s[-1])
    found = (
        lasting(autocovariance(flight.time_s, flight.pair, both, span))
        if fading > 0
        else Lasting(variance=0, life_s=None)
    )
    return PowerFit(
        at_1m_dbm=solved.at_1m_dbm + level,
        exponent=solved.exponent if told else None,
        antenna=solved.antenna,
        tx_db=tx,
        offset_db=offset,
        pattern_db=np.column_stack([own - seen, solved.pattern_db]),
        reflection_loss_db=max(solved.loss_db, 0.0) if enough else None,
        reflection_loss_std_db=min(loss_std, max(solved.loss_db, 0.0) / 2),
        fading_db=fading,
        fading_levels_db=_levels(both, reflected, fading),
        fading_life_s=found.life_s,
        noise_db=noise,
        left_db=solved.left_db,
    )


def _solve(flight: Flight, reflected: Floats, antenna: str, doubt: _Doubt) -> _Solved:
    """Solve one penalized least-squares problem: two readings an exchange."""
    tags, degree = len(flight.tags), _degree(flight)
    size = (degree + 1) ** 2 - 1  # all of a tag's readings know of its mean, which the offsets have
    apart = -10 * np.log10(flight.distance_m)
    gain = sum(ANTENNAS[antenna](np.hypot(way[:, 0], way[:, 1])) for way in flight.towards)
    blocks, readings = [], []
    waves = [harmonics(way, degree)[:, 1:] for way in flight.towards]
    for receiver in (1, 0):
        sender = 1 - receiver
        columns = np.zeros((len(flight), 3 + 2 * tags + tags * size))
        columns[:, 0], columns[:, 1], columns[:, 2] = 1, apart, -reflected
        rows = np.arange(len(flight))
        columns[rows, 3 + flight.ends[sender]] = 1
        columns[rows, 3 + tags + flight.ends[receiver]] = 1
        for end, wave in zip(flight.ends, waves, strict=True):
            first = 3 + 2 * tags + end * size
            for k in range(size):
                columns[rows, first + k] += wave[:, k]
        blocks.append(columns)
        readings.append(flight.power_dbm[0 if receiver == 1 else 1] - gain)
    design, value = np.vstack(blocks), np.concatenate(readings)
    penalty, weight = _penalty(tags, degree, flight, doubt.scale_db2), np.ones(len(value))
    for _ in range(doubt.rounds):
        found = _ridge(design, value, penalty, weight)
        left = value - design @ found
        weight = 1 / np.maximum(np.abs(left) / (HUBER * _spread(left)), 1.0)
    return _Solved(
        antenna=antenna,
        at_1m_dbm=float(found[0]),
        exponent=float(found[1]),
        loss_db=float(found[2]),
        tags_db=found[3 : 3 + 2 * tags].reshape(2, tags),
        pattern_db=found[3 + 2 * tags :].reshape(tags, size),
        left_db=left.reshape(2, -1),
    )


def _degree(flight: Flight) -> int:
    each = 4 * len(flight) / len(flight.tags)
    return next((degree for least, degree in DEGREES if each >= least), 0)


def _penalty(tags: int, degree: int, flight: Flight, scale_db2: float) -> Floats:
    """Return prior precisions by unknown, in units of what a reading tells; fine patterns are less likely."""
    free = [0.0, 0.0, 1e-6]
    if np.std(np.log10(flight.distance_m)) < LEAST_SPREAD:
        free[1] = 1e9
    fine = [k**2 / PATTERN_STD_DB**2 for k in range(1, degree + 1) for _ in range(2 * k + 1)]
    return np.array(free + [scale_db2 / OFFSET_STD_DB**2] * (2 * tags) + [scale_db2 * one for one in fine] * tags)


def _worth_db2(flight: Flight, solved: _Solved) -> float:
    """Return the variance of a reading, as much larger as values that last are worth less than their number."""
    both = solved.left_db.mean(axis=0)
    return float(np.var(solved.left_db) * 2 * len(both) / effective_size(both, flight.pair))


def _ridge(design: Floats, value: Floats, penalty: Floats, weight: Floats) -> Floats:
    prior = np.zeros(design.shape[1])
    prior[1] = DEFAULT_EXPONENT
    weighted = (design * weight[:, None]).T
    normal = weighted @ design + np.diag(penalty) + 1e-9 * np.eye(len(penalty))
    return np.asarray(prior + np.linalg.solve(normal, weighted @ (value - design @ prior)))


def _spread(values: Floats) -> float:
    return max(bulk_spread(values), 1e-6)


def _mean_gains(flight: Flight, pattern_db: Floats) -> Floats:
    """Return the mean gain of each tag's pattern towards those that it ranged with, (tags,)."""
    degree = isqrt(pattern_db.shape[1] + 1) - 1
    gains = [
        np.einsum("nk,nk->n", harmonics(way, degree)[:, 1:], pattern_db[end])
        for end, way in zip(flight.ends, flight.towards, strict=True)
    ]
    ends, count = flight.ends.ravel(), len(flight.tags)
    total = np.bincount(ends, np.concatenate(gains), minlength=count)
    return np.asarray(total / np.maximum(np.bincount(ends, minlength=count), 1))


def _split(sends_db: Floats, reads_db: Floats) -> tuple[float, Floats, Floats, Floats]:
    """Split what tags send and read too strong into the level of all, antenna, transmitter and receiver, (tags,) each.

    What differs between the two directions is certain, but for a constant that all have in common: the median tag
    differs by nothing. It is put on one of the two, on that which leaves less to the antenna, whose is what both have
    in common.
    """
    between, common = sends_db - reads_db, (sends_db + reads_db) / 2
    level = float(np.median(common))
    between, common = between - np.median(between), common - level
    by_sending = np.sign(between) == np.sign(common)
    tx, offset = np.where(by_sending, between, 0.0), np.where(by_sending, 0.0, -between)
    return 2 * level, common - (tx + offset) / 2, tx, offset


def _levels(both_db: Floats, reflected: Floats, fading_db: float) -> Floats:
    """Return quantiles of fading, from what both ends have in common and noise that is taken out of its spread."""
    direct = both_db[reflected < 0.5]
    direct = direct if len(direct) >= LEVELS else both_db
    found = np.quantile(direct, np.linspace(0, 1, LEVELS))
    middle = float(np.median(direct))
    return np.asarray(middle + (found - middle) * min(fading_db / max(float(np.std(direct)), 1e-9), 1.0))


def _common(solved: _Solved, reflected: Floats) -> tuple[float, float]:
    """Return how much fading both ends have in common, and by how much losses of reflections differ, in dB."""
    first, second = solved.left_db
    unsure = reflected * (1 - reflected) * solved.loss_db**2
    design = np.column_stack([np.ones(len(reflected)), reflected])
    if reflected.sum() < LEAST_WEIGHT:
        return float(np.sqrt(max(np.mean(first * second), 0.0))), 0.0
    found = np.linalg.lstsq(design, first * second - unsure, rcond=None)[0]
    return float(np.sqrt(max(found[0], 0.0))), float(np.sqrt(max(found[1], 0.0)))
