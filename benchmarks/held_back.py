"""The published samples of ICRA 2023, partly held back from the fit: errors of the curve, and of the total sigma.

The samples of `icra2023_bias_fpp.csv` have neither pair nor time, and their delays are corrected already. They are
assigned to three tags at random, in a random order, so that a fit estimates only the curve and the error model.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import calib
from calib.data.ranges import Ranges

Floats = NDArray[np.float64]
Chosen = NDArray[np.bool_]

PARTS: Final = 5
"""Number of parts of equal counts by power, each held back once."""

DEGREE: Final = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldBack:
    """Results on samples that were held back: z-scores by the total sigma, and errors compared with a cubic polynomial.

    `z_std` should be 1, `inside_95` 0.95; `left_m` is the mean error minus the expectation of the error model,
    `cubic_left_m` the mean error after a cubic polynomial fitted by least squares.
    """

    z_std: float
    inside_95: float
    rms_m: float
    cubic_rms_m: float
    mean_m: float
    left_m: float
    cubic_left_m: float


def samples(path: Path) -> tuple[Floats, Floats]:
    """Return lifted powers and biases in metres (n,)."""
    lifted, bias = np.loadtxt(path, delimiter=",", skiprows=1).T
    return lifted, bias


def as_ranges(lifted: Floats, bias: Floats, seed: int) -> Ranges:
    """Assign samples to three tags, in a random order, at 100 per second."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(lifted))
    pair = np.array([(1, 2), (2, 3), (1, 3)])[rng.integers(0, 3, len(order))]
    truth, power = rng.uniform(1, 5, len(order)), -82 + 10 * np.log10(lifted[order])
    return Ranges.from_arrays(
        truth + bias[order],
        truth_m=truth,
        initiator=pair[:, 0],
        target=pair[:, 1],
        fpp1_dbm=power,
        fpp2_dbm=power,
        time_ns=np.arange(len(order)) * 10_000_000,
    )


def judged(lifted: Floats, bias: Floats, held: Chosen) -> HeldBack:
    """Fit the samples that are not `held` back, and evaluate the others."""
    known = calib.fit(as_ranges(lifted[~held], bias[~held], 1), between_m=0.0).calibration
    others = as_ranges(lifted[held], bias[held], 2)
    applied, overall = known.apply(others), calib.evaluate(others, known).overall
    error = applied.corrected_m - others.truth_m
    polynomial: Any = np.polynomial.polynomial
    cubic = bias[held] - polynomial.polyval(lifted[held], polynomial.polyfit(lifted[~held], bias[~held], DEGREE))
    return HeldBack(
        z_std=overall.total_std,
        inside_95=overall.inside_95,
        rms_m=float(np.sqrt(np.mean(error**2))),
        cubic_rms_m=float(np.sqrt(np.mean(cubic**2))),
        mean_m=float(np.mean(error)),
        left_m=float(np.mean(error - applied.mean_error_m)),
        cubic_left_m=float(np.mean(cubic)),
    )


def every_second(lifted: Floats) -> Chosen:
    """Hold back every second sample, in order of power."""
    return np.asarray(np.arange(len(lifted)) % 2 == 1)


def parts(lifted: Floats) -> list[Chosen]:
    """Hold back each of several parts of the power range."""
    edges = np.quantile(lifted, np.linspace(0, 1, PARTS + 1))
    return [(lifted >= low) & (lifted <= high) for low, high in pairwise(edges)]


def rows(path: Path) -> list[str]:
    """Return the rows of a table."""
    lifted, bias = samples(path)
    held = {"every second": every_second(lifted)}
    for number, part in enumerate(parts(lifted), 1):
        held[f"fifth {number} of powers" + (", beyond the fitted ones" if number in (1, PARTS) else "")] = part
    found = {name: judged(lifted, bias, chosen) for name, chosen in held.items()}
    return [
        '| held back | z-std | "95 %" holds | rms (mm) | a plain cubic\'s rms | mean | mean, less what is expected |',
        "|---|---|---|---|---|---|---|",
        *(
            f"| {name} | {one.z_std:.2f} | {100 * one.inside_95:.1f} % | {1e3 * one.rms_m:.1f} | "
            f"{1e3 * one.cubic_rms_m:.1f} | {1e3 * one.mean_m:+.1f} | {1e3 * one.left_m:+.1f} |"
            for name, one in found.items()
        ),
    ]
