"""A table of ranges with power and places, no stamps, several anchors: imported, fitted, localized and exported by
commands. The world that wrote it is here."""

import csv
import json

import numpy as np
import pytest

from tests import processes

ANCHORS = {1: (0.0, 0.0, 2.5), 2: (8.0, 0.0, 2.2), 3: (8.0, 6.0, 2.6), 4: (0.0, 6.0, 2.4), 5: (4.0, 3.0, 3.0)}
CONSTANTS_M = {1: 0.05, 2: -0.03, 3: 0.1, 4: 0.0, 5: 0.02}
SIGMA_M = 0.04
MAP = """
[columns]
time_s = "t"
from_id = "tag"
to_id = "anchor"
range_m = "dist"
fpp2 = "power"
from_x_m = "tag x"
from_y_m = "tag y"
from_z_m = "tag z"
to_x_m = "anchor x"
to_y_m = "anchor y"
to_z_m = "anchor z"
[units]
distance = "mm"
"""


def bias_m(power_dbm):
    return 0.15 - 0.1 * np.tanh((power_dbm + 88) / 5)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    random, path = np.random.default_rng(5), tmp_path_factory.mktemp("ranges")
    (path / "map.toml").write_text(MAP)
    with (path / "ranges.csv").open("w", newline="") as file:
        writer = csv.writer(file, delimiter=";")
        writer.writerow(
            ["t", "tag", "anchor", "dist", "power", *(f"{w} {a}" for w in ("tag", "anchor") for a in "xyz")]
        )
        for k in range(4000):
            t, anchor = k * 0.03, 1 + k % 5
            place = np.array([4 + 2.5 * np.cos(0.4 * t), 3 + 2 * np.sin(0.55 * t), 1 + 0.4 * np.sin(0.3 * t)])
            distance = float(np.linalg.norm(place - ANCHORS[anchor]))
            power = -78 - 20 * np.log10(distance) + random.normal(0, 3)
            measured = distance + bias_m(power) + CONSTANTS_M[anchor] + random.normal(0, SIGMA_M)
            ends = [*(1000 * place).tolist(), *(1000 * np.array(ANCHORS[anchor])).tolist()]
            writer.writerow([f"{t:.3f}", 9, anchor, f"{1000 * measured:.1f}", f"{power:.2f}", *map(repr, ends)])
    return path


def run(folder, *words):
    done = processes.succeed(*words, cwd=folder, timeout=300)
    return done.stdout + done.stderr


def test_from_a_table_of_ranges_to_a_track(folder):
    assert "4000 exchanges" in run(folder, "uwblink", "import", "csv", "ranges.csv", "--map", "map.toml", "-o", "r.uwb")
    said = run(folder, "calib", "fit", "r.uwb", "--constants", "pair", "-o", "c.json")
    assert "ranges without stamps" in said, "what cannot be known of such ranges is said"
    run(folder, "calib", "apply", "r.uwb", "-c", "c.json", "--to", "csv", "-o", "out")
    with (folder / "out" / "corrected.csv").open(newline="") as file:
        corrected = list(csv.DictReader(file))
    with (folder / "out" / "exchanges.csv").open(newline="") as file:
        truth = [float(row["truth_m"]) for row in csv.DictReader(file)]
    errors = np.array([float(row["corrected_m"]) for row in corrected]) - truth
    # The bias alone is 5 to 25 cm; 800 ranges a pair leave 1.4 mm of noise, and the curve some millimetres.
    for anchor in ANCHORS:
        mine = errors[[int(row["target"]) == anchor for row in corrected]]
        assert np.mean(mine) == pytest.approx(0, abs=0.01)
        assert np.std(mine) == pytest.approx(SIGMA_M, rel=0.1)
    assert np.mean([float(row["sigma_m"]) for row in corrected]) == pytest.approx(SIGMA_M, rel=0.15)
    (found,) = json.loads(run(folder, "calib", "localize", "r.uwb", "-c", "c.json", "--json"))["scenarios"]
    assert found["rmse_m"]["calibrated"] < 0.06 < 0.2 < found["rmse_m"]["raw"]
