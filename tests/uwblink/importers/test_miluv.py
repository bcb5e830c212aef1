"""Flights of the MILUV dataset: one written here, row by row, and a real one."""

import csv
import json
from typing import Any

import numpy as np
import pytest

from tests.errors import one_line
from tests.shared_data import miluv
from uwblink import errors, import_recording, load, raw_range
from uwblink.recording.distances import distances_m
from uwblink.twr import STAMPS

TICK_NS = 1e9 / (128 * 499.2e6)
AIR = 299_702_547.0
STARTED_NS = 1_700_000_000_123_456_789
ANCHORS = {"0": {0: (3.0, 3.0, 1.5), 1: (-3.0, 2.0, 1.0)}, "1": {0: (3.0, -2.0, 1.5), 1: (-3.0, -2.0, 1.0)}}
ARMS = {"ifo001": {10: (0.1, -0.2, -0.05), 11: (-0.1, 0.2, -0.05)}, "ifo002": {20: (0.1, 0.1, 0.0)}}
PLACES = {"ifo001": np.array([0.0, 0.0, 1.0]), "ifo002": np.array([1.0, -2.0, 2.0])}


def antenna(tag):
    for robot, arms in ARMS.items():
        if tag in arms:
            return PLACES[robot] + arms[tag]
    return np.array(ANCHORS["0"][tag])


def exchange(random, pair, when) -> tuple[dict[str, int], dict[str, Any]]:
    """Return one DS-TWR exchange between clocks of equal rate, in whole unwrapped ticks, and its row in MILUV."""
    first, second = pair
    distance = float(np.linalg.norm(antenna(first) - antenna(second)))
    flight = round(distance / AIR * 1e9 / TICK_NS)
    bounds = ((2**33, 2**42), (2**33, 2**42), (2e7, 3e7), (9e7, 1e8))
    begun, other, reply, third = (int(random.integers(low, high)) for low, high in bounds)
    tx2, rx2 = other + flight + reply, begun + 2 * flight + reply
    ticks = dict(zip(STAMPS, (begun, other + flight, tx2, rx2, tx2 + third, rx2 + third), strict=True))
    ends = {"from_id": first, "to_id": second}
    row: dict[str, Any] = {"timestamp": repr(when), **ends, "range": 99.0, "gt_range": distance}
    row |= {f"{name}_raw": repr(float(value * TICK_NS)) for name, value in ticks.items()}
    row |= {name: repr(float(value * TICK_NS) + 0.3) for name, value in ticks.items()}
    row |= {"range_raw": repr(flight * TICK_NS * 1e-9 * AIR), "fpp1": -80.5, "fpp2": -81.5, "skew1": 1.5, "skew2": -1.5}
    return ticks, row


def write(path, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


@pytest.fixture
def flight(tmp_path):
    """A folder with two robots and two anchors, its stamps in order of time, and the passive ones."""
    random, folder = np.random.default_rng(3), tmp_path / "flight"
    pairs = [(10, 0), (20, 11), (11, 1), (20, 0), (10, 20), (20, 1)]
    made = [exchange(random, pair, 1.0 + k / 8) for k, pair in enumerate(pairs)]
    heard: dict[str, Any] = {"my_id": 11, "from_id": 10, "to_id": 20, "timestamp": 1.5}
    own = {"rx1": -(2**31), "rx2": 5, "rx3": 2**33 + 7}
    heard |= {f"{name}_raw": repr(value * TICK_NS) for name, value in own.items()}
    heard |= {f"{name}_raw_n": made[4][1][f"{name}_raw"] for name in STAMPS}
    heard |= {"fpp1": -85.0, "fpp2": -86.0, "fpp3": -87.0, "fpp1_n": -80.5, "fpp2_n": -81.5, "skew1_n": 1.5}
    heard |= {"skew1": 0.5, "skew2": 0.25, "skew3": 0.125}
    names = [f"pose.position.{a}" for a in "xyz"] + [f"pose.orientation.{a}" for a in "xyzw"]
    turns = {f"angular_velocity.{a}": k for k, a in enumerate("xyz")}
    pulls = {f"linear_acceleration.{a}": k + 3 for k, a in enumerate("xyz")}
    for robot, tags in ARMS.items():
        still = dict(zip(names, [*PLACES[robot], 0, 0, 0, 1], strict=True))
        tables = {
            "uwb_range": [row for _, row in made if {row["from_id"], row["to_id"]} & {*tags}],
            "uwb_passive": [heard],
            "height": [{"timestamp": 0.5, "range": 0.25}, {"timestamp": 0.75, "range": 0.5}],
            "mocap": [{"timestamp": t / 10, **still} for t in range(25)],
            "imu_px4": [{"timestamp": 1.25, **turns, **pulls}],
        }
        for name, rows in tables.items():
            write(folder / robot / f"{name}.csv", rows)
    cir = {"timestamp": 1.25, "my_id": 10, "from_id": 10, "to_id": 0, "idx": 750.25, "cir": json.dumps([4, 0, 65535])}
    write(folder / "ifo001" / "uwb_cir.csv", [cir])
    (folder / "timeshift.yaml").write_text("timeshift_ns: 123456789\ntimeshift_s: 1700000000\n")
    for name, table in (("anchors", ANCHORS), ("tags", ARMS)):
        lines = ["# a comment"]
        for group, vectors in table.items():
            lines += [f'"{group}":', *(f'    "{n}": "[{x}, {y}, {z}]"' for n, (x, y, z) in vectors.items()), ""]
        (folder / f"{name}.yaml").write_text("\n".join(lines))
    return folder, [ticks for ticks, _ in made], own


def imported(folder, tmp_path, text=""):
    (tmp_path / "map.toml").write_text(text)
    import_recording(folder, tmp_path / "o.uwb", importer="miluv", map_file=tmp_path / "map.toml" if text else None)
    return load(tmp_path / "o.uwb")


def truths(e):
    return [np.linalg.norm(antenna(i) - antenna(j)) for i, j in zip(e.initiator, e.target, strict=True)]


def test_every_stamp_of_a_flight_is_imported_once(flight, tmp_path):
    folder, made, own = flight
    found = imported(folder, tmp_path)
    e, heard, meta = found.exchanges, found.overheard, found.meta
    assert meta["doubled_rows"] == {"uwb_range.csv": 2, "uwb_passive.csv": 1, "uwb_cir.csv": 0}
    for name in STAMPS:
        assert getattr(e, name).tolist() == [ticks[name] % 2**32 for ticks in made]
        assert heard[f"{name}_n"].tolist() == [made[4][name] % 2**32]
    assert [heard[name][0] for name in own] == [value % 2**32 for value in own.values()]
    assert e.time_ns.tolist() == [STARTED_NS + 1_000_000_000 + k * 125_000_000 for k in range(6)]
    assert np.allclose(raw_range(e), e.range_m, atol=1e-9)
    assert (meta["clock_began_ns"], np.isnan(heard["skew2_n_ppm"][0])) == (STARTED_NS, True)
    assert (e.fpp2_dbm[0], e.skew2_ppm[0], heard["fpp3_dbm"][0], heard["skew1_n_ppm"][0]) == (-81.5, -1.5, -87.0, 1.5)


def test_anchors_are_found_by_their_distances_and_everything_else_is_kept(flight, tmp_path):
    found = imported(flight[0], tmp_path)
    e, imu, height = found.exchanges, found.imu, found.height
    bodies = {0: "anchor0", 1: "anchor1", 10: "ifo001", 11: "ifo001", 20: "ifo002"}
    assert ({tag.tag: tag.body for tag in found.tags}, found.meta["anchor_constellation"]) == (bodies, "0")
    distances = distances_m(found.poses, found.tags, e.initiator, e.target, e.time_ns)
    assert np.allclose(distances, truths(e), atol=1e-12)
    assert np.isnan(e.truth_m).all(), "what poses tell is not stored a second time"
    cir = found.cirs[0]
    assert (cir.board, cir.first_path_index, cir.magnitudes) == (10, 750.25, (4, 0, 65535))
    assert imu["body"].tolist() == ["ifo001", "ifo002"]
    assert [imu[name][0] for name in ("wx", "wy", "wz", "ax", "ay", "az")] == [0, 1, 2, 3, 4, 5]
    after_ns = (height["time_ns"] - STARTED_NS).tolist()
    expected = [(500_000_000, 0.25)] * 2 + [(750_000_000, 0.5)] * 2
    assert list(zip(after_ns, height["height_m"].tolist(), strict=True)) == expected


def test_without_files_of_places_the_measured_distance_is_the_truth(flight, tmp_path):
    folder, _, _ = flight
    for name in ("anchors", "tags", "timeshift"):
        (folder / f"{name}.yaml").unlink()
    e = imported(folder, tmp_path).exchanges
    assert np.allclose(e.truth_m, truths(e))
    assert e.time_ns[0] == 1_000_000_000


def test_rows_with_missing_cells_are_faults(flight, tmp_path):
    path = flight[0] / "ifo001" / "uwb_range.csv"
    rows = list(csv.DictReader(path.read_text().splitlines()))
    rows[1]["rx2_raw"] = ""
    write(path, rows)
    found = imported(flight[0], tmp_path)
    assert "1 rows cannot be used and are kept as faults" in found.meta["notes"]
    assert [fault.detail for fault in found.faults] == ["ifo001/uwb_range.csv: row 3: a number is missing or none"]


@pytest.mark.parametrize(
    ("name", "there", "instead", "text"),
    [
        ("anchors.yaml", "3.0", "4.0", "choose one of 0, 1"),
        ("ifo002/uwb_range.csv", "rx3_raw", "rx9_raw", "column 'rx3_raw' is missing"),
        ("tags.yaml", ", -0.05]", "]", "ifo001: 10: found '[0.1, -0.2]'"),
        ("timeshift.yaml", "123456789", "soon", "timeshift_s and timeshift_ns"),
        ("", "", "", "no folder in it holds uwb_range.csv"),
    ],
)
def test_a_folder_that_cannot_be_used_is_one_line_and_no_file(flight, tmp_path, name, there, instead, text):
    folder, _, _ = flight
    if name:
        (folder / name).write_text((folder / name).read_text().replace(there, instead))
    for path in () if name else folder.glob("*/uwb_range.csv"):
        path.unlink()
    with pytest.raises(errors.ImportTableError, match=one_line(text)):
        imported(folder, tmp_path)
    assert not (tmp_path / "o.uwb").exists()


def test_missing_constellations_are_named(flight, tmp_path):
    for text, said in (('constellation = "7"', "there are 0, 1"), ("constellation = 7", "constellation: found 7")):
        with pytest.raises(errors.ImportTableError, match=said):
            imported(flight[0], tmp_path, text)
    assert imported(flight[0], tmp_path, 'constellation = "1"').meta["anchor_constellation"] == "1"


@pytest.mark.slow
def test_the_real_flight_gives_the_ranges_of_its_boards(tmp_path):
    real = miluv(tmp_path)
    found = imported(real, tmp_path)
    counts = {"exchanges": 317, "poses": 23443, "overheard": 719, "cirs": 944, "imu": 46454, "height": 7059}
    assert (found.counts(), found.meta["anchor_constellation"]) == (counts, "0")
    assert found.meta["doubled_rows"] == {"uwb_range.csv": 123, "uwb_passive.csv": 261, "uwb_cir.csv": 0}
    e = found.exchanges
    # The boards round their ranges down to 0.1 mm.
    assert np.abs(raw_range(e) - e.range_m).max() < 2e-4
    measured = {}
    for path in real.glob("*/uwb_range.csv"):
        for row in csv.DictReader(path.read_text().splitlines()):
            key = round(float(row["timestamp"]) * 1e9) + 1706822508_042560815, int(row["from_id"]), int(row["to_id"])
            measured[key] = float(row["gt_range"])
    assert len(measured) == len(e)
    gt = [measured[key] for key in zip(e.time_ns.tolist(), e.initiator.tolist(), e.target.tolist(), strict=True)]
    off = distances_m(found.poses, found.tags, e.initiator, e.target, e.time_ns) - gt
    # The authors interpolate attitudes along a spline.
    assert np.abs(off).max() < 5e-3
