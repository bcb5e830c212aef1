"""Motion-capture poses from files, and the offset of their clock."""

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

import uwbsim
from tests import processes
from tests.errors import one_line
from uwblink import Contents, Exchanges, Tag, errors, load
from uwblink.importers import add_poses
from uwblink.importers.poses import read_poses
from uwblink.recording.distances import distances_m
from uwbsim.boards.server import LivePoses
from uwbsim.world.world import World

HEADER = "time_s,body,x,y,z,qx,qy,qz,qw\n"
SHIFT_NS = 1_700_000_000_123_456_789


@pytest.mark.parametrize(
    ("name", "head", "order"),
    [
        ("a.csv", HEADER, "time_s,body,x,y,z,qx,qy,qz,qw"),
        ("a.csv", "note,body,time_ns,qw,qz,qy,qx,z,y,x\n", "note,body,time_ns,qw,qz,qy,qx,z,y,x"),
        ("a.tum", "# time x y z qx qy qz qw\n", "time_s x y z qx qy qz qw"),
        ("a.csv", "#timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z, v_x\n", "time_ns,x,y,z,qw,qx,qy,qz,note"),
    ],
)
def test_every_number_of_every_form_in_order_of_time(tmp_path, name, head, order):
    random, mark = np.random.default_rng(2), " " if name.endswith("tum") else ","
    rows = []
    for k in random.permutation(50).tolist():
        turned, time_ns = random.normal(size=4), SHIFT_NS + k * 10_000_001
        numbers = [*random.normal(size=3), *turned / np.linalg.norm(turned)]
        row = {"note": 'a "b"', "body": "é", "time_ns": time_ns, "time_s": f"{time_ns // 10**9}.{time_ns % 10**9:09d}"}
        rows.append(row | {n: f"{v:.7g}" for n, v in zip(HEADER.strip().split(",")[2:], numbers, strict=True)})
    lines = [mark.join(str(row[n]) for n in order.split(mark)) for row in rows]
    (tmp_path / name).write_text(head + "\n".join(lines) + "\n")
    found = read_poses(tmp_path / name, None if "body" in order else "é")
    rows.sort(key=lambda row: row["time_ns"])
    assert (found.time_ns.tolist(), set(found.body)) == ([row["time_ns"] for row in rows], {"é"})
    assert found.position_m.tolist() == [[float(row[n]) for n in "xyz"] for row in rows]
    expected = [[float(row[n]) for n in ("qx", "qy", "qz", "qw")] for row in rows]
    np.testing.assert_allclose(found.quaternion, expected, rtol=1e-6)


@pytest.mark.parametrize("cell", ["nan", "NaN", ""])
def test_rows_in_which_motion_capture_lost_a_body_are_left_out(tmp_path, cell):
    lost = f"1,a{7 * f',{cell}'}\n1,a{3 * f',{cell}'},0,0,0,1\n1,a,1,2,3{4 * f',{cell}'}\n"
    (tmp_path / "a.csv").write_text(f"{HEADER}0,a,1,2,3,0,0,0,1\n{lost}2,a,4,5,6,0,0,0,1\n")
    assert read_poses(tmp_path / "a.csv").position_m.tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize(
    ("name", "text", "fragment"),
    [
        ("a.csv", HEADER + "0,b,1,2,3,0,0,0,1\n0,,1,2,3,0,0,0,1\n", "row 3: column 'body': found ''"),
        ("a.csv", HEADER + "0,b,1,2,x,0,0,0,1\n", "row 2: column 'z': found 'x'"),
        ("a.csv", HEADER + "0,b,1,2,nan,0,0,0,1\n", "row 2: column 'z'"),
        ("a.csv", HEADER.replace("body,", "") + "0,1,2,3,0,0,0,1\n", "column 'body' is missing"),
        (
            "a.csv",
            "Frame;Time;X\n1;0;2\n",
            "there are Frame, Time, X; expected a first line of time_s or time_ns, body",
        ),
        ("a.csv", HEADER, "holds no poses"),
        ("a.csv", HEADER + "0,b,1,2,3,0,0,0,0\n", "quaternion has length 0"),
        ("a.tum", "0 1 2 3\n", "give the name with `body`"),
        ("a.csv", "#timestamp [ns], x\n1,2,3\n", "give the name with `body`"),
        ("a.csv", "#timestamp [ns], x\n1,2,3\n", "row 2: found 3 cells"),
        ("a.xyz", "", "expected one of"),
    ],
)
def test_files_without_poses_are_refused(tmp_path, name, text, fragment):
    (tmp_path / name).write_text(text)
    with pytest.raises(errors.ImportTableError, match=one_line(fragment)):
        read_poses(tmp_path / name, "drone" if "cells" in fragment else None)


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A recording in host time without poses, and its motion capture in a file, 3.21 s late."""
    folder = tmp_path_factory.mktemp("flight")
    scenario = uwbsim.load("icra2023/test1", ["run.duration_s=10"])
    simulated = uwbsim.simulate(scenario)
    e = simulated.exchanges
    moved = replace(simulated, poses=simulated.poses[:0], exchanges=replace(e, time_ns=e.time_ns + SHIFT_NS))
    moved.save(folder / "f.uwb")
    poses = LivePoses(World(scenario), folder / "p.csv", SHIFT_NS + 3_210_000_000)
    poses.write_until(int(scenario.run.duration_s * 1e9))
    poses.close()
    return folder


@pytest.fixture
def copied(flight, tmp_path):
    path = tmp_path / "f.uwb"
    path.write_bytes((flight / "f.uwb").read_bytes())
    return path


def test_auto_finds_the_offset_from_the_ranges(flight, copied):
    found = add_poses(copied, flight / "p.csv", offset="auto")
    # A drone at 1 m/s moves 5 mm in 5 ms; 1500 ranges of 10 cm determine a shift of that size.
    assert found.offset_s == pytest.approx(-3.210, abs=0.015)
    assert found.covered > 0.95 * found.exchanges
    held = load(copied)
    assert (len(held.poses), held.meta["poses_offset_s"]) == (found.poses, pytest.approx(found.offset_s))


def test_the_command_prints_its_result_and_refuses_wrong_options(flight, copied, tmp_path):
    said = processes.run("uwblink", "poses", copied, "--from", flight / "p.csv", "--offset", "-3.21").stdout
    assert "1660 of 1660 measurements have a true distance" in said
    words = ("poses", copied, "--from", flight / "p.csv", "--force")
    processes.refuse("uwblink", *words, "--offset", "soon", naming=["--offset"])
    for more, error, fragment in (
        ({"source": tmp_path / "no.csv"}, errors.ImportTableError, "no such file"),
        ({"offset": "500000"}, errors.ImportTableError, "no exchange is within"),
        ({"tags_from": tmp_path / "no.toml"}, errors.PlanError, "no such file"),
    ):
        with pytest.raises(error, match=fragment):
            add_poses(copied, **{"source": flight / "p.csv", "force": True} | more)


def test_existing_poses_are_replaced_only_with_force(flight, copied):
    for offset, force in (("-3.21", False), ("-3.1", True)):
        add_poses(copied, flight / "p.csv", offset=offset, force=force)
        assert load(copied).meta["poses_offset_s"] == pytest.approx(float(offset))
        with pytest.raises(errors.RecordingExistsError, match="`force` replaces them"):
            add_poses(copied, flight / "p.csv", offset="-3")


@pytest.mark.parametrize(
    ("unit", "factor", "offset"),
    [
        ("mm", 1000.0, "-3.21"),
        ("cm", 100.0, "auto"),
        pytest.param("ft", 1 / 0.3048, "-3.21", marks=pytest.mark.slow),
        ("ft", 1 / 0.3048, "auto"),
    ],
)
def test_poses_in_other_units_are_refused(flight, copied, tmp_path, unit, factor, offset):
    table, before = pd.read_csv(flight / "p.csv"), copied.read_bytes()
    table[[*"xyz"]] *= factor
    table.to_csv(tmp_path / "p.csv", index=False)
    # With the wrong time, only ratios far from those of any delay show the unit.
    with pytest.raises(errors.ImportTableError, match="p.csv" if offset == "auto" else f"positions are in {unit}"):
        add_poses(copied, tmp_path / "p.csv", offset=offset)
    assert copied.read_bytes() == before


def test_lever_arms_and_ranges_in_other_units_are_refused(flight, copied, tmp_path):
    whole = load(copied)
    tags, held = whole.tags, whole.exchanges
    tables = [
        f'[[tags]]\nid = {tag.tag}\nbody = "{tag.body}"\nlever_arm_m = {[1000 * x for x in tag.lever_arm_m]}\n'
        for tag in tags
    ]
    (tmp_path / "tags.toml").write_text("".join(tables))
    with pytest.raises(errors.ImportTableError, match="lever arms are in mm"):
        add_poses(copied, flight / "p.csv", offset="-3.21", tags_from=tmp_path / "tags.toml")
    for unit, factor in (("mm", 1000.0), ("ns", 1 / 0.299702547)):
        bare = Exchanges.from_arrays(held.initiator, held.target, range_m=factor * held.range_m, time_ns=held.time_ns)
        Contents(exchanges=bare, tags=tags).save(tmp_path / "other.uwb", force=True)
        with pytest.raises(errors.ImportTableError, match=f"ranges of the recording are in {unit}"):
            add_poses(tmp_path / "other.uwb", flight / "p.csv", offset="-3.21")


def test_boards_that_stand_still_are_not_taken_for_ranges_in_another_unit(tmp_path):
    # One distance and noise: multiplied by 0.3048, the noise is smaller, and delays could compensate the rest.
    count, reply = 200, 20_000_000
    flight = 640 + np.random.default_rng(4).integers(-8, 9, count)
    zero = np.zeros(count, dtype=np.int64)
    exchanges = Exchanges.from_arrays(
        zero + 10, zero + 20, time_ns=np.arange(count) * 10**7, tx1=zero, rx1=zero + 640,
        tx2=zero + 640 + reply, rx2=flight + 640 + reply,
    )  # fmt: skip
    seats = [Tag(10, "left", (0.0, 0.0, 0.0)), Tag(20, "right", (0.0, 0.0, 0.0))]
    Contents(exchanges=exchanges, tags=seats).save(tmp_path / "still.uwb")
    rows = [f"{t},{body},{x},0,0,0,0,0,1" for t in (-1, 3) for body, x in (("left", 0.0), ("right", 3.0))]
    (tmp_path / "p.csv").write_text("time_s,body,x,y,z,qx,qy,qz,qw\n" + "\n".join(rows) + "\n")
    assert add_poses(tmp_path / "still.uwb", tmp_path / "p.csv").covered == count


# Poses as written by drivers of motion capture: messages, topics, several files, anchors.


TURNED = [0.0, 0.0, 0.6, 0.8]


def bag(path, messages):
    """Write a ROS 2 bag of (topic, kind, position, frame) at seconds 0, 1, 2."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="the extra uwbcal[bags] is not installed")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    t = {name.split("/")[-1]: kind for name, kind in store.types.items()}
    turned, uncertain = t["Quaternion"](*TURNED), "PoseWithCovarianceStamped"

    def made(kind, k, place, frame):
        header = t["Header"](t["Time"](k, 500), "world")
        pose = t["Pose"](t["Point"](place + k, 2.0, 3.0), turned)
        with_covariance = t["PoseWithCovariance"](pose, np.zeros(36))
        still = t["TwistWithCovariance"](t["Twist"](t["Vector3"](0, 0, 0), t["Vector3"](0, 0, 0)), np.zeros(36))
        transform = t["TransformStamped"](header, frame, t["Transform"](t["Vector3"](place + k, 2.0, 3.0), turned))
        return {
            "geometry_msgs/msg/PoseStamped": lambda: t["PoseStamped"](header, pose),
            f"geometry_msgs/msg/{uncertain}": lambda: t[uncertain](header, with_covariance),
            "nav_msgs/msg/Odometry": lambda: t["Odometry"](header, frame, with_covariance, still),
            "geometry_msgs/msg/TransformStamped": lambda: transform,
            "tf2_msgs/msg/TFMessage": lambda: t["TFMessage"]([transform]),
        }[kind]()

    with rosbag2.Writer(path, version=9) as writer:
        for topic, kind, place, frame in messages:
            connection = writer.add_connection(topic, kind, typestore=store)
            for k in range(3):
                writer.write(connection, k * 10**9, store.serialize_cdr(made(kind, k, place, frame), kind))


@pytest.mark.parametrize(
    ("topic", "kind", "frame"),
    [
        ("/vrpn_mocap/drone/pose", "geometry_msgs/msg/PoseStamped", ""),
        ("/mocap/rigid_bodies/drone/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", ""),
        ("/qualisys/drone/odom", "nav_msgs/msg/Odometry", "base"),
        ("/vicon/anything", "geometry_msgs/msg/TransformStamped", "vicon/drone/drone"),
        ("/tf", "tf2_msgs/msg/TFMessage", "drone"),
    ],
)
def test_every_kind_of_message(tmp_path, topic, kind, frame):
    bag(tmp_path / "bag", [(topic, kind, 5.0, frame)])
    poses = read_poses(tmp_path / "bag")
    assert (poses.body.tolist(), poses.time_ns.tolist()) == (["drone"] * 3, [500, 1_000_000_500, 2_000_000_500])
    assert poses.position_m.tolist() == [[5.0, 2.0, 3.0], [6.0, 2.0, 3.0], [7.0, 2.0, 3.0]]
    np.testing.assert_allclose(poses.quaternion, [TURNED] * 3)


def test_topics_by_body(tmp_path):
    pose, odometry = "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Odometry"
    bag(tmp_path / "bag", [("/a/pose", pose, 1.0, ""), ("/b/pose", pose, 2.0, ""), ("/c/odom", odometry, 3.0, "x")])
    assert set(read_poses(tmp_path / "bag").body) == {"a", "b"}
    poses = read_poses(tmp_path / "bag", topics={"drone": "/b/pose", "car": "/c/odom"})
    assert [poses[poses.body == body].position_m[0, 0] for body in ("drone", "car")] == [2.0, 3.0]
    (tmp_path / "t.tum").write_text("0 1 2 3 0 0 0 1\n")
    for name, said in (
        ("bag", "'/d' is not there; topics with poses are /a/pose, /b/pose, /c/odom"),
        ("t.tum", "has no topics"),
    ):
        with pytest.raises(errors.ImportTableError, match=said):
            read_poses(tmp_path / name, topics={"drone": "/d"})


@pytest.fixture
def recording(tmp_path):
    """A recording of tag 1 on a car, 2 on a drone and anchor 9, and a trajectory of each body."""
    ids = np.array([[1, 2], [1, 9], [2, 9]] * 5)
    when = np.arange(15) * 100_000_000
    e = Exchanges.from_arrays(ids[:, 0], ids[:, 1], time_ns=when, tx1=[0] * 15, rx1=5, tx2=1005, rx2=3000)
    tags = [Tag(k, body, (0.0, 0.0, 0.0)) for k, body in ((1, "car"), (2, "drone"), (9, "tag9"))]
    for body, x in (("car", 0.0), ("drone", 4.0)):
        (tmp_path / f"{body}.tum").write_text("".join(f"{k / 10} {x} 0 {k / 10} 0 0 0 1\n" for k in range(20)))
    Contents(exchanges=e, tags=tags).save(tmp_path / "r.uwb")
    return tmp_path / "r.uwb"


def test_bodies_without_poses_are_named_whether_some_or_no_ranges_have_both_ends(recording, tmp_path):
    """Of the pairs 1-2, 1-9 and 2-9, car and drone have poses, or none."""
    places, files = tmp_path / "places.toml", ["--from", f"car={tmp_path / 'car.tum'}"]
    done = processes.run("uwblink", "poses", recording, *files, "--from", f"drone={tmp_path / 'drone.tum'}")
    assert (done.returncode, done.stderr) == (0, "")
    assert "5 of 15 measurements have a true distance; no poses of tag9" in done.stdout
    places.write_text("".join(f'[[tags]]\nid = {k}\nbody = "{name}"\n' for k, name in ((1, "Car"), (2, "car"))))
    said = "bodies are car, but those of the tags are Car, car; give the bodies of tags 9, which range,"
    words = ("poses", recording, *files, "--tags", places, "--offset", "auto", "--force")
    processes.refuse("uwblink", *words, naming=[said])


def test_trajectories_of_several_bodies_and_anchors(recording, tmp_path):
    (tmp_path / "places.toml").write_text("[[anchors]]\nid = 9\nposition_m = [0.0, 3.0, 0.0]\n")
    files = {body: tmp_path / f"{body}.tum" for body in ("car", "drone")}
    found = add_poses(recording, files, tags_from=tmp_path / "places.toml")
    assert (found.bodies, found.covered, found.exchanges) == (("anchor9", "car", "drone"), 15, 15)
    held = load(recording)
    assert {tag.tag: tag.body for tag in held.tags} == {1: "car", 2: "drone", 9: "anchor9"}
    assert (held.poses.body == "anchor9").sum() == 1
    np.testing.assert_allclose(truth(recording)[:2], [4.0, np.hypot(3.0, 0.1)])


def test_wrong_anchors_are_refused(recording, tmp_path):
    for text, fragment in (
        ("[[anchors]]\nid = 9\n", "anchors[0].position_m"),
        ("[[anchors]]\nid = 9\nposition_m = [1, 2]\n", "three numbers"),
        ("[[anchors]]\nid = 9\nposition_m = [1, 2, 3]\n" * 2, "found 9, expected another id"),
        ("[[anchors]]\nid = 9\nposition_m = [1, 2, 3]\ncovariance_m2 = [1.0]\n", "six numbers"),
        ("[[anchors]]\nid = 9\nplace = [1, 2, 3]\n", "unknown key"),
        ("anchors = 3\n", "expected tables [[anchors]]"),
        ("a = 3\n", "a: unknown key"),
    ):
        (tmp_path / "places.toml").write_text(text)
        with pytest.raises(errors.PlanError, match=one_line(fragment)):
            add_poses(recording, tmp_path / "car.tum", body="car", tags_from=tmp_path / "places.toml")
    assert not load(recording).poses


# Exports of motion-capture programs, made here from their descriptions, compared with planted poses and distances.


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


def angles(turned, order):
    """Return angles about x, y and z in degrees, of successive rotations about the body's own axes, by elements of the
    matrix.

    R = Rx(a) Ry(b) Rz(c) or Rz(c) Ry(b) Rx(a), multiplied by hand.
    """
    r = turned.as_matrix()
    if order == "XYZ":
        found = np.arctan2(-r[1, 2], r[2, 2]), np.arcsin(r[0, 2]), np.arctan2(-r[0, 1], r[0, 0])
    else:
        found = np.arctan2(r[2, 1], r[2, 2]), -np.arcsin(r[2, 0]), np.arctan2(r[1, 0], r[0, 0])
    return np.degrees(found)


def motive(folder, version="1.23", unit="Millimeters", labelled=True, rotation="Quaternion"):
    scale = {"Millimeters": 1000.0, "Meters": 1.0}[unit]
    turns = "XYZ" if len(rotation) == 3 else "XYZW"

    def numbers(name, k):
        place, turned = BODIES[name][0][k] * scale, BODIES[name][1][k]
        written = angles(turned, rotation) if turns == "XYZ" else turned.as_quat()
        return [*written, *place, 0.001, *place]  # followed by a marker of the body

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
    count = np.ones(len(times), np.int64)
    return Exchanges.from_arrays(count, 2, time_ns=np.rint(times * 1e9).astype(np.int64), range_m=range_m)


def truth(path):
    found = load(path)
    return distances_m(
        found.poses, found.tags, *(getattr(found.exchanges, n) for n in ("initiator", "target", "time_ns"))
    )


def save_ranges_between(path, arms=ARMS):
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
    true = save_ranges_between(tmp_path / "r.uwb")
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
    true = save_ranges_between(words[2], none)
    if text:
        processes.refuse(*words, naming=["time_s", "when", "--map"])
        (tmp_path / "map.toml").write_text(text)
        words += ["--map", tmp_path / "map.toml"]
    processes.succeed(*words)
    np.testing.assert_allclose(truth(words[2]), true, atol=1e-6)
    save_ranges_between(words[2])
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
    with pytest.raises(errors.ImportTableError, match="`source` with poses nor `tags_from`"):
        add_poses(tmp_path / "anchors.json.uwb", {})
