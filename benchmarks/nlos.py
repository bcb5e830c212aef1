"""Which ranges went by a detour, told from impulse responses: what simulated rooms teach of a real flight.

Run as a script it prints figures of docs/accuracy.md; the tests use the same functions.
"""

from __future__ import annotations

import os
import tarfile
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

import uwbsim
from calib.calibration.formats import read_miluv
from calib.data.ranges import Ranges
from uwblink.arrays import Bools, Floats, Ints
from uwblink.importers import import_recording
from uwblink.recording.contents import Contents, load
from uwblink.recording.distances import distances_m
from uwblink.recording.schema import CirRow
from uwblink.twr import raw_range

ROOT = Path(__file__).parents[1]
SHARED = Path(os.environ.get("UWBCAL_DATA", ROOT.parent / "shared" / "data"))
FLIGHT = "miluv_cirObstacles_3_random_0.tar.xz"
DETOUR_M = 0.3
TRAINING, HELD_OUT = range(12), range(12, 24)
"""Numbers of rooms."""

TAPS_BEFORE, TAPS_AFTER = 20, 100
QUIET = 50
"""From this tap on, up to well before the first path, there is only noise."""

RISEN = 5.0
EARLY_NS, LATE_NS = 10_000_000, 400_000_000


def features(row: CirRow) -> tuple[float, float]:
    """Return what tells a detour: total less first-path power in dB, and the first path's rise time in taps.

    It rises from where the response leaves the noise (five standard deviations of a part) to its own peak: a direct
    path too weak for the chip's threshold makes it longer.
    """
    taps, first = np.array(row.magnitudes, dtype=float), int(row.first_path_index)
    own = taps[first + 1 : first + 4]
    near = taps[first - TAPS_BEFORE : first + TAPS_AFTER]
    noise = np.sqrt(np.mean(taps[QUIET : first - 2 * TAPS_BEFORE] ** 2) / 2)
    begins = int(np.argmax(near > RISEN * noise)) - TAPS_BEFORE
    return float(10 * np.log10(np.sum(near**2) / np.sum(own**2))), float(1 + np.argmax(own) - begins)


def classifier() -> Any:
    """Return a logistic regression on the two features."""
    return make_pipeline(StandardScaler(), LogisticRegression())


def room(seed: int, duration_s: float) -> uwbsim.Scenario:
    """Return a room of its own: size, materials, things and obstacles are drawn, two robots fly among four anchors."""
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


def of_room(seed: int, duration_s: float = 15.0) -> tuple[Floats, Bools]:
    """Return features (n, 2) of a simulated room's responses, and which of the ranges went by a detour, (n,)."""
    flight = uwbsim.simulate(room(seed, duration_s), contention=False)
    residual = raw_range(flight.exchanges) - flight.truth_m
    return np.array([features(row) for row in flight.cirs]), residual > DETOUR_M


def of_rooms(seeds: range, duration_s: float = 15.0) -> tuple[Floats, Bools]:
    """Return those of several rooms, one after the other."""
    found, detours = zip(*(of_room(seed, duration_s) for seed in seeds), strict=True)
    return np.concatenate(found), np.concatenate(detours)


def real_flight(folder: Path) -> Contents:
    """Import the flight of the MILUV dataset from a folder with its archive."""
    with tempfile.TemporaryDirectory() as scratch:
        with tarfile.open(folder / FLIGHT) as archive:
            archive.extractall(scratch, filter="data")
        name = FLIGHT.removeprefix("miluv_").removesuffix(".tar.xz")
        import_recording(Path(scratch) / name, Path(scratch) / "f.uwb", importer="miluv")
        return load(Path(scratch) / "f.uwb")


def of_real_flight(folder: Path) -> tuple[Floats, Floats]:
    """Return features (n, 2) of a real flight's responses at the boards that ranged, and residuals (n,) in metres.

    Residuals are those of ranges corrected with the calibration published for the boards, less their median.
    """
    flight = real_flight(folder)
    e = flight.exchanges
    calibrated = read_miluv(folder / "miluv_published_calibration.json").apply(Ranges.from_exchanges(e)).corrected_m
    residual = calibrated - distances_m(flight.poses, flight.tags, e.initiator, e.target, e.time_ns)
    residual = residual - np.median(residual)
    rows, which = matched(flight.cirs, e.initiator, e.target, e.time_ns)
    return np.array([features(row) for row in rows]), residual[which]


def matched(cirs: list[CirRow], initiator: Ints, target: Ints, time_ns: Ints) -> tuple[list[CirRow], Ints]:
    """Return the responses that boards of an exchange printed after it, and which exchange.

    The dataset gives a response 0.13 s after its exchange in the median, when it has been printed.
    """
    rows, which = [], []
    for row in cirs:
        same = np.flatnonzero((initiator == row.initiator) & (target == row.target))
        late_ns = row.time_ns - time_ns[same]
        near = same[(late_ns > -EARLY_NS) & (late_ns < LATE_NS)]
        if row.board in (row.initiator, row.target) and len(near) == 1:
            rows.append(row)
            which.append(int(near[0]))
    return rows, np.array(which, dtype=np.int64)


def auc(model: Any, found: Floats, detours: Bools) -> float:
    """Return the area under the curve of hits over false alarms."""
    return float(roc_auc_score(detours, model.predict_proba(found)[:, 1]))


def main() -> None:
    model = classifier().fit(*of_rooms(TRAINING))
    found, detours = of_rooms(HELD_OUT)
    print(f"held-out rooms: AUC {auc(model, found, detours):.2f}; {100 * detours.mean():.0f} % detours")
    if (SHARED / FLIGHT).exists():
        found, residual = of_real_flight(SHARED)
        late = residual > DETOUR_M
        print(f"real flight: AUC {auc(model, found, late):.2f}; {np.sum(late)} of {len(late)} detours")
        each = [float(roc_auc_score(late, found[:, k])) for k in range(2)]
        print(f"  total less first-path power alone {each[0]:.2f}, rise time alone {each[1]:.2f}")


if __name__ == "__main__":
    main()
