"""Exports: every column of every table is imported again unchanged, and other programs read the files."""

import json
from typing import Any

import duckdb
import numpy as np
import pandas as pd
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import calib
from tests.registered import registered
from tests.uwblink.recording.test_contents import full, rows  # noqa: F401 - full is a fixture
from uwblink import Contents, Exchanges, Recording, errors, import_recording, load
from uwblink.exporters import EXPORTERS, Exporter, export_recording, register_exporter
from uwblink.importers import read_source
from uwblink.importers.poses import read_poses
from uwblink.recording.schema import TABLES, Fault, Poses, Tag


@pytest.fixture(scope="module")
def whole(full):  # noqa: F811
    """A recording with rows in every table, without missing values that only edited files have."""
    with duckdb.connect(str(full)) as db:
        db.execute("DELETE FROM exchanges WHERE tx1 IS NULL")
        db.execute("DELETE FROM cirs WHERE magnitudes IS NULL")
        db.execute("DELETE FROM faults WHERE board IS NULL")
    with Recording.open(full, update=True) as recording:
        recording.append("faults", [Fault(3, "", 'odd, "quoted"', "two\nlines; nan")])
    return full


def in_order(path):
    # Contents are saved in order of time, the exchanges in their own order.
    return {table: found if table == "exchanges" else sorted(found) for table, found in rows(path).items()}


@pytest.mark.parametrize("form", [pytest.param("csv", marks=pytest.mark.slow), "parquet"])
def test_every_column_of_every_table_is_imported_again(whole, tmp_path, form):
    folder = tmp_path / "it's; DROP TABLE x"
    counts = export_recording(whole, folder, to=form)
    expected = in_order(whole)
    assert all(expected.values()), "the test needs rows in every table"
    assert counts == {f"{table}.{form}": len(found) for table, found in expected.items()}
    import_recording(folder, tmp_path / "back.uwb", importer="exported")
    assert in_order(tmp_path / "back.uwb") == expected


def test_trajectories(tmp_path):
    """Also times of a clock with another origin; the second is within a second of zero."""
    time = [1_706_822_508_042_560_815, -1_500_000_000, -250_000_000, 750_000_000]
    poses = Poses.from_arrays(time, ["a/b", "c", "c", "c"], [[1.5, -2.0, 0.1]] * 4, [[0.0, 0.0, 0.6, 0.8]] * 4)
    with Recording.create(tmp_path / "r.uwb") as recording:
        recording.append("poses", poses)
    assert export_recording(tmp_path / "r.uwb", tmp_path / "tum", to="tum") == {"a_b.tum": 1, "c.tum": 3}
    one, other = ((tmp_path / "tum" / name).read_text() for name in ("a_b.tum", "c.tum"))
    assert one == "1706822508.042560815 1.5 -2.0 0.1 0.0 0.0 0.6 0.8\n"
    assert [line.split()[0] for line in other.splitlines()] == ["-1.500000000", "-0.250000000", "0.750000000"]


def test_an_earlier_export_is_replaced(whole, tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "meta.csv").write_text("mine")
    export_recording(whole, tmp_path / "there", to="csv", force=True)
    assert sorted(path.stem for path in (tmp_path / "there").iterdir()) == sorted(TABLES)


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("out", [".", "..", "/"])
def test_a_folder_without_a_name_of_its_own_is_refused_with_an_example(whole, tmp_path, monkeypatch, out, force):
    (tmp_path / "inside").mkdir()
    monkeypatch.chdir(tmp_path / "inside")
    with pytest.raises(errors.RecordingExistsError, match=r"existing folder.*as in .*tables"):
        export_recording(whole, out, to="csv", force=force)
    assert [*tmp_path.rglob("*")] == [tmp_path / "inside"]


def test_folders_without_an_export_are_not_replaced(whole, tmp_path):
    with pytest.raises(errors.ImportTableError, match=r"contains no exchanges\.csv"):
        import_recording(tmp_path, tmp_path / "o.uwb", importer="exported")
    export_recording(whole, tmp_path / "out", to="csv")
    for name, old, new, said in (
        ("imu.csv", "wx", "gyro_x", r"imu\.csv: lacks the columns wx; imu has time_ns, body, wx, wy"),
        ("exchanges.csv", "\n", "\nx", "not in the form of 'uwblink export'"),
    ):
        kept = (tmp_path / "out" / name).read_text()
        (tmp_path / "out" / name).write_text(kept.replace(old, new, 1))
        with pytest.raises(errors.ImportTableError, match=said):
            import_recording(tmp_path / "out", tmp_path / "o.uwb", importer="exported")
        (tmp_path / "out" / name).write_text(kept)
    assert not (tmp_path / "o.uwb").exists()


def test_registered_exporters_are_used(whole, tmp_path):
    def write(recording, folder):
        (folder / "name.txt").write_text(recording.name)
        return {"name.txt": 1}

    with registered(EXPORTERS, Exporter("names", write, "the name")):
        assert export_recording(whole, tmp_path / "out", to="names") == {"name.txt": 1}
    with pytest.raises(errors.ArgumentError, match="this name is reserved"):
        register_exporter(Exporter("csv", write, "mine"))


def test_a_link_to_a_recording_is_exported_like_the_recording(tmp_path):
    (tmp_path / "there").mkdir()
    exchanges = Exchanges.from_arrays([1], [2], tx1=[0], rx1=[5], tx2=[1005], rx2=[3000])
    Contents(exchanges=exchanges).save(tmp_path / "there" / "r.uwb")
    (tmp_path / "link.uwb").symlink_to(tmp_path / "there" / "r.uwb")
    assert export_recording(tmp_path / "link.uwb", tmp_path / "out", to="csv")["exchanges.csv"] == 1


@pytest.fixture
def flown(tmp_path):
    """One tag on a body that moves along x, half a metre ahead of it; the second of three distances was measured."""
    exchanges = Exchanges.from_arrays(
        [1] * 3, [2] * 3, time_ns=[0, 10**9, 10**10], tx1=[0] * 3, rx1=[0] * 3, tx2=[10**8] * 3, rx2=[127_795_200] * 3,
        truth_m=[np.nan, 7.25, np.nan],
    )  # fmt: skip
    poses = Poses.from_arrays([0, 2 * 10**9], ["drone"] * 2, [[0.0, 3.0, 0.0], [4.0, 3.0, 0.0]])
    mast = Poses.from_arrays([0], ["mast"], [[0.0, 0.0, 0.0]])
    both = Poses(*(np.concatenate([getattr(p, n) for p in (mast, poses)]) for n in Poses.__slots__))
    tags = [Tag(1, "mast", (0.0, 0.0, 0.0)), Tag(2, "drone", (0.5, 0.0, 0.0))]
    Contents(exchanges=exchanges, tags=tags, poses=both).save(tmp_path / "flown.uwb")
    return tmp_path / "flown.uwb"


BY_HAND = [np.hypot(0.5 + 2 * 0.001, 3.0), 7.25]
"""At the middle of a range, 1 ms after its time, the body is at 2 mm; the third exchange is after the last pose."""


@pytest.mark.parametrize("to", ["csv", pytest.param("parquet", marks=pytest.mark.slow)])
def test_missing_true_distances_are_those_of_the_poses(flown, tmp_path, to):
    export_recording(flown, tmp_path / "out", to=to)
    with duckdb.connect() as db:
        query = f"SELECT truth_m, truth_from FROM read_{to}(?)"
        truths, sources = zip(*db.execute(query, [f"{tmp_path}/out/exchanges.{to}"]).fetchall(), strict=True)
    assert truths[:2] == pytest.approx(BY_HAND, abs=1e-9)
    assert (truths[2], sources) == (None, ("poses", "measured", None))
    import_recording(tmp_path / "out", tmp_path / "back.uwb", importer="exported")
    assert in_order(tmp_path / "back.uwb") == in_order(flown), "what the poses say is not taken for measured"


def test_messages_have_true_distances_by_the_poses(flown, tmp_path):
    export_recording(flown, tmp_path / "out", to="mcap")
    found = read_source(tmp_path / "out" / "recording.mcap").exchanges
    assert found.truth_m == pytest.approx([*BY_HAND, np.nan], abs=1e-9, nan_ok=True)


# Exports read by common readers: mcap, rosbags and pandas.


WHEN = 1_706_822_508_042_560_815


@pytest.fixture
def recording(tmp_path):
    random = np.random.default_rng(3)
    n = 50
    stamps: dict[str, Any] = {name: random.integers(0, 2**32, n) for name in ("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")}
    e = Exchanges.from_arrays(
        random.integers(1, 4, n), random.integers(4, 7, n), time_ns=WHEN + random.permutation(n) * 10**7,
        fpp1_dbm=random.uniform(-100, -80, n), **stamps,
    )  # fmt: skip
    turned = random.normal(size=(n, 4))
    poses = Poses.from_arrays(
        WHEN + np.arange(n) * 10**7, np.where(np.arange(n) % 2, "drone", "rover 1"), random.normal(size=(n, 3)),
        turned / np.linalg.norm(turned, axis=1)[:, None],
    )  # fmt: skip
    readings = {"time_ns": WHEN + np.arange(n), "body": np.full(n, "drone")}
    celsius = {"temperature_c": np.array([31.5, 32.0]), "supply_v": np.array([3.25, np.nan])}
    Contents(
        exchanges=e,
        poses=poses,
        imu=readings | {name: random.normal(size=n) for name in ("wx", "wy", "wz", "ax", "ay", "az")},
        height=readings | {"height_m": random.uniform(0, 3, n)},
        temperature={"time_ns": WHEN + np.arange(2), "tag": np.array([2, 2])} | celsius,
        faults=[Fault(WHEN + 4, "7", "time-out", 'no "answer"')],
    ).save(tmp_path / "r.uwb")
    return tmp_path / "r.uwb"


def messages_of(bag):
    """Return topic, time, type and content of each message of a bag."""
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        return [(c.topic, ns, c.msgtype, reader.deserialize(raw, c.msgtype)) for c, ns, raw in reader.messages()]


def test_rosbags_reads_standard_messages(recording, tmp_path):
    held = load(recording)
    count = export_recording(recording, tmp_path / "out", to="rosbag2")["rosbag2"]
    messages: list[Any] = messages_of(tmp_path / "out" / "rosbag2")
    by_topic = {topic: [message for name, *message in messages if name == topic] for topic, *_ in messages}
    assert len(messages) == count
    e = held.exchanges
    chosen = (e.initiator == 2) & (e.target == 5)
    found = by_topic["/uwb/range_2_5"]
    expected_ns = sorted(e.time_ns[chosen].tolist())
    assert [(t, kind) for t, kind, _ in found] == [(t, "sensor_msgs/msg/Range") for t in expected_ns]
    # The message has floats of 32 bits.
    expected = e.range_m[chosen][np.argsort(e.time_ns[chosen])]
    assert [m.range for *_, m in found] == pytest.approx(expected.tolist(), rel=1e-6)
    stamp = found[0][2].header.stamp
    assert (stamp.sec * 10**9 + stamp.nanosec, len(by_topic["/tf"])) == (found[0][0], len(held.poses))
    assert by_topic["/tf"][0][2].transforms[0].child_frame_id == "rover 1"
    imu = by_topic["/imu/drone"][3][2]
    assert [imu.angular_velocity.x, imu.linear_acceleration.z] == [held.imu["wx"][3], held.imu["az"][3]]
    assert imu.orientation_covariance[0] == -1, "by its definition: the attitude is not measured"
    assert len(by_topic["/height/drone"]) == 50
    assert [m.temperature for *_, m in by_topic["/temperature/uwb_2"]] == [31.5, 32.0]
    assert by_topic["/faults"][0][2].msg == 'time-out: no "answer"'
    bodies = [body.replace(" ", "_") for body in held.poses.body]
    assert read_poses(tmp_path / "out" / "rosbag2").body.tolist() == bodies


def test_every_message_is_there_in_order_of_time(recording, tmp_path):
    held, messages = load(recording), []
    # 50 poses are two messages each.
    assert export_recording(recording, tmp_path / "out", to="mcap") == {"recording.mcap": 50 + 100 + 50 + 50 + 2 + 1}
    with (tmp_path / "out" / "recording.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            content = json.loads(message.data)
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            assert set(content) <= set(json.loads(schema.data)["properties"])
            messages.append((message.log_time, channel.topic, schema.name, content))
    times = [logged for logged, *_ in messages]
    assert times == sorted(times)
    first = {topic: (name, content) for _, topic, name, content in reversed(messages)}
    e, poses = held.exchanges, held.poses
    earliest = int(np.argmin(e.time_ns))
    of_range = ("initiator", "target", "range_m", "fpp1_dbm")
    pose = {
        "position": dict(zip("xyz", poses.position_m[1].tolist(), strict=True)),
        "orientation": dict(zip("xyzw", poses.quaternion[1].tolist(), strict=True)),
    }
    expected: dict[str, tuple[str, dict[str, Any]]] = {
        "/poses/drone": (
            "foxglove.PoseInFrame",
            {"timestamp": {"sec": 1_706_822_508, "nsec": 52_560_815}, "pose": pose},
        ),
        "/tf": ("foxglove.FrameTransform", {"parent_frame_id": "world", "child_frame_id": "rover 1"}),
        f"/ranges/{e.initiator[earliest]}_{e.target[earliest]}": (
            "uwb.Range",
            {column: getattr(e, column)[earliest] for column in of_range},
        ),
        "/imu/drone": ("uwb.Imu", {"linear_acceleration": {axis: held.imu[f"a{axis}"][0] for axis in "xyz"}}),
        "/height/drone": ("uwb.Height", {"height_m": held.height["height_m"][0]}),
        "/faults": ("foxglove.Log", {"message": 'time-out: no "answer"'}),
    }
    for topic, (kind, part) in expected.items():
        name, content = first[topic]
        assert (name, content | part) == (kind, content), topic
        assert "fpp2_dbm" not in content, "JSON has no word for what was not measured"
    celsius = [set(content) for _, topic, _, content in messages if topic == "/temperature/2"]
    assert celsius == [{"timestamp", "temperature_c", "supply_v"}, {"timestamp", "temperature_c"}]


@pytest.mark.parametrize(
    ("to", "time_ns", "range_m", "x", "said"),
    [
        ("mcap", -5, 3.0, 1.0, "before 1970"),
        ("rosbag2", -5, 3.0, 1.0, "before 1970"),
        ("mcap", 5, 3.0, np.nan, "a number that is not finite"),
        ("rosbag2", 5, 1e39, 1.0, r"r\.uwb: /uwb/range_1_2: has a number that is .*too large"),
    ],
)
def test_values_that_do_not_fit_messages_are_an_error_of_one_line(tmp_path, to, time_ns, range_m, x, said):
    sample = Exchanges.from_arrays([1], [2], time_ns=[time_ns], range_m=[range_m], tx1=[0], rx1=[5], tx2=[9], rx2=[30])
    poses = Poses(np.array([9]), np.array(["drone"]), np.array([[x, 1.0, 0.0]]), np.array([[0.0, 0.0, 0.0, 1.0]]))
    Contents(exchanges=sample, poses=poses).save(tmp_path / "r.uwb")
    with pytest.raises(errors.RecordingError, match=said):
        export_recording(tmp_path / "r.uwb", tmp_path / "out", to=to)
    assert not (tmp_path / "out").exists()


def test_bags_without_the_extra_are_refused(recording, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "rosbags.rosbag2", None)
    with pytest.raises(errors.RecordingError, match=r"pip install 'uwbcal\[bags\]'"):
        export_recording(recording, tmp_path / "out", to="rosbag2")
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def corrected(tmp_path_factory):
    """A flight of three tags before and after a calibration, and the correction of each range."""
    folder = tmp_path_factory.mktemp("corrected")
    flight = calib.sample_flight()
    Contents(exchanges=flight.exchanges, tags=flight.tags, poses=flight.poses).save(folder / "f.uwb")
    known = calib.fit(flight).calibration
    calib.apply(folder / "f.uwb", known, folder / "c.uwb")
    return folder, flight.exchanges, known, known.apply(calib.load_ranges(folder / "f.uwb"))


@pytest.mark.parametrize("form", ["csv", pytest.param("parquet", marks=pytest.mark.slow)])
def test_corrected_ranges_are_exported_with_their_expected_errors(corrected, tmp_path, form):
    folder, exchanges, known, applied = corrected
    calib.apply(folder / "f.uwb", known, tmp_path / "out", to=form)
    frame = {"csv": pd.read_csv, "parquet": pd.read_parquet}[form](tmp_path / "out" / f"corrected.{form}")
    assert frame["time_ns"].tolist() == exchanges.time_ns.tolist()
    for name in ("raw_m", "corrected_m", "sigma_m", "sigma_total_m", "tail_share", "tail_probability", "clamped"):
        # Pandas before 3 reads floats to 3e-14; the import below shows that all digits are in the file.
        assert frame[name].tolist() == pytest.approx(getattr(applied, name).tolist(), rel=1e-13, abs=0)
    assert frame["clamped"].dtype == frame["outlier"].dtype == bool
    assert frame["outlier"].tolist() == applied.outlier.tolist()
    export_recording(folder / "c.uwb", tmp_path / "again", to=form)
    import_recording(tmp_path / "again", tmp_path / "again.uwb", importer="exported")
    for table in ("exchanges", "corrected"):
        assert rows(tmp_path / "again.uwb")[table] == rows(folder / "c.uwb")[table]


def test_corrected_ranges_in_messages(corrected, tmp_path):
    folder, exchanges, _, applied = corrected
    export_recording(folder / "c.uwb", tmp_path / "mcap", to="mcap")
    with (tmp_path / "mcap" / "recording.mcap").open("rb") as file:
        found = {
            (m.log_time, d["initiator"], d["target"]): d
            for s, _, m, d in ((s, c, m, json.loads(m.data)) for s, c, m in make_reader(file).iter_messages())
            if s.name == "uwb.Range"
        }
    for k in range(0, len(exchanges), 50):
        one = found[int(exchanges.time_ns[k]), int(exchanges.initiator[k]), int(exchanges.target[k])]
        assert one["range_m"] == applied.raw_m[k]
        for name in ("corrected_m", "sigma_m", "sigma_total_m", "tail_probability", "outlier", "clamped"):
            expected = getattr(applied, name)[k].item()
            assert (type(one[name]), one[name]) == (type(expected), expected), name
    export_recording(folder / "c.uwb", tmp_path / "bag", to="rosbag2")
    messages: list[Any] = [m for topic, *_, m in messages_of(tmp_path / "bag" / "rosbag2") if topic == "/uwb/range_1_2"]
    mine = (exchanges.initiator == 1) & (exchanges.target == 2)
    assert [m.range for m in messages] == pytest.approx(applied.corrected_m[mine].tolist(), rel=1e-6)
    assert [m.variance for m in messages] == pytest.approx((applied.sigma_total_m[mine] ** 2).tolist(), rel=1e-6)
