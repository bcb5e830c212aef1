"""Exports of motion-capture programs, made here from their descriptions, compared with planted poses and distances."""

import json
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests import processes
from tests.errors import one_line
from uwblink import Contents, Exchanges, Tag, errors, load
from uwblink.importers.poses import read_poses
from uwblink.recording.distances import distances_m

COUNT, RATE = 30, 100.0
TIMES = np.arange(COUNT) / RATE
BODIES = {
    name: (
        np.random.default_rng(k).normal(size=3) + np.outer(TIMES, [1.0 + k, 2.0, -0.5]),
        Rotation.from_rotvec(np.outer(TIMES + k, [0.3, -0.2, 0.9])),
    )
    for k, name in enumerate(("drone", "car"))
}
ARMS = {"drone": (0.1, -0.2, 0.05), "car": (0.0, 0.3, -0.1)}


def rows(numbers):
    """Return a row per frame: the numbers of each body in turn, by a function."""
    return [[x for name in BODIES for x in numbers(name, k)] for k in range(COUNT)]


def lines(path, head, table, mark=","):
    path.write_text("\n".join([mark.join(map(str, cells)) for cells in [*head, *table]]) + "\n")
    return path


def motive(folder, version="1.23", unit="Millimeters", labelled=True, rotation="Quaternion"):
    scale = {"Millimeters": 1000.0, "Meters": 1.0}[unit]
    turns = "XYZ" if len(rotation) == 3 else "XYZW"

    def numbers(name, k):
        place, turned = BODIES[name][0][k] * scale, BODIES[name][1][k]
        # Successive rotations about the body's own axes; the columns are of x, y and z in any order of rotations.
        written = turned.as_quat() if turns == "XYZW" else turned.as_euler(rotation, degrees=True)
        return [
            *(written[::-1] if rotation == "ZYX" else written),
            *place,
            0.001,
            *place,
        ]  # followed by a marker of the body

    kinds = ["Rotation"] * len(turns) + ["Position"] * 3 + ["Mean Marker Error"] + ["Position"] * 3
    axes = [*turns, *"XYZ", "", *"XYZ"]
    width = len(turns) + 4
    label = (lambda word: ["", word]) if labelled else lambda _: ["", ""]
    head = [
        ["Format Version", version, "Take Name", "Take 1", "Export Frame Rate", RATE, "Rotation Type", rotation,
         "Length Units", unit, "Coordinate Space", "Global"],
        [],
        [*label("Type"), *(["Rigid Body"] * width + ["Rigid Body Marker"] * 3) * 2],
        [*label("Name"), *(cell for name in BODIES for cell in [name] * width + [f"{name}:Marker 001"] * 3)],
        [*label("ID"), *["1"] * 2 * (width + 3)],
        ["", "", *kinds * 2],
        ["Frame" if labelled else "", "Time (Seconds)" if labelled else "", *axes * 2],
    ]  # fmt: skip
    table = [[k, f"{TIMES[k]:.6f}", *cells] for k, cells in enumerate(rows(numbers))]
    table[3][2 : width + 5] = [""] * (width + 3)  # the first body is lost for a frame
    return lines(folder / "take.csv", head, table)


def vicon(folder, unit="rad", quaternions=False):
    scale = {"rad": 1.0, "deg": 180 / np.pi}[unit]

    def numbers(name, k):
        turned = BODIES[name][1][k]
        return [*(turned.as_quat() if quaternions else turned.as_rotvec() * scale), *BODIES[name][0][k] * 1000]

    width = 7 if quaternions else 6
    head = [
        ["Objects"], [int(RATE)],
        ["", "", *(cell for name in BODIES for cell in [f"Global Angle {name}:{name}"] + [""] * (width - 1))],
        ["Frame", "Sub Frame", *(["RX", "RY", "RZ", *["RW"] * quaternions, "TX", "TY", "TZ"] * 2)],
        ["", "", *([unit] * (width - 3) + ["mm"] * 3) * 2],
    ]  # fmt: skip
    table = [[k, 0, *cells] for k, cells in enumerate(rows(numbers))]
    table[3][2 : 2 + width] = [""] * width
    return lines(folder / "vicon.csv", head, table)


def qualisys(folder, time=True):
    def numbers(name, k):
        turned = BODIES[name][1][k]
        return [*BODIES[name][0][k] * 1000, *turned.as_euler("xyz", degrees=True), 0.4, *turned.as_matrix().T.ravel()]

    words = ["Roll", "Pitch", "Yaw", "Residual", *(f"Rot[{k}]" for k in range(9))]
    head = [
        ["NO_OF_FRAMES", COUNT], ["NO_OF_BODIES", 2], ["FREQUENCY", int(RATE)],
        ["TIME_STAMP", "2024-05-06, 07:08:09", "22107.99"], ["DATA_INCLUDED", "6D"], ["BODY_NAMES", *BODIES],
        ["Frame", *["Time"] * time, *(cell for name in BODIES for cell in [f"{name} X", "Y", "Z", *words])],
    ]  # fmt: skip
    table = [[k, *[f"{TIMES[k]:.5f}"] * time, *cells] for k, cells in enumerate(rows(numbers))]
    table[3][1 + time : 17 + time] = [0.0] * 16
    return lines(folder / "take_6D.tsv", head, table, "\t")


EXPORTS = {
    "Motive, mm": motive,
    "Motive, version 1.0, m": lambda folder: motive(folder, "1.0", "Meters", labelled=False),
    "Motive, angles X, Y, Z": lambda folder: motive(folder, rotation="XYZ"),
    "Motive, angles Z, Y, X": lambda folder: motive(folder, rotation="ZYX"),
    "Vicon, rotation vectors in rad": vicon,
    "Vicon, rotation vectors in degrees": lambda folder: vicon(folder, "deg"),
    "Vicon, quaternions": lambda folder: vicon(folder, quaternions=True),
    "Qualisys": qualisys,
    "Qualisys without times": lambda folder: qualisys(folder, time=False),
}


@pytest.mark.parametrize("name", EXPORTS)
def test_an_export_of_motion_capture_is_read(tmp_path, name):
    found = read_poses(EXPORTS[name](tmp_path))
    assert set(found.body) == set(BODIES)
    for body, (place, turned) in BODIES.items():
        seen = np.arange(COUNT) != 3 if body == "drone" else np.full(COUNT, True)
        own = found.body == body
        np.testing.assert_allclose(found.time_ns[own] * 1e-9, TIMES[seen], atol=1e-9)
        np.testing.assert_allclose(found.position_m[own], place[seen], atol=1e-9)
        apart = Rotation.from_quat(found.quaternion[own]) * turned[np.flatnonzero(seen)].inv()
        assert apart.magnitude().max() < 1e-6


def ranges(times, range_m):
    """Return ranges from tag 1 to tag 2 without stamps."""
    none: Any = dict.fromkeys(("tx1", "rx1", "tx2", "rx2"), np.zeros(len(times), np.int64))
    return Exchanges.from_arrays(1, 2, time_ns=np.rint(times * 1e9).astype(np.int64), range_m=range_m, **none)


def truth(path):
    found = load(path)
    return distances_m(
        found.poses, found.tags, *(getattr(found.exchanges, n) for n in ("initiator", "target", "time_ns"))
    )


def recording(path, arms=ARMS):
    """Save ranges between the two bodies, exact except for 5 cm, in the middle of frames; return the true distances."""
    times = TIMES[5:-5] + 0.005
    places = {
        name: place[5:-5] + 0.005 * (place[1] - place[0]) * RATE
        + Rotation.from_rotvec(np.outer(times + k, [0.3, -0.2, 0.9])).apply(arms[name])
        for k, (name, (place, _)) in enumerate(BODIES.items())
    }  # fmt: skip
    true = np.linalg.norm(places["drone"] - places["car"], axis=1)
    tags = [Tag(k + 1, name, arms[name]) for k, name in enumerate(arms)]
    Contents(exchanges=ranges(times, true + 0.05), tags=tags).save(path, force=True)
    return true


@pytest.mark.parametrize("name", ["Motive, mm", "Qualisys without times"])
def test_exports_give_the_planted_distances(tmp_path, name):
    true = recording(tmp_path / "r.uwb")
    processes.succeed("uwblink", "poses", tmp_path / "r.uwb", "--from", EXPORTS[name](tmp_path))
    # Between frames, poses are interpolated, and one frame is missing.
    np.testing.assert_allclose(truth(tmp_path / "r.uwb"), true, atol=1e-4)


CSV = "stamp_ms;object;pos_x_mm;pos_y_mm;pos_z_mm"
MAP = """
columns = {time_s = "when", body = "what", x = "east", y = "north", z = "up"}
units = {time = "ms", distance = "mm"}
"""


def test_iso_times(tmp_path):
    text = "time,body,x,y,z\n" + "".join(
        f"2024-05-06T07:08:{k:02d}.250{zone},b,{k},0,0\n" for k, zone in enumerate(["", "Z", "+02:00"])
    )
    (tmp_path / "p.csv").write_text(text)
    found = read_poses(tmp_path / "p.csv")
    assert [time - 1714979280_250_000_000 for time in found.time_ns.tolist()] == [-7198 * 10**9, 0, 10**9]


@pytest.mark.parametrize(("head", "text"), [(CSV, None), ("when;what;east;north;up", MAP)])
def test_columns_with_other_names_and_without_attitudes(tmp_path, head, text):
    none = dict.fromkeys(BODIES, (0.0, 0.0, 0.0))
    table = [[1000 * TIMES[k], name, *1000 * BODIES[name][0][k]] for k in range(COUNT) for name in BODIES]
    source = lines(tmp_path / "p.csv", [[head]], table, ";")
    words = ["uwblink", "poses", tmp_path / "r.uwb", "--from", source]
    true = recording(words[2], none)
    if text:
        processes.refuse(*words, naming=["time_s", "when", "--map"])
        (tmp_path / "map.toml").write_text(text)
        words += ["--map", tmp_path / "map.toml"]
    processes.succeed(*words)
    np.testing.assert_allclose(truth(words[2]), true, atol=1e-6)
    recording(words[2])
    processes.refuse(*words, naming=["attitudes", "drone", "lever arm"])


@pytest.mark.parametrize(
    ("name", "broken", "said"),
    [
        ("take.csv", lambda folder: motive(folder, rotation="Matrix"), "export quaternions"),
        ("take.csv", lambda folder: motive(folder).read_text().replace("Rigid Body", "Marker"), "Rigid Body"),
        ("vicon.csv", lambda folder: vicon(folder).read_text().replace("\n100\n", "\n\n"), "frame rate"),
        ("take_6D.tsv", lambda folder: qualisys(folder).read_text().replace("Rot[0]", "R"), "Rot[0]"),
        (
            "take_6D.tsv",
            lambda folder: qualisys(folder, False).read_text().replace("FREQUENCY\t100", "FREQUENCY\t0"),
            "rate",
        ),
        ("vicon.csv", lambda folder: vicon(folder).read_text()[:-30], "row 35: column 'T"),
        ("take.csv", lambda folder: motive(folder).read_text()[:900], "rigid bodies"),
        ("take.csv", lambda folder: motive(folder).read_text()[:300], "Rotation, Position"),
    ],
)
def test_exports_that_lack_something_are_refused_with_its_name(tmp_path, name, broken, said):
    text = broken(tmp_path)
    if isinstance(text, str):
        (tmp_path / name).write_text(text)
    with pytest.raises(errors.ImportTableError, match=one_line(said)):
        read_poses(tmp_path / name)


def test_anchors_come_from_json_as_from_toml(tmp_path):
    places = {1: (0.0, 0.0, 0.0), 2: (3.0, 4.0, 0.0)}
    rows = [{"id": n, "position_m": list(place)} for n, place in places.items()]
    (tmp_path / "anchors.json").write_text(json.dumps({"anchors": rows}))
    text = "".join(f"[[anchors]]\nid = {n}\nposition_m = {list(place)}\n" for n, place in places.items())
    (tmp_path / "anchors.toml").write_text(text)
    for name in ("anchors.json", "anchors.toml"):
        Contents(exchanges=ranges(TIMES, np.full(COUNT, 5.1))).save(tmp_path / f"{name}.uwb")
        processes.succeed("uwblink", "poses", tmp_path / f"{name}.uwb", "--tags", tmp_path / name)
        assert truth(tmp_path / f"{name}.uwb") == pytest.approx(5.0)
    processes.refuse("uwblink", "poses", tmp_path / "anchors.json.uwb", naming=["--from", "--tags"])
