"""Worlds for the evaluation of fits, which share no code with the simulator and no assumption with the fit.

A world consists of ranges and true values. Bodies move on sums of sines; powers depend on distance, antennas that turn,
and little noise; each range has a bias and noise that depend on power, the detour of a reflection if its pair has one
at that time, and an error that changes slowly. Distributions differ from those of the estimator: detours have a gamma
distribution or two kinds, the detour of a reflection is constant while it lasts, and noise has slightly heavier tails
than a normal distribution. Seeds below `FIRST_REPORTED` were used to choose defaults of the fit; only later ones are
reported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from calib.data.ranges import Ranges

Floats = NDArray[np.float64]

FIRST_REPORTED: Final = 10_000
"""Seeds from here on were not used for tuning."""

LIGHT_M_PER_NS: Final = 0.299702547


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """Parameters of a world; times are in seconds, lengths in metres, powers in dB.

    `share` is the share of reflected ranges, or bounds between which each pair draws its own. A reflection lasts
    `lasts_s` on average (0: each range is independent). `by_power` is the part of the share that depends on low power
    (0 to 1). The antenna of tag 2 is `lever_m` from the place on its body that true distances assume. `offset_m` is the
    standard deviation of a constant error of each pair.
    """

    tags: int = 5
    seconds: float = 240.0
    per_second: float = 160.0
    share: tuple[float, float] = (0.1, 0.1)
    lasts_s: float = 0.0
    by_power: float = 0.0
    detour: str = "exponential"
    detour_m: float = 0.34
    wander_m: float = 0.0
    wander_s: float = 3.0
    power_spread_db: float = 3.0
    noise_m: float = 0.06
    unequal_noise: float = 0.0
    lever_m: float = 0.0
    offset_m: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    """Ranges with the true values: delays by tag in ns, and the bias in metres over lifted power."""

    ranges: Ranges
    delays_ns: dict[int, float]
    bias_m: Callable[[Floats], Floats]
    lifted: Floats
    notes: dict[str, Any] = field(default_factory=dict)


def bias_m(lifted: Floats) -> Floats:
    """Return the bias at lifted powers: steep at low power, nearly linear above, and not a spline."""
    return np.asarray(0.16 * np.exp(-lifted / 0.35) - 0.035 * lifted + 0.012 * np.sin(2.5 * lifted))


def sigma_m(lifted: Floats, noise_m: float) -> Floats:
    """Return the noise at lifted powers."""
    return np.asarray(noise_m * (0.7 + 0.6 / (1 + 2 * lifted)))


def make(recipe: Recipe, seed: int, flight: int = 0) -> World:
    """Draw a world; with another `flight`, boards and walls are the same, and motion, reflections and noise are new."""
    rng = np.random.default_rng([seed, 90_210, flight] if flight else [seed, 90_210])
    known = make(recipe, seed).notes if flight else {}
    count = int(recipe.seconds * recipe.per_second)
    pairs = np.array(list(combinations(range(1, recipe.tags + 1), 2)))
    time_s = np.sort(rng.uniform(0, recipe.seconds, count))
    which = rng.integers(0, len(pairs), count)
    swap = rng.random(count) < 0.5
    first, second = np.where(swap[:, None], pairs[which][:, ::-1], pairs[which]).T
    truth = _distance(rng, recipe, time_s, first, second)
    powers = _powers(rng, recipe, time_s, first, second, truth)
    lifted = np.mean(10 ** ((powers + 82) / 10), axis=0)
    delays = known.get("delays_ns", np.concatenate([[0.0], rng.uniform(-0.4, 0.3, recipe.tags)]))
    skew = known.get("skew", rng.normal(0, 3e-6, recipe.tags + 1))
    ratio = (1 + skew[first]) / (1 + skew[second])
    noisy = known.get("noisy", np.exp(recipe.unequal_noise * rng.normal(size=recipe.tags + 1)))
    scale = np.sqrt((noisy[first] ** 2 + noisy[second] ** 2) / 2)
    error = bias_m(lifted) + sigma_m(lifted, recipe.noise_m) * scale * rng.standard_t(12, count) * np.sqrt(10 / 12)
    shares = known.get("shares", rng.uniform(*recipe.share, len(pairs)))
    error += _detours(rng, recipe, time_s, which, shares, lifted)
    error += _wander(rng, recipe, time_s, which, len(pairs))
    error += recipe.offset_m * np.random.default_rng([seed, 35]).normal(size=len(pairs))[which]
    raw = truth + error - LIGHT_M_PER_NS * (0.5 * delays[first] + 0.5 * ratio * delays[second])
    ranges = Ranges(
        source=f"world {seed}",
        time_ns=np.rint(time_s * 1e9).astype(np.int64),
        initiator=first.astype(np.int64),
        target=second.astype(np.int64),
        protocol=np.full(count, "ds"),
        raw_m=raw,
        truth_m=truth - _elsewhere(recipe, time_s, first, second),
        weight_initiator=np.full(count, 0.5),
        weight_target=0.5 * ratio,
        fpp1_dbm=powers[0],
        fpp2_dbm=powers[1],
        excluded={},
        planted=None,
    )
    return World(
        ranges=ranges,
        delays_ns={tag: float(delays[tag]) for tag in range(1, recipe.tags + 1)},
        bias_m=bias_m,
        lifted=lifted,
        notes={"delays_ns": delays, "skew": skew, "noisy": noisy, "shares": shares},
    )


def _elsewhere(recipe: Recipe, time_s: Floats, first: Any, second: Any) -> Floats:
    """Return the increase of distances of tag 2, whose body turns, by the error of its lever arm."""
    other = np.where(first == 2, second, first)
    toward = np.cos(0.5 * time_s + 2 * np.pi * other / recipe.tags)
    return np.asarray(recipe.lever_m * toward * ((first == 2) | (second == 2)))


def _distance(rng: np.random.Generator, recipe: Recipe, time_s: Floats, first: Any, second: Any) -> Floats:
    """Return distances between bodies that move about their own positions."""
    angle = 2 * np.pi * (np.arange(recipe.tags + 1) + rng.uniform(0, 0.5, recipe.tags + 1)) / recipe.tags
    place = np.column_stack([3 * np.cos(angle), 3 * np.sin(angle), rng.uniform(0.5, 2, recipe.tags + 1)])
    found = np.zeros((2, len(time_s), 3))
    rates = rng.uniform(0.15, 1.4, (recipe.tags + 1, 3, 4))
    phases = rng.uniform(0, 2 * np.pi, rates.shape)
    sizes = rng.uniform(0.2, 0.7, rates.shape) / (0.5 + rates)
    for end, ids in enumerate((first, second)):
        for tag in range(1, recipe.tags + 1):
            rows = np.flatnonzero(ids == tag)
            waves = np.sin(rates[tag][None] * time_s[rows, None, None] + phases[tag][None]) * sizes[tag][None]
            found[end, rows] = place[tag] + waves.sum(axis=2)
    return np.asarray(np.maximum(np.linalg.norm(found[0] - found[1], axis=1), 0.4))


def _powers(rng: np.random.Generator, recipe: Recipe, time_s: Floats, first: Any, second: Any, truth: Floats) -> Floats:
    """Return first-path powers at both ends (2, n): distance, antennas that turn, and noise."""
    spread = recipe.power_spread_db
    turning = rng.uniform(0.3, 2.0, (recipe.tags + 1, 3))
    phase = rng.uniform(0, 2 * np.pi, turning.shape)
    gain = np.zeros(len(time_s))
    for ids in (first, second):
        gain += np.sin(turning[ids] * time_s[:, None] + phase[ids] + 0.5 * truth[:, None]).sum(axis=1)
    shared = -81.5 - 20 * np.log10(truth / 4.0) * min(spread / 3, 1) + gain * spread / 3
    return np.asarray(shared + rng.normal(0, 0.15 * spread + 0.1, (2, len(time_s))))


def _detours(
    rng: np.random.Generator, recipe: Recipe, time_s: Floats, which: Any, shares: Floats, lifted: Floats
) -> Floats:
    """Return the detours of reflections for each range; their share depends on the pair."""
    count = len(time_s)
    if not recipe.lasts_s:
        weak = 1 / (1 + (lifted / np.median(lifted)) ** 2)
        likely = shares[which] * (1 - recipe.by_power + 2 * recipe.by_power * weak)
        return np.asarray(np.where(rng.random(count) < likely, _lengths(rng, recipe, count), 0.0))
    found = np.zeros(count)
    for pair in range(len(shares)):
        rows, share = np.flatnonzero(which == pair), float(np.clip(shares[pair], 1e-3, 0.95))
        for begin, end in reflected_s(rng, share, recipe.lasts_s, recipe.seconds):
            some = rows[(time_s[rows] >= begin) & (time_s[rows] < end)]
            # A wall has one detour, about which ranges vary by a third.
            found[some] = _lengths(rng, recipe, 1)[0] * rng.gamma(9, 1 / 9, len(some))
    return found


def reflected_s(
    rng: np.random.Generator, share: float, lasts_s: float, seconds: float
) -> Iterator[tuple[float, float]]:
    """Draw the intervals in which a pair is reflected: a `share` of the time, on average `lasts_s` long each."""
    now, reflected = 0.0, rng.random() < share
    while now < seconds:
        until = now + rng.exponential(lasts_s if reflected else lasts_s * (1 - share) / share)
        if reflected:
            yield now, until
        now, reflected = until, not reflected


def _lengths(rng: np.random.Generator, recipe: Recipe, count: int) -> Floats:
    kinds: dict[str, Callable[[], Floats]] = {
        "exponential": lambda: rng.exponential(recipe.detour_m, count),
        "gamma": lambda: rng.gamma(2.0, recipe.detour_m / 2, count),
        "two kinds": lambda: np.where(rng.random(count) < 0.6, 0.22, 0.75) * rng.gamma(16, 1 / 16, count),
    }
    return kinds[recipe.detour]()


def _wander(rng: np.random.Generator, recipe: Recipe, time_s: Floats, which: Any, pairs: int) -> Floats:
    """Return an error of each pair with the correlation time `wander_s` (Ornstein-Uhlenbeck process)."""
    found = np.zeros(len(time_s))
    if not recipe.wander_m:
        return found
    step = recipe.wander_s / 30
    grid = np.arange(0, recipe.seconds + 2 * step, step)
    keep = np.exp(-step / recipe.wander_s)
    for pair in range(pairs):
        first, kicks = rng.normal(), rng.normal(size=len(grid)) * np.sqrt(1 - keep**2)
        path = lfilter([1.0], [1.0, -keep], np.append(first, kicks[1:]))
        rows = which == pair
        found[rows] = recipe.wander_m * np.interp(time_s[rows], grid, path)
    return found


CLEAN: Final[dict[str, Recipe]] = {
    "iid": Recipe(),
    "iid, detours of two kinds": Recipe(detour="two kinds"),
    "share by pair": Recipe(share=(0, 0.5)),
    "share by pair, 4 times the data": Recipe(share=(0, 0.5), seconds=960),
    "share by pair, gamma detours": Recipe(share=(0, 0.5), detour="gamma"),
    "share by pair, two kinds": Recipe(share=(0, 0.5), detour="two kinds"),
    "persistent 1 s, 2 cm over 3 s, 30 s": Recipe(lasts_s=1, wander_m=0.02, wander_s=3, seconds=30),
    "persistent 1 s, 2 cm over 3 s, 90 s": Recipe(lasts_s=1, wander_m=0.02, wander_s=3, seconds=90),
    "persistent 1 s, 2 cm over 3 s, 240 s": Recipe(lasts_s=1, wander_m=0.02, wander_s=3),
    "persistent 1 s, 2 cm over 3 s, 600 s": Recipe(lasts_s=1, wander_m=0.02, wander_s=3, seconds=600),
    "persistent 5 s, 4 cm over 10 s, 90 s": Recipe(lasts_s=5, wander_m=0.04, wander_s=10, seconds=90),
    "persistent 5 s, 4 cm over 10 s, 240 s": Recipe(lasts_s=5, wander_m=0.04, wander_s=10),
    "persistent 2 s, share by pair": Recipe(lasts_s=2, share=(0, 0.5), detour="gamma"),
    "share by power": Recipe(share=(0.2, 0.2), by_power=0.9),
    "narrow power": Recipe(power_spread_db=0.7),
    "short, 30 s": Recipe(seconds=30),
    "twenty tags": Recipe(tags=20),
    "three tags": Recipe(tags=3),
    "unequal noise": Recipe(unequal_noise=0.4),
    "a lever arm 2 cm off": Recipe(lever_m=0.02),
    "pairs off by 3 cm, four tags": Recipe(tags=4, offset_m=0.03),
    "pairs off by 3 cm, eight tags": Recipe(tags=8, offset_m=0.03),
    "twelve tags, six ranges a pair": Recipe(tags=12, seconds=78, per_second=5, share=(0, 0.5)),
}


def remade(world: World, **columns: Any) -> World:
    """Return a world with other columns in its ranges."""
    return replace(world, ranges=replace(world.ranges, **columns))


def _pair(world: World, first: int, second: int) -> Any:
    """Return a mask of the ranges of a pair."""
    low = np.minimum(world.ranges.initiator, world.ranges.target)
    high = np.maximum(world.ranges.initiator, world.ranges.target)
    return (low == min(first, second)) & (high == max(first, second))


def _of(world: World, tag: int) -> Any:
    """Return a mask of the ranges of a tag."""
    return (world.ranges.initiator == tag) | (world.ranges.target == tag)


def _longer(world: World, rows: Any, metres: Any) -> World:
    """Return a world in which some ranges are longer."""
    return remade(world, raw_m=world.ranges.raw_m + np.where(rows, metres, 0.0))


def _noisy(world: World, times: float) -> World:
    """Multiply the noise of one end, a tag: it causes half of the variance of a range."""
    rng = np.random.default_rng(5)
    more = sigma_m(world.lifted, 0.06) * np.sqrt((times**2 - 1) / 2)
    return _longer(world, _of(world, 2), more * rng.normal(size=len(more)))


def _reflected(world: World) -> World:
    rng = np.random.default_rng(6)
    count = len(world.ranges)
    return _longer(world, _of(world, 2) & (rng.random(count) < 0.5), rng.gamma(2.0, 0.17, count))


def _louder(world: World) -> World:
    """Let one tag read the powers of its receptions 3 dB too high."""
    first = world.ranges.fpp1_dbm + 3.0 * (world.ranges.initiator == 2)
    second = world.ranges.fpp2_dbm + 3.0 * (world.ranges.target == 2)
    return remade(world, fpp1_dbm=first, fpp2_dbm=second)


def _late(world: World, part: float) -> Any:
    time = world.ranges.time_ns
    return time > time[0] + part * (time[-1] - time[0])


def _skewed(world: World, reply_s: float, times: float) -> World:
    """Add relative clock skew times half of the reply time to ranges: single-sided ones without carrier correction, or
    with twice that.
    """
    skew = np.random.default_rng(7).normal(0, 4e-6, 100)
    both = skew[world.ranges.initiator] - skew[world.ranges.target]
    wrong = times * 0.5 * both * reply_s * 1e9 * LIGHT_M_PER_NS
    return replace(
        _longer(world, True, wrong),
        ranges=replace(_longer(world, True, wrong).ranges, protocol=np.full(len(both), "ss-cfo")),
    )


def _wrapped(world: World) -> World:
    """Lose a wrap of 67.2 ms in third intervals of 80 ms: the ratio of clock rates is six times as far from one."""
    skew = 2 * world.ranges.weight_target - 1
    ratio = (80 * (1 + skew) - 67.2) / (80 - 67.2)
    wrong = -0.5 * (ratio - 1 - skew) * 305e-6 * 1e9 * LIGHT_M_PER_NS
    return replace(world, ranges=replace(_longer(world, True, wrong).ranges, weight_target=0.5 * ratio))


def _swapped(world: World) -> World:
    """Exchange receptions and transmissions: reply times are taken for flights, with the jitter of boards of some
    ticks.
    """
    rng = np.random.default_rng(8)
    raw = -world.ranges.raw_m + 4.2 + rng.normal(0, 0.3, len(world.ranges))
    return remade(world, raw_m=raw)


PLANTED: Final[dict[str, Callable[[World], World]]] = {
    "one pair of four tags reads 45 cm long": lambda w: _longer(w, _pair(w, 1, 2), 0.45),
    "one pair of six tags off by 5 cm": lambda w: _longer(w, _pair(w, 2, 5), 0.05),
    "one pair of six tags off by 15 cm": lambda w: _longer(w, _pair(w, 2, 5), 0.15),
    "a tag with 2 times the noise": lambda w: _noisy(w, 2),
    "a tag with 3 times the noise": lambda w: _noisy(w, 3),
    "a tag with 5 times the noise": lambda w: _noisy(w, 5),
    "a tag with 10 times the noise": lambda w: _noisy(w, 10),
    "truth in millimetres": lambda w: remade(w, truth_m=w.ranges.truth_m * 1000),
    "truth in feet": lambda w: remade(w, truth_m=w.ranges.truth_m / 0.3048),
    "carrier with the opposite sign": lambda w: _skewed(w, 1.5e-3, 2.0),
    "third leg longer than a wrap": _wrapped,
    "88 % left out": lambda w: remade(w, excluded={"no power": 8 * len(w.ranges)}),
    "transmissions and receptions swapped": _swapped,
    "half of a tag's ranges reflected": _reflected,
    "a tag 3 dB high": _louder,
    "a step of 0.3 ns in a tag": lambda w: _longer(w, _of(w, 2) & _late(w, 0.5), 0.045),
    "a tag remounted": lambda w: _longer(w, _of(w, 2) & _late(w, 0.4), -0.06),
    "all times zero": lambda w: remade(w, time_ns=np.zeros_like(w.ranges.time_ns)),
    "one pair off by 30 cm for a third of the time": lambda w: _longer(w, _pair(w, 1, 3) & _late(w, 0.67), 0.30),
    "a tag drifts by 0.3 ns": lambda w: _longer(w, _of(w, 3), 0.045 * np.linspace(-1, 1, len(w.ranges))),
    "uncorrected skew": lambda w: _skewed(w, 0.3e-3, 1.0),
    "truth 2 % short": lambda w: remade(w, truth_m=w.ranges.truth_m * 0.98),
    "truth in yards": lambda w: remade(w, truth_m=w.ranges.truth_m / 0.9144),
    "truth of another pair": lambda w: remade(
        w, truth_m=np.where(_pair(w, 1, 2), np.roll(w.ranges.truth_m, 7), w.ranges.truth_m)
    ),
    "truth late by 0.3 s": lambda w: remade(w, truth_m=np.roll(w.ranges.truth_m, 480)),
    "antenna delays of 514 ns not configured": lambda w: _longer(w, True, 154.0),
    "two pairs off by 12 and -9 cm": lambda w: _longer(_longer(w, _pair(w, 1, 2), 0.12), _pair(w, 3, 4), -0.09),
    "a tag short by 20 cm for a tenth": lambda w: _longer(w, _of(w, 4) & _late(w, 0.9), -0.20),
    "a tag's delay goes with power": lambda w: _longer(w, _of(w, 1), 0.06 * np.tanh(np.log(w.lifted))),
}
"""Faults of a recording, from obvious to hidden; delays remain those before the fault."""

PLANTED_TAGS: Final = {"one pair of four tags reads 45 cm long": 4, "one pair of six tags off by 5 cm": 6}
"""Number of tags of worlds that do not have five."""
