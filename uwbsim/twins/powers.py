"""Path loss, antennas, offsets of tags, fading and noise of readings, from first-path powers over distance."""

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
"""Reflected exchanges, by their probabilities, below which their losses are not determined: a spread of
five is known to a third (the root of 1/8)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PowerFit:
    """The model of first-path powers: levels in dBm and dB.

    `saturation_dbm` is where readings end, None where nothing shows that they do. `exponent` is None where distances
    do not differ enough. `tx_db`, `offset_db` (tags,) and `pattern_db` (tags, harmonics) are of tags, by place.
    `reflection_loss_db` with `reflection_loss_std_db` about it is what a reflection takes off, None where there are too
    few. `fading_db` is how much fading both ends share, `fading_levels_db` its quantiles; it lasts `fading_life_s`,
    None where the recording does not tell; `noise_db` is of a reading.
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
    """Fit powers of a flight whose ranges are reflected with known probabilities (n,)."""
    enough = float(reflected.sum()) >= MIN_REFLECTED
    saturation, power = _unsaturated(flight, reflected)
    plain, *shaped = [_solve(flight, power, reflected, antenna, rounds=1) for antenna in ANTENNAS]
    best = min(shaped, key=lambda one: float(np.var(one.left_db)))
    # An antenna with a shape is taken where it leaves 3 % less than none.
    if np.var(best.left_db) >= 0.97 * np.var(plain.left_db):
        best = plain
    # A reading has the variance that is left, as much larger as values that last are worth less than their number.
    both = best.left_db.mean(axis=0)
    scale_db2 = float(np.var(best.left_db) * 2 * len(both) / effective_size(both, flight.pair))
    solved = _solve(flight, power, reflected, best.antenna, rounds=5, scale_db2=scale_db2)
    if solved.loss_db < 0:
        # Reflections are not stronger than what they replace; what looks like that is something else.
        reflected = np.zeros(len(flight))
        solved = _solve(flight, power, reflected, best.antenna, rounds=5, scale_db2=scale_db2)
    elif enough and solved.loss_db > 0:
        # Detours shorter than the noise of ranges show in powers.
        reflected = _by_power(solved, reflected)
        solved = _solve(flight, power, reflected, best.antenna, rounds=5, scale_db2=scale_db2)
    # The pattern of a tag that ranges in one direction only may contain its offsets: there both are added.
    seen = _mean_gains(flight, solved.pattern_db)
    level, own, tx, offset = _split(*(solved.tags_db + seen))
    fading, loss_std = _common(solved, reflected)
    both = solved.left_db.mean(axis=0)
    _, life = lasting(flight.time_s, flight.pair, both) if fading > 0 else (0.0, None)
    return PowerFit(
        saturation_dbm=saturation,
        at_1m_dbm=solved.at_1m_dbm + level,
        exponent=solved.exponent if _tells_path_loss(flight) else None,
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


def _tells_path_loss(flight: TwinFlight) -> bool:
    """Return whether distances differ by more than some 12 %."""
    return bool(np.std(np.log10(flight.distance_m)) >= 0.05)


def _unsaturated(flight: TwinFlight, reflected: Floats) -> tuple[float | None, Floats]:
    """Return where readings of power end, and the powers (2, n) without this saturation.

    They end where they would without saturation exceed their maximum so often that chance leaves none there with a
    probability of 1 %. Where they end is the likeliest of some levels above the maximum.
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
    """Solve one penalized least-squares problem: two readings an exchange, weighed anew in each of the rounds.

    `scale_db2` is the variance in dB^2 of a reading about the gain of an antenna. The priors have a mean of zero and
    standard deviations of 4 dB for offsets of tags, 2/k dB for harmonics of degree k of an antenna. The highest degree
    is the one that the readings of a tag determine.
    """
    tags, each = len(flight.tags), 4 * len(flight) / len(flight.tags)
    degree = next((degree for least, degree in ((800, 3), (250, 2), (80, 1)) if each >= least), 0)
    size = (degree + 1) ** 2 - 1  # all of a tag's readings know of its mean, which the offsets have
    gain = sum(ANTENNAS[antenna](np.hypot(way[:, 0], way[:, 1])) for way in flight.towards)
    first, second = is_tag = np.eye(tags)[flight.ends]
    waves = np.array([harmonics(way, degree)[:, 1:] for way in flight.towards])
    pattern = np.einsum("ent,enk->ntk", is_tag, waves).reshape(len(flight), -1)
    common = np.column_stack([np.ones(len(flight)), -10 * np.log10(flight.distance_m), -reflected])
    # Readings at the target, then at the initiator: what they have in common, sender, receiver, both antennas.
    design = np.block([[common, first, second, pattern], [common, second, first, pattern]])
    value = (power_dbm - gain).ravel()
    exponent = 0.0 if _tells_path_loss(flight) else 1e9
    fine = [scale_db2 * (k / 2.0) ** 2 for k in range(1, degree + 1) for _ in range(2 * k + 1)]
    penalty = np.array([0.0, exponent, 1e-6] + [scale_db2 / 4.0**2] * (2 * tags) + fine * tags)
    prior, weight = np.zeros(design.shape[1]), np.ones(len(value))
    prior[1] = 2.0  # the exponent in free space
    for _ in range(rounds):
        weighted = (design * weight[:, None]).T
        normal = weighted @ design + np.diag(penalty) + 1e-9 * np.eye(len(penalty))
        found = prior + np.linalg.solve(normal, weighted @ (value - design @ prior))
        left = value - design @ found
        # Huber's weights: fades are deep more often than normal.
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
    """Return the probabilities (n,) that ranges were reflected, by their powers, too, which reflections lower."""
    above = solved.left_db.mean(axis=0) - reflected * solved.loss_db
    spread = max(bulk_spread(above[reflected < 0.5]), 0.1)
    return np.asarray(expit(logit(reflected) + (above**2 - (above + solved.loss_db) ** 2) / (2 * spread**2)))


def _mean_gains(flight: TwinFlight, pattern_db: Floats) -> Floats:
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

    The difference of the two directions is known but for a constant, which is chosen so that the median tag has no
    difference. It is assigned to the transmitter or to the receiver, whichever leaves less to the antenna. The antenna
    has what both directions have in common.
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
    levels = 41  # and as many readings at least
    direct = direct if len(direct) >= levels else both_db
    found = np.quantile(direct, np.linspace(0, 1, levels))
    middle = float(np.median(direct))
    return np.asarray(middle + (found - middle) * min(fading_db / max(float(np.std(direct)), 1e-9), 1.0))


def _common(solved: _Solved, reflected: Floats) -> tuple[float, float]:
    """Return how much fading both ends have in common, and by how much losses of reflections differ, in dB."""
    first, second = solved.left_db
    unsure = reflected * (1 - reflected) * solved.loss_db**2
    design = np.column_stack([np.ones(len(reflected)), reflected])
    if reflected.sum() < MIN_REFLECTED:
        return float(np.sqrt(max(np.mean(first * second), 0.0))), 0.0
    found = np.linalg.lstsq(design, first * second - unsure, rcond=None)[0]
    return float(np.sqrt(max(found[0], 0.0))), float(np.sqrt(max(found[1], 0.0)))
