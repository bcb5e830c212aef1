"""Errors of simulated flights compared with measured ones, for docs/accuracy.md: by power, by pair, and of a twin."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.nlos import SHARED, of_real_flight, real_flight
from calib.calibration.formats import read_miluv
from calib.data.ranges import concatenate
from calib.data.sources import load_ranges
from calib.evaluation.statistics import evaluate
from calib.fitting.fitting import fit
from uwblink.arrays import Floats, Ints
from uwblink.ticks import SPEED_OF_LIGHT
from uwblink.twr import delay_weights, raw_range
from uwbsim import Simulated, twin

TAIL_M = 0.3
REJECTED = 3.9
"""Number of standard deviations; the published samples have no errors beyond it."""

GAP_S = 0.42
TUNED, PREDICTED = "tuned", "predicted"
Row = tuple[str, str, str, str]
"""Quantity, measured value, simulated value, and the origin of the latter."""


def error_rows(train: Simulated, one: Simulated, two: Simulated) -> list[Row]:
    with tempfile.TemporaryDirectory() as folder:
        parts = []
        for name, run in (("train", train), ("test1", one), ("test2", two)):
            run.save(Path(folder) / f"{name}.uwb")
            parts.append(load_ranges(Path(folder) / f"{name}.uwb"))
    tests = concatenate(parts[1:])
    error = tests.raw_m - tests.truth_m
    found = evaluate(tests, fit(parts[0]).calibration)
    accepted = [group.accepted for group in found.pairs.values()]
    return [
        (
            "raw range error of the tests: mean, std (cm)",
            "11.1, 19.0",
            f"{100 * error.mean():.1f}, {100 * error.std():.1f}",
            TUNED,
        ),
        (
            "calibrated, after a chi-square test at 95 %: largest mean and std of a pair (cm)",
            "at most about 4 and 8",
            f"{100 * max(abs(a.mean_m) for a in accepted):.1f} and {100 * max(a.std_m for a in accepted):.1f}",
            PREDICTED,
        ),
    ]


def power_rows(flight: Simulated) -> list[Row]:
    """Return rows on lifted powers, and on errors by power without antenna delays and outliers."""
    lifted, bias = np.loadtxt(SHARED / "icra2023_bias_fpp.csv", delimiter=",", skiprows=1).T
    edges = np.quantile(lifted, np.linspace(0, 1, 7))
    error, mine = _without_delays(flight), _lifted(flight)
    rows = [("lifted powers: 5, 25, 50, 75, 95 %", _listed(lifted), _listed(mine), TUNED)]
    theirs, ours = _by_power(bias, lifted, edges), _by_power(error, mine, edges)
    for what, figure, how in FIGURES:
        measured, simulated = (", ".join(f"{figure(part):.1f}" for part in found) for found in (theirs, ours))
        rows.append((what, measured, simulated, how))
    return rows


def _by_power(error: Floats, lifted: Floats, edges: Floats) -> list[Floats]:
    """Divide errors into classes of lifted power, without the outliers of each class."""
    parts = [error[(lifted >= low) & (lifted < high)] for low, high in itertools.pairwise(edges)]
    for _ in range(10):
        parts = [part[np.abs(part - part.mean()) < REJECTED * part.std()] for part in parts]
    return parts


def _mean_cm(error: Floats) -> float:
    return 100 * float(np.mean(error))


def _std_cm(error: Floats) -> float:
    return 100 * float(np.std(error))


FIGURES: Final[tuple[tuple[str, Callable[[Floats], float], str], ...]] = (
    ("after rejection: mean by power, in six classes of as many samples (cm)", _mean_cm, TUNED),
    ("the same: standard deviation (cm)", _std_cm, TUNED),
)


def _listed(lifted: Floats) -> str:
    return ", ".join(f"{v:.2f}" for v in np.quantile(lifted, [0.05, 0.25, 0.5, 0.75, 0.95]))


def _lifted(flight: Simulated) -> Floats:
    e = flight.exchanges
    return np.asarray((10 ** ((e.fpp1_dbm + 82) / 10) + 10 ** ((e.fpp2_dbm + 82) / 10)) / 2)


def _without_delays(flight: Simulated) -> Floats:
    e = flight.exchanges
    delay = np.zeros(256)
    for tag, planted in flight.planted["delays_ns"].items():
        delay[int(tag)] = planted * 1e-9
    weights = delay_weights(e)
    shift = SPEED_OF_LIGHT * (weights[0] * delay[e.initiator] + weights[1] * delay[e.target])
    return np.asarray(raw_range(e) + shift - flight.truth_m)


def dependence_rows(flight: Simulated) -> list[Row]:
    """Return rows on the dependence of errors of a pair in time: real flight, test1, and test1 at a high rate."""
    e, real = flight.exchanges, of_real_flight(SHARED)
    pair, error = e.initiator * 1000 + e.target, raw_range(e) - flight.truth_m
    seldom = _every(GAP_S, e.time_ns, pair)
    its_pair = np.minimum(real.initiator, real.target) * 1000 + np.maximum(real.initiator, real.target)
    its_error = real.raw_m - real.truth_m
    lags = lag_one(error[seldom], pair[seldom]), lag_one(error, pair)
    return [
        (
            "autocorrelation of a pair's errors to its next range (real: 5 to 12 a pair, 15 s apart; "
            f"test1: {GAP_S:g} s and 75 ms apart)",
            f"{lag_one(its_error, its_pair):.2f}",
            ", ".join(f"{lag:.2f}" for lag in lags),
            PREDICTED,
        ),
        (
            "errors more than 30 cm above the pair's median",
            f"{100 * np.mean(_above(its_error, its_pair) > TAIL_M):.0f} %",
            f"{100 * np.mean(_above(error, pair) > TAIL_M):.0f} %",
            PREDICTED,
        ),
        (
            "how much weaker the first paths of these are (dB)",
            f"{trace_db(_above(its_error, its_pair), real.fpp1_dbm):.1f}",
            f"{trace_db(_above(error, pair), e.fpp1_dbm):.1f}",
            TUNED,
        ),
    ]


def _every(gap_s: float, time_ns: Ints, pair: Ints) -> Ints:
    """Return rows of exchanges such that those of a pair are at least some seconds apart."""
    chosen: list[int] = []
    last: dict[int, int] = {}
    for row, (time, key) in enumerate(zip(time_ns.tolist(), pair.tolist(), strict=True)):
        if time - last.get(key, -(10**18)) >= gap_s * 1e9:
            last[key] = time
            chosen.append(row)
    return np.array(chosen, dtype=np.int64)


def _above(error: Floats, pair: Ints) -> Floats:
    """Return errors minus the medians of their pairs."""
    found = error.copy()
    for key in np.unique(pair):
        found[pair == key] -= np.median(found[pair == key])
    return found


def lag_one(error: Floats, pair: Ints) -> float:
    """Return the autocorrelation of successive errors of a pair, limited to one metre."""
    above = below = 0.0
    for key in np.unique(pair):
        mine = error[pair == key]
        mine = np.clip(mine - np.median(mine), -1, 1)
        above, below = above + float(mine[1:] @ mine[:-1]), below + float(mine[1:] @ mine[1:])
    return above / below


def trace_db(error: Floats, power_dbm: Floats) -> float:
    """Return the median first-path power of reflected ranges relative to that of the others."""
    tail = error - np.median(error) > TAIL_M
    return float(np.median(power_dbm[~tail]) - np.median(power_dbm[tail]))


def twin_verdicts() -> list[str]:
    """Return, for each verdict, the quantities of the real flight and its twin, with their largest differences."""
    found = twin(real_flight(SHARED), read_miluv(SHARED / "miluv_published_calibration.json"))
    quantities: dict[str, list[str]] = {}
    for one in found.compare(seeds=3):
        quantities.setdefault(one.verdict, []).append(f"{one.name} ({100 * one.distance:.0f} %)")
    return [f"{verdict}: {', '.join(names)}" for verdict, names in quantities.items()]
