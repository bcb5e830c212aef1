"""Path loss, antennas, power offsets of tags, fading and noise of readings, fitted to first-path powers."""

from __future__ import annotations

from dataclasses import dataclass
from math import isqrt
from typing import Final

import numpy as np
from scipy.special import expit, logit

from uwblink.arrays import Floats
from uwbsim.twins.flight import TwinFlight, bulk_spread, effective_size, lasting, some_rows
from uwbsim.world.radio import ANTENNAS, before_saturation_dbm, harmonics

MIN_REFLECTED: Final = 5.0
"""Smallest number of reflected exchanges (sum of their probabilities) from which the loss of reflections is fitted. The
spread of five values is known to a third (the root of 1/8)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PowerFit:
    """The model of first-path powers, in dBm and dB.

    `saturation_dbm` is the upper limit of readings, None without significant saturation. `at_1m_dbm` and `exponent`
    describe the path loss; `exponent` is None if distances are too similar. `tx_db` and `offset_db` (tags,) are the
    offsets of transmitters and receivers, `pattern_db` (tags, harmonics) the antenna patterns. Reflections reduce the
    power by `reflection_loss_db` with the standard deviation `reflection_loss_std_db`; None with too few reflections.
    `fading_db` is the standard deviation of the fading that both ends have in common, `fading_levels_db` are its
    quantiles, and `fading_life_s` is its time constant, None if undetermined; `noise_db` is the noise of a reading.
    """

    saturation_dbm: float | None
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


@dataclass(frozen=True, slots=True, kw_only=True)
class _Solved:
    antenna: str
    at_1m_dbm: float
    exponent: float
    loss_db: float
    tags_db: Floats
    pattern_db: Floats
    left_db: Floats


def fit_powers(flight: TwinFlight, reflected: Floats) -> PowerFit:
    """Fit the powers of a flight, given the probabilities of reflections (n,)."""
    enough = float(reflected.sum()) >= MIN_REFLECTED
    saturation, power = _unsaturated(flight, reflected)
    plain, *shaped = [_solve(flight, power, reflected, antenna, rounds=1) for antenna in ANTENNAS]
    best = min(shaped, key=lambda one: float(np.var(one.left_db)))
    # Use an antenna model only if it reduces the residual variance by more than 3 % (a judgement).
    if np.var(best.left_db) >= 0.97 * np.var(plain.left_db):
        best = plain
    # The variance of a reading is the residual variance, increased because persistent fading reduces the effective
    # number of readings.
    both = best.left_db.mean(axis=0)
    scale_db2 = float(np.var(best.left_db) * 2 * len(both) / effective_size(both, flight.pair))
    solved = _solve(flight, power, reflected, best.antenna, rounds=5, scale_db2=scale_db2)
    if solved.loss_db < 0:
        # Reflections cannot increase power, so a negative loss has another cause: fit without reflections.
        reflected = np.zeros(len(flight))
        solved = _solve(flight, power, reflected, best.antenna, rounds=5, scale_db2=scale_db2)
    elif enough and solved.loss_db > 0:
        # Powers indicate reflections whose detours are shorter than the noise of ranges.
        reflected = _by_power(solved, reflected)
        solved = _solve(flight, power, reflected, best.antenna, rounds=5, scale_db2=scale_db2)
    # If a tag ranges in few directions, its pattern contains a part of its offsets: add the mean gain to the offsets,
    # and subtract it from the pattern's constant.
    seen = _mean_gains(flight, solved.pattern_db)
    level, own, tx, offset = _split_offsets(*(solved.tags_db + seen))
    fading, loss_std = _common_spreads(solved, reflected)
    both = solved.left_db.mean(axis=0)
    _, life = lasting(flight.time_s, flight.pair, both) if fading > 0 else (0.0, None)
    return PowerFit(
        saturation_dbm=saturation,
        at_1m_dbm=solved.at_1m_dbm + level,
        exponent=solved.exponent if _determines_path_loss(flight) else None,
        antenna=solved.antenna,
        tx_db=tx,
        offset_db=offset,
        pattern_db=np.column_stack([own - seen, solved.pattern_db]),
        reflection_loss_db=max(solved.loss_db, 0.0) if enough else None,
        reflection_loss_std_db=min(loss_std, max(solved.loss_db, 0.0) / 2),
        fading_db=fading,
        fading_levels_db=_levels(both, reflected, fading),
        fading_life_s=life,
        noise_db=max(bulk_spread(solved.left_db[0] - solved.left_db[1]), 1e-6) / np.sqrt(2),
    )


def _determines_path_loss(flight: TwinFlight) -> bool:
    """Return whether the standard deviation of the logarithm of distances is at least 12 % (a judgement)."""
    return bool(np.std(np.log10(flight.distance_m)) >= 0.05)


def _unsaturated(flight: TwinFlight, reflected: Floats) -> tuple[float | None, Floats]:
    """Return the saturation level of power readings in dBm, None without any, and the powers (2, n) without saturation.

    Without saturation, the number of readings above their maximum would have an expectation e by the model. There is
    saturation if exp(-e), the probability of none, is at most 1 %. The level is the most likely one of some levels
    above the maximum.
    """
    direct = np.flatnonzero(reflected < 0.5)
    some = flight[direct[some_rows(len(direct), 4000)]]
    highest = float(flight.power_dbm.max())

    def fitted(end_dbm: float) -> tuple[Floats, float]:
        power, slope = before_saturation_dbm(some.power_dbm, end_dbm)
        left = _solve(some, power, np.zeros(len(some)), "isotropic", rounds=1).left_db
        return left, float(np.sum(np.log(slope)) - left.size * np.log(np.std(left) + 1e-6))

    left, _ = fitted(np.inf)
    below = np.searchsorted(np.sort(left.ravel()), highest - (some.power_dbm - left).ravel(), side="right") / left.size
    worth = effective_size(left.mean(axis=0), some.pair) / len(some)
    if np.exp(-worth * np.sum(1 - below)) > 0.01:
        return None, flight.power_dbm
    end = float(max(highest + np.array([0.1, 0.2, 0.4, 0.8, 1.6, 3.2]), key=lambda level: fitted(level)[1]))
    return end, before_saturation_dbm(flight.power_dbm, end)[0]


def _solve(
    flight: TwinFlight, power_dbm: Floats, reflected: Floats, antenna: str, *, rounds: int, scale_db2: float = 100.0
) -> _Solved:
    """Solve a penalised least-squares problem with two readings per exchange, and new weights in each of the rounds.

    `scale_db2` is the variance of a reading in dB^2. The priors have the mean zero and standard deviations of 4 dB for
    offsets of tags and of 2/k dB for harmonics of degree k of an antenna (judgements). The highest degree depends on
    the number of readings per tag.
    """
    tags, each = len(flight.tags), 4 * len(flight) / len(flight.tags)
    degree = next((degree for least, degree in ((800, 3), (250, 2), (80, 1)) if each >= least), 0)
    size = (degree + 1) ** 2 - 1  # without degree 0, which has the same effect as the offsets
    gain = sum(ANTENNAS[antenna](np.hypot(way[:, 0], way[:, 1])) for way in flight.towards)
    first, second = is_tag = np.eye(tags)[flight.ends]
    waves = np.array([harmonics(way, degree)[:, 1:] for way in flight.towards])
    pattern = np.einsum("ent,enk->ntk", is_tag, waves).reshape(len(flight), -1)
    common = np.column_stack([np.ones(len(flight)), -10 * np.log10(flight.distance_m), -reflected])
    # Rows: readings at the target, then at the initiator. Columns: common effects, transmitters, receivers, antennas.
    design = np.block([[common, first, second, pattern], [common, second, first, pattern]])
    value = (power_dbm - gain).ravel()
    exponent = 0.0 if _determines_path_loss(flight) else 1e9
    fine = [scale_db2 * (k / 2.0) ** 2 for k in range(1, degree + 1) for _ in range(2 * k + 1)]
    penalty = np.array([0.0, exponent, 1e-6] + [scale_db2 / 4.0**2] * (2 * tags) + fine * tags)
    prior, weight = np.zeros(design.shape[1]), np.ones(len(value))
    prior[1] = 2.0  # the exponent in free space
    for _ in range(rounds):
        weighted = (design * weight[:, None]).T
        normal = weighted @ design + np.diag(penalty) + 1e-9 * np.eye(len(penalty))
        found = prior + np.linalg.solve(normal, weighted @ (value - design @ prior))
        left = value - design @ found
        # Weights of Huber's loss, because deep fades are more frequent than in a normal distribution.
        weight = 1 / np.maximum(np.abs(left) / (1.5 * max(bulk_spread(left), 1e-6)), 1.0)
    return _Solved(
        antenna=antenna,
        at_1m_dbm=float(found[0]),
        exponent=float(found[1]),
        loss_db=float(found[2]),
        tags_db=found[3 : 3 + 2 * tags].reshape(2, tags),
        pattern_db=found[3 + 2 * tags :].reshape(tags, size),
        left_db=left.reshape(2, -1),
    )


def _by_power(solved: _Solved, reflected: Floats) -> Floats:
    """Return the probabilities (n,) of reflections, updated by the likelihoods of the mean powers of exchanges."""
    above = solved.left_db.mean(axis=0) - reflected * solved.loss_db
    spread = max(bulk_spread(above[reflected < 0.5]), 0.1)
    return np.asarray(expit(logit(reflected) + (above**2 - (above + solved.loss_db) ** 2) / (2 * spread**2)))


def _mean_gains(flight: TwinFlight, pattern_db: Floats) -> Floats:
    """Return the mean gain of each tag's pattern (tags,) in dB, over the directions of its exchanges."""
    degree = isqrt(pattern_db.shape[1] + 1) - 1
    gains = [
        np.einsum("nk,nk->n", harmonics(way, degree)[:, 1:], pattern_db[end])
        for end, way in zip(flight.ends, flight.towards, strict=True)
    ]
    ends, count = flight.ends.ravel(), len(flight.tags)
    total = np.bincount(ends, np.concatenate(gains), minlength=count)
    return np.asarray(total / np.maximum(np.bincount(ends, minlength=count), 1))


def _split_offsets(sends_db: Floats, reads_db: Floats) -> tuple[float, Floats, Floats, Floats]:
    """Split offsets of sent and of received powers (tags,) into a common level, antenna, transmitter and receiver.

    The last three have shape (tags,). The differences of both offsets are known except for a constant, which is chosen
    so that the median difference is zero. A difference is assigned to the transmitter or to the receiver, whichever
    leaves less to the antenna. The rest of the mean of both offsets is assigned to the antenna.
    """
    between, common = sends_db - reads_db, (sends_db + reads_db) / 2
    level = float(np.median(common))
    between, common = between - np.median(between), common - level
    by_sending = np.sign(between) == np.sign(common)
    tx, offset = np.where(by_sending, between, 0.0), np.where(by_sending, 0.0, -between)
    return 2 * level, common - (tx + offset) / 2, tx, offset


def _levels(both_db: Floats, reflected: Floats, fading_db: float) -> Floats:
    """Return quantiles of fading, from mean residuals of both ends (n,), scaled to the spread without noise."""
    direct = both_db[reflected < 0.5]
    levels = 41  # also the smallest number of direct readings that are used alone
    direct = direct if len(direct) >= levels else both_db
    found = np.quantile(direct, np.linspace(0, 1, levels))
    middle = float(np.median(direct))
    return np.asarray(middle + (found - middle) * min(fading_db / max(float(np.std(direct)), 1e-9), 1.0))


def _common_spreads(solved: _Solved, reflected: Floats) -> tuple[float, float]:
    """Return the standard deviations of the fading that both ends share, and of the loss of reflections, in dB.

    Both follow from the mean product of the residuals of both ends, which excludes the noise of readings.
    """
    first, second = solved.left_db
    unsure = reflected * (1 - reflected) * solved.loss_db**2
    design = np.column_stack([np.ones(len(reflected)), reflected])
    if reflected.sum() < MIN_REFLECTED:
        return float(np.sqrt(max(np.mean(first * second), 0.0))), 0.0
    found = np.linalg.lstsq(design, first * second - unsure, rcond=None)[0]
    return float(np.sqrt(max(found[0], 0.0))), float(np.sqrt(max(found[1], 0.0)))
