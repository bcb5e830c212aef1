"""Detection of reflected ranges by features of their receptions: simulated rooms that were left out, and a real flight.

As a script it prints figures of docs/accuracy.md; the tests use the same functions.
"""

from __future__ import annotations

import os
import tarfile
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from sklearn.metrics import roc_auc_score

import calib
import uwbsim
from calib.calibration.formats import read_miluv
from calib.data.ranges import FEATURES, Ranges
from uwblink.arrays import Bools, Floats
from uwblink.importers import read_source
from uwblink.recording.contents import Contents

ROOT = Path(__file__).parents[1]
SHARED = Path(os.environ.get("UWBCAL_DATA", ROOT.parent / "shared" / "data"))
FLIGHT = "miluv_cirObstacles_3_random_0.tar.xz"
DETOUR_M = 0.3
ROOMS = range(300, 324)
"""Numbers of the rooms, which were not used to choose features (rooms 0 to 23 and 200 to 215 were)."""

BLOCKS = 6
"""Number of parts of the real flight, in order of time; each is left out once."""

VENDOR_DB = 6.0
"""Difference of total and first-path power from which a range is taken for reflected (Decawave APS006, part 3). Here
the energy of the impulse response is used, from which the chip computes its total power.
"""

RESPONSE, RISE = FEATURES.index("response_db"), FEATURES.index("rise_taps")


def room(seed: int, duration_s: float) -> uwbsim.Scenario:
    """Return a random room: size, materials, objects and obstacles are drawn; two robots fly among four anchors."""
    rng = np.random.default_rng([seed, 0xA0C])
    size = np.array([rng.uniform(5, 12), rng.uniform(4, 9), rng.uniform(2.5, 4)])
    walls = {"material": str(rng.choice(["brick", "concrete", "drywall"])), "floor": "concrete"}
    obstacles = []
    for material in ("metal", *rng.choice(["brick", "glass", "wood", "drywall"], 5)):
        corner = rng.uniform(0.1, 0.8, 3) * size * [1, 1, 0]
        extent = rng.permutation([rng.uniform(0.05, 0.3), rng.uniform(0.5, 1.5)])
        box = np.minimum(corner + np.array([*extent, rng.uniform(1.2, 2.2)]), size)
        obstacles.append({"min_m": corner.tolist(), "max_m": box.tolist(), "material": str(material)})
    flying = {"model": "random-flight", "box_min_m": [0.4] * 3, "box_max_m": (size - 0.4).tolist(), "speed_mps": 1.0}
    shadow = {"semi_axes_m": [0.22, 0.22, 0.08], "loss_db_per_m": 30.0}
    bodies = [{"name": f"robot{k}", "motion": flying, "shadow": shadow} for k in range(2)]
    for k in range(4):
        place = [(0.2, size[0] - 0.2)[k % 2], (0.2, size[1] - 0.2)[k // 2], rng.uniform(0.5, size[2] - 0.3)]
        bodies.append({"name": f"anchor{k}", "motion": {"model": "static", "position_m": [float(v) for v in place]}})
    tags = [{"id": 10 + k, "body": f"robot{k}", "lever_arm_m": [0.15, 0.0, -0.1]} for k in range(2)]
    tags += [{"id": k, "body": f"anchor{k}"} for k in range(4)]
    return uwbsim.load(
        {
            "run": {"name": f"room {seed}", "seed": seed, "duration_s": duration_s},
            "ranging": {"rate_hz": 36.0, "get_cir": True},
            "radio": {"first_path_at_1m_dbm": -76.0, "dynamic_range_db": 18.0, "multipath": {"model": "geometric"}},
            "room": {"min_m": [0.0, 0.0, 0.0], "max_m": size.tolist()} | walls,
            "obstacles": obstacles,
            "bodies": bodies,
            "tags": tags,
        }
    )


def of_room(seed: int, duration_s: float = 15.0) -> Ranges:
    """Return the ranges of the robots in a simulated room, with the features of their responses."""
    found = calib.load_ranges(uwbsim.simulate(room(seed, duration_s), contention=False))
    flying = (found.initiator >= 10) | (found.target >= 10)
    return replace(found[flying], source=f"room {seed}", recordings=())


def real_flight(folder: Path) -> Contents:
    """Import the flight of the MILUV dataset from the archive in a folder."""
    with tempfile.TemporaryDirectory() as scratch:
        with tarfile.open(folder / FLIGHT) as archive:
            archive.extractall(scratch, filter="data")
        return read_source(Path(scratch) / FLIGHT.removeprefix("miluv_").removesuffix(".tar.xz"), importer="miluv")


def of_real_flight(folder: Path) -> Ranges:
    """Return the ranges of the real flight; those with responses have features."""
    return calib.load_ranges(real_flight(folder))


def published_error_m(ranges: Ranges, folder: Path) -> Floats:
    """Return the errors (n,) of ranges corrected by the calibration published for the boards, minus their median."""
    error = read_miluv(folder / "miluv_published_calibration.json").apply(ranges).corrected_m - ranges.truth_m
    return np.asarray(error - np.median(error))


def without_features(ranges: Ranges) -> Ranges:
    """Return ranges with powers but without features."""
    return replace(ranges, features=np.full_like(ranges.features, np.nan))


@dataclass(frozen=True, kw_only=True)
class Told:
    """Predictions for ranges (n,) that were left out: the probability of a reflection, from features and power.

    `afterwards` (n,) is the probability that also uses the error of the range, `long` (n,) is true for errors above
    `DETOUR_M`.
    """

    probability: Floats
    afterwards: Floats
    long: Bools

    @classmethod
    def left_out(cls, parts: Sequence[Ranges]) -> Told:
        """Fit all parts but one and predict that one, for each in turn. Parts of one source are of one recording."""
        whole = len({part.source for part in parts}) == 1
        found = []
        for k, part in enumerate(parts):
            others = [one for j, one in enumerate(parts) if j != k]
            applied = calib.fit(Ranges.concatenate(others) if whole else others).calibration.apply(part)
            error = applied.corrected_m - part.truth_m
            found.append((applied.tail_share, applied.tail_probability, error - np.median(error) > DETOUR_M))
        probability, afterwards, long = map(np.concatenate, zip(*found, strict=True))
        return cls(probability=probability, afterwards=afterwards, long=long)

    @property
    def auc(self) -> float:
        """Return the area under the curve of detections over false alarms, for ranges that are too long."""
        return float(roc_auc_score(self.long, self.probability))

    @property
    def brier(self) -> float:
        """Return the mean square of probability minus reflection (0 or 1)."""
        return float(
            np.mean(self.afterwards * (1 - self.probability) ** 2 + (1 - self.afterwards) * self.probability**2)
        )

    def reliability(self) -> list[tuple[int, float, float]]:
        """Return number, mean probability and share of reflections of the ranges in ten bins of probability."""
        number = np.minimum((10 * self.probability).astype(np.int64), 9)
        bins = [number == k for k in range(10) if np.any(number == k)]
        return [(int(b.sum()), float(self.probability[b].mean()), float(self.afterwards[b].mean())) for b in bins]

    @property
    def unreliability(self) -> float:
        """Return the mean absolute difference of probability and share of reflections, weighted by the number of
        ranges.
        """
        return sum(count * abs(told - found) for count, told, found in self.reliability()) / len(self.long)


def vendor_rule(parts: Sequence[Ranges], as_told: Told) -> Told:
    """Return probabilities by the 6 dB rule of the vendor.

    They are the shares of reflections among flagged and among other ranges, in all parts but the one that is predicted.
    """
    flagged = np.concatenate([one.features[:, RESPONSE] > VENDOR_DB for one in parts])
    part = np.repeat(np.arange(len(parts)), [len(one) for one in parts])
    probability = np.zeros(len(part))
    for k in range(len(parts)):
        for group in (flagged, ~flagged):
            probability[(part == k) & group] = np.mean(as_told.afterwards[(part != k) & group])
    return replace(as_told, probability=probability)


def show(name: str, parts: Sequence[Ranges]) -> None:
    """Print the results for parts that were left out: with all features, with power alone, with the vendor's rule."""
    told = Told.left_out(parts)
    several = {
        "features": told,
        "power alone": Told.left_out([without_features(one) for one in parts]),
        f"rule of {VENDOR_DB:.0f} dB": vendor_rule(parts, told),
    }
    for how, one in several.items():
        print(
            f"{name}, {how}: AUC {one.auc:.2f}, Brier score {one.brier:.3f}, probabilities off by "
            f"{one.unreliability:.3f} on average"
        )
    print("  " + ", ".join(f"{p:.2f}: {found:.2f} ({count})" for count, p, found in told.reliability()))


def main() -> None:
    show("rooms", [of_room(seed) for seed in ROOMS])
    if (SHARED / FLIGHT).exists():
        flight = of_real_flight(SHARED)
        flight = flight[np.isfinite(flight.features[:, RISE])]
        edges = np.linspace(0, len(flight), BLOCKS + 1).astype(int).tolist()
        show("MILUV", [flight[a:b] for a, b in pairwise(edges)])


if __name__ == "__main__":
    main()
