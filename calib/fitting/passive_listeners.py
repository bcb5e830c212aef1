"""Antenna delays from overheard exchanges: what a passive listener says of the target's delay, all by itself.

A listener k hears the poll and the response. Between the two at the target's antenna lies the target's reply
dt32 - d_j; so between their arrivals at k, in the target's clock, lies tof_ij + dt32 - d_j + tof_jk - tof_ik, and

    d_j = tof_ij + tof_jk - tof_ik + dt32 - K_k (rx2 - rx1)_k,    K_k = (tx3 - tx2)_j / (rx3 - rx2)_k.

The listener's own delay drops out, and so does the initiator's: no graph of pairs is needed, and anchors that range
with tags alone are determined too. What no recording of free-running clocks determines is how a delay splits into
transmission and reception: moving a tag's clock by a moves its transmissions and receptions alike (docs/theory.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calib.calibration.model import Calibration
from calib.calibration.power_curves import lift
from calib.data.sources import Data, opened
from calib.estimator.grouped_errors import fit_grouped_errors
from calib.estimator.range_model import METRES_A_NS
from uwblink.arrays import Floats
from uwblink.protocols.table import third_from_target
from uwblink.recording.distances import distances_m
from uwblink.ticks import REPORT_BITS, SPEED_OF_LIGHT, TICK_S, elapsed

MIN_OF_DELAY: Final = 50
"""Ranges or receptions for the delay of one tag: their mean is known to a seventh of the noise, 0.03 ns."""
PLAUSIBLE_NS: Final = 100.0
"""Longer delays come of wrong stamps: published ones are below 1 ns, beside those that are programmed."""


@dataclass(frozen=True, slots=True)
class OverheardDelay:
    """The delay of a target as its listeners see it, in ns: centre of the core, its standard error, how many heard."""

    delay_ns: float
    std_ns: float
    count: int


def heard_delays(data: Data, calibration: Calibration) -> dict[int, OverheardDelay]:
    """Return delays by tag from the overheard exchanges of a recording; empty where it has none, or no true distances.

    Only protocols whose third message comes from the target are of use: its two transmissions tell the listener how
    fast the target's clock runs. The bias curve of the calibration corrects each of the three receptions.
    """
    with opened(data) as (_, source):
        heard = getattr(source, "overheard", None)
        if not heard or not len(heard["time_ns"]):
            return {}
        poses, tags = source.poses, list(source.tags)
        protocols = set(np.unique(source.exchanges.protocol).tolist())
    if not len(poses) or set(third_from_target(protocols)) != protocols:
        return {}
    sides = [("initiator", "target"), ("target", "listener"), ("initiator", "listener")]
    near, away, across = (distances_m(poses, tags, heard[a], heard[b], heard["time_ns"]) for a, b in sides)
    bias_s = [
        calibration.bias_curve(lift(heard[name], calibration.alpha_dbm)) / SPEED_OF_LIGHT
        for name in ("fpp1_n_dbm", "fpp1_dbm", "fpp2_dbm")
    ]
    reply = _span(heard, "tx2_n", "rx1_n") + bias_s[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = _span(heard, "tx3_n", "tx2_n") / _span(heard, "rx3", "rx2")
    arrival = _span(heard, "rx2", "rx1") + bias_s[1] - bias_s[2]
    delay_ns = 1e9 * ((near + away - across) / SPEED_OF_LIGHT + reply - ratio * arrival)
    good = np.isfinite(delay_ns) & (np.abs(delay_ns) < PLAUSIBLE_NS)
    found = {}
    for tag in np.unique(heard["target"]).tolist():
        values = delay_ns[good & (heard["target"] == tag)]
        if len(values) >= MIN_OF_DELAY:
            # Reflections lengthen three receptions: two of them shorten the delay, one lengthens it. The balance is a
            # tail on the short side, which the likelihood of ranges tells from noise when the sign is changed.
            parts = fit_grouped_errors([-values * METRES_A_NS])
            centre_ns, std_ns = -float(parts.centre_m[0]) / METRES_A_NS, float(parts.centre_std_m[0]) / METRES_A_NS
            found[int(tag)] = OverheardDelay(centre_ns, std_ns, len(values))
    return found


def _span(heard: dict[str, NDArray[Any]], later: str, earlier: str) -> Floats:
    ticks = elapsed(heard[later].astype(np.int64), heard[earlier].astype(np.int64), REPORT_BITS)
    return ticks.astype(np.float64) * TICK_S
