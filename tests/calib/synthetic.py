"""Ranges with planted delays and curve, made without the simulator."""

from typing import Any

import numpy as np

from calib import Calibration, Ranges
from calib.calibration.power_curves import Curve
from uwblink.ticks import SPEED_OF_LIGHT

DELAYS_NS = {1: -0.36, 2: 0.05, 3: 0.24, 7: -0.11}
PAIRS = [(1, 2), (1, 3), (1, 7), (2, 3), (2, 7), (3, 7)]


def bias_m(lifted):
    return 0.08 * np.sin(4 * lifted) - 0.03


def lifted(fpp1_dbm, fpp2_dbm):
    """Return the mean lifted powers of both ends."""
    return (10 ** ((fpp1_dbm + 82) / 10) + 10 ** ((fpp2_dbm + 82) / 10)) / 2


def ranges(n=6000, noise_m=0.05, tail=0.1, seed=1, k=1.00001, bias=bias_m):
    rng = np.random.default_rng(seed)
    initiator, target = np.array(PAIRS)[np.arange(n) % len(PAIRS)].T
    fpp = rng.uniform(-95, -80, (2, n))
    truth = rng.uniform(1, 6, n)
    delay = np.array([DELAYS_NS.get(t, np.nan) for t in range(8)])
    raw = truth + bias(lifted(*fpp)) - 0.5e-9 * SPEED_OF_LIGHT * (delay[initiator] + k * delay[target])
    raw = raw + rng.normal(0, 1, n) * noise_m + np.where(rng.random(n) < tail, rng.exponential(0.4, n), 0)
    return Ranges(
        source="synthetic",
        time_ns=np.arange(n) * 5_000_000,
        initiator=initiator,
        target=target,
        protocol=np.full(n, "ds"),
        raw_m=raw,
        truth_m=truth,
        weight_initiator=np.full(n, 0.5),
        weight_target=np.full(n, 0.5 * k),
        fpp1_dbm=fpp[0],
        fpp2_dbm=fpp[1],
        excluded={},
        planted=None,
    )


def constant_curve(value_m):
    return Curve((0.0,) * 4 + (9.0,) * 4, (value_m,) * 4, 3, (0.0, 9.0))


def calibration(delays_ns: dict[int, float], sigma_m: float, **more: Any) -> Calibration:
    """Return a calibration with equal noise at all powers, no bias, and delays that are known exactly."""
    known: dict[str, Any] = {"delays_std_ns": dict.fromkeys(delays_ns, 0.0), "loss": "cauchy", "scale_ns": 0.1} | more
    return Calibration(
        delays_ns=delays_ns, lift="mean-of-lifted", alpha_dbm=-82.0, speed_of_light=SPEED_OF_LIGHT,
        bias_curve=constant_curve(0.0), sigma_curve=constant_curve(sigma_m), **known,
    )  # fmt: skip


def design(some, tags):
    """Return the explicit derivative of calibrated ranges by delays, in metres per nanosecond (n, tags)."""
    ends = (some.initiator, some.weight_initiator), (some.target, some.weight_target)
    return sum((ids[:, None] == np.array(tags)) * weight[:, None] for ids, weight in ends) * SPEED_OF_LIGHT * 1e-9


def about_their_mean(known: Calibration, planted: dict[int, float]):
    """Return errors of delays about their mean (tags,) and their standard errors, in ns, given planted delays."""
    centre = np.eye(len(planted)) - 1 / len(planted)
    error = centre @ [known.delays_ns[tag] - delay for tag, delay in planted.items()]
    return error, np.sqrt(np.diag(centre @ known.covariance_ns2(list(planted)) @ centre))


def largest_score(result, planted: dict[int, float]):
    """Return the largest error of a delay of a fit divided by its stated standard error, given planted delays in ns."""
    found = result.calibration
    return max(abs(delay - planted[tag]) / found.delays_std_ns[tag] for tag, delay in found.delays_ns.items())


def track_errors(track, after_s=0.0):
    """Return distances (n,) in metres between estimated and true positions from some seconds after the start on."""
    late = track.time_ns >= track.time_ns[0] + int(after_s * 1e9)
    return np.linalg.norm((track.estimate_m - track.truth_m)[late], axis=1)
