"""The core and the tail of residuals: how many ranges are reflected, by how much, for how long, pair by pair.

The shape of the residuals together is a normal core and a positive tail (an exponential detour on top of the core).
That is fitted as if exchanges were independent, which is consistent whether they are or not; how long reflections last,
and so how much the shares of pairs can be trusted, follows from autocovariances alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import minimize
from scipy.special import erfcx, log_ndtr

from uwblink.arrays import Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT
from uwblink.twr import intervals
from uwbsim.scenario.radio import TwoStateMultipath
from uwbsim.twins.flight import Flight, bulk_spread, effective_size, lasting, some_rows

MIN_SHARE: Final = 1e-4
"""Shares of reflections are kept so far from 0 and 1, where their logarithms end."""

SHORTEST_CORE_M: Final = 1e-3
"""A core is not narrower than this, far below a tick (4.7 mm)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReflectionFit:
    """Core and tail: all lengths in metres.

    `core_mean_m`: the mean of direct ranges; `direct_std_m` their spread beyond the noise of receive stamps; `share` of
    reflected ranges and `mean_excess_m` of their detours, over all pairs, with `share_std` and `life_spread` between
    pairs; `pair_share`, `pair_excess_m`, `pair_life_s` are those of pairs (pairs,), drawn towards all by how little
    each tells. `life_s` is None where the recording does not tell. `reflected` (n,) is the probability that a range is.
    """

    core_mean_m: float
    direct_std_m: float
    share: float
    share_std: float
    mean_excess_m: float
    life_s: float | None
    life_spread: float
    pair_share: Floats
    pair_excess_m: Floats
    pair_life_s: Floats
    reflected: Floats


def fit_reflections(flight: Flight, receive_noise_s: Floats) -> ReflectionFit:
    """Fit a flight, whose receive stamps have noises (n,) in seconds, zero where none is known."""
    white = range_noise_m(flight, receive_noise_s)
    error, pair, count = flight.residual_m, flight.pair, len(flight.pairs)
    # Further below the median than this a residual is a mistake of some other kind.
    usable = error > np.median(error) - 0.6
    mean, direct, excess, share = _mixture(error[usable], white[usable])
    if not _is_a_tail(error[usable], white[usable], mean, direct, excess, share):
        direct = float(np.sqrt(max(bulk_spread(error) ** 2 - float(np.mean(white**2)), 0.0)))
        excess = TwoStateMultipath(model="two-state").mean_excess_m
        return ReflectionFit(
            core_mean_m=float(np.median(error)),
            direct_std_m=direct if direct > SHORTEST_CORE_M else 0.0,
            share=0.0,
            share_std=0.0,
            mean_excess_m=excess,
            life_s=None,
            life_spread=0.0,
            pair_share=np.zeros(count),
            pair_excess_m=np.full(count, excess),
            pair_life_s=np.full(count, np.nan),
            reflected=np.zeros(len(flight)),
        )
    core = np.hypot(white, direct)
    reflected = _responsibility(error, mean, core, excess, share)
    _, life = lasting(flight.time_s, pair, reflected, float(flight.time_s[-1]))
    pair_share, spread = _shares(flight, mean, core, excess, share, reflected)
    reflected = _responsibility(error, mean, core, excess, pair_share[pair])
    pair_life, life_spread = _lives(flight, reflected, life, pair_share)
    return ReflectionFit(
        core_mean_m=mean,
        direct_std_m=direct,
        share=share,
        share_std=spread,
        mean_excess_m=excess,
        life_s=life,
        life_spread=life_spread,
        pair_share=pair_share,
        pair_excess_m=_excesses(error - mean, reflected, pair, count, excess),
        pair_life_s=pair_life,
        reflected=reflected,
    )


def range_noise_m(flight: Flight, receive_noise_s: Floats) -> Floats:
    """Return the spread of a range whose stamps have a noise in seconds: c s sqrt((1 + r + r^2)/2) (docs/theory.md)."""
    spans = intervals(flight.exchanges)
    ratio = np.zeros(len(flight))
    if len(flight.row.messages) > 2:
        ratio = spans.dt32 / np.maximum(spans.dt53, 1.0)
    return np.asarray(SPEED_OF_LIGHT * receive_noise_s * np.sqrt((1 + ratio + ratio**2) / 2))


def _mixture(error: Floats, white: Floats) -> tuple[float, float, float, float]:
    """Return the core's mean, its spread beyond the white noise, the mean detour and the share of the tail."""
    thin = some_rows(len(error), 30_000)
    error, white = error[thin], white[thin]
    scale = max(bulk_spread(error), SHORTEST_CORE_M)

    def unpack(at: Floats) -> tuple[float, float, float, float]:
        return float(at[0]), float(np.exp(at[1])), float(np.exp(at[2])), float(1 / (1 + np.exp(-at[3])))

    def loss(at: Floats) -> float:
        mean, direct, excess, share = unpack(at)
        return -float(np.mean(np.logaddexp(*_log_densities(error, mean, np.hypot(white, direct), excess, share))))

    tries = []
    for guess in (0.05, 0.3):
        start = np.array([np.median(error) - 0.2 * scale, np.log(0.5 * scale), np.log(4 * scale), np.log(guess)])
        tries.append(
            minimize(loss, start, method="Nelder-Mead", options={"maxiter": 600, "xatol": 1e-3, "fatol": 1e-7})
        )
    mean, direct, excess, share = unpack(min(tries, key=lambda one: float(one.fun)).x)
    return mean, (direct if direct > SHORTEST_CORE_M else 0.0), excess, share


def _is_a_tail(error: Floats, white: Floats, mean: float, direct: float, excess: float, share: float) -> bool:
    """Return whether the tail explains more than a core alone, beyond what a few of its exchanges could by chance."""
    core, alone = np.hypot(white, direct), max(float(np.std(error)), SHORTEST_CORE_M)
    # Detours shorter than the spread of the core cannot be told from it.
    if excess < float(np.median(core)):
        return False
    with_tail = np.logaddexp(*_log_densities(error, mean, core, excess, share))
    without = -0.5 * ((error - error.mean()) / alone) ** 2 - np.log(alone * np.sqrt(2 * np.pi))
    return float(np.sum(with_tail - without)) > 8


def _log_densities(
    error: Floats, mean: float, core: Floats, excess: float, share: Floats | float
) -> tuple[Floats, Floats]:
    """Return the logarithms of the densities of direct ranges (normal) and of reflected (normal plus exponential)."""
    core = np.maximum(core, SHORTEST_CORE_M)
    share = np.clip(share, MIN_SHARE, 1 - MIN_SHARE)
    z, ratio = (error - mean) / core, core / excess
    direct = np.log1p(-share) - 0.5 * z**2 - np.log(core * np.sqrt(2 * np.pi))
    # Far in the tail by the normal's distribution; elsewhere by erfcx, which does not cancel.
    at = (ratio - z) / np.sqrt(2)
    with np.errstate(over="ignore", divide="ignore"):
        near = -0.5 * z**2 + np.log(erfcx(np.maximum(at, -5.0)) / 2)
    tail = np.where(at > -5.0, near, 0.5 * ratio**2 - ratio * z + log_ndtr(z - ratio)) - np.log(excess)
    return direct, np.asarray(np.log(share) + tail)


def _responsibility(error: Floats, mean: float, core: Floats, excess: float, share: Floats | float) -> Floats:
    """Return the probability that each range is reflected."""
    direct, reflected = _log_densities(error, mean, core, excess, share)
    return np.asarray(np.exp(reflected - np.logaddexp(direct, reflected)))


def _shares(
    flight: Flight, mean: float, core: Floats, excess: float, share: float, reflected: Floats
) -> tuple[Floats, float]:
    """Return the pairs' shares, drawn towards that of all, and their spread between pairs."""
    pair, count = flight.pair, len(flight.pairs)
    number = np.maximum(np.bincount(pair, minlength=count), 1)
    own = np.full(count, share)
    for _ in range(50):
        weight = _responsibility(flight.residual_m, mean, core, excess, own[pair])
        own = np.bincount(pair, weight, minlength=count) / number
    centred = reflected - (np.bincount(pair, reflected, minlength=count) / number)[pair]
    worth = effective_size(centred, pair) / len(pair)
    # What a range tells of its state is less than all of it where tail and core overlap.
    told = max(float(np.var(reflected)) / max(share * (1 - share), 1e-9), 0.05)
    noise = share * (1 - share) / np.maximum(number * worth * told, 1.0)
    between = _between(own, noise)
    return _drawn_together(own, noise, share, between), float(np.sqrt(between))


def _between(value: Floats, noise: Floats) -> float:
    """Return the variance between pairs that noise (variances) does not explain."""
    if len(value) < 3:
        return 0.0
    weight = 1 / noise
    mean = np.sum(weight * value) / np.sum(weight)
    excess = np.sum(weight * (value - mean) ** 2) - (len(value) - 1)
    return float(max(excess / (np.sum(weight) - np.sum(weight**2) / np.sum(weight)), 0.0))


def _drawn_together(value: Floats, noise: Floats, middle: float, between: float) -> Floats:
    if between <= 0:
        return np.full(len(value), middle)
    return np.asarray((value / noise + middle / between) / (1 / noise + 1 / between))


def _excesses(error: Floats, reflected: Floats, pair: Ints, count: int, excess: float) -> Floats:
    """Return the pairs' mean detours, drawn towards that of all."""
    weight = np.bincount(pair, reflected, minlength=count)
    own = np.bincount(pair, reflected * error, minlength=count) / np.maximum(weight, 1e-9)
    scale = excess / (float(np.sum(reflected * error)) / max(float(np.sum(reflected)), 1e-9))
    worth = effective_size(reflected * error, pair) / len(pair)
    noise = excess**2 / np.maximum(weight * worth, 0.5)
    return np.maximum(_drawn_together(own * scale, noise, excess, _between(own * scale, noise)), 0.1 * excess)


def _lives(flight: Flight, reflected: Floats, life_s: float | None, share: Floats) -> tuple[Floats, float]:
    """Return the lives of pairs, drawn towards that of all, and their spread in logarithms."""
    count = len(flight.pairs)
    if life_s is None:
        return np.full(count, np.nan), 0.0
    span = float(flight.time_s[-1])
    own, noise, told = np.full(count, np.log(life_s)), np.full(count, 1e6), np.zeros(count, dtype=bool)
    for k in range(count):
        rows = np.flatnonzero(flight.pair == k)
        spells = 2 * share[k] * (1 - share[k]) * span / life_s
        if len(rows) < 30 or spells < 6:
            continue
        _, mine = lasting(flight.time_s[rows], np.zeros(len(rows), np.int64), reflected[rows], span)
        if mine is not None:
            own[k], noise[k], told[k] = np.log(mine), 2 / spells + 0.01, True
    between = _between(own[told], noise[told]) if np.any(told) else 0.0
    return np.exp(_drawn_together(own, noise, np.log(life_s), between)), float(np.sqrt(between))
