"""MCAP files of JSON messages: exports of the project, which are imported again, and files of the library `mcap`."""

import json
import struct

import numpy as np
import pytest

from tests.errors import one_line
from tests.uwblink.importers.test_bag_guess import by_guess
from uwblink import Contents, Exchanges, Poses, errors
from uwblink.exporters import export_recording
from uwblink.importers import read_source
from uwblink.importers.poses import read_poses

WHEN = 1_706_822_508_042_560_815


@pytest.fixture
def exported(tmp_path):
    """A recording of two pairs and two bodies with some unknown values, and the folder of its export."""
    rng = np.random.default_rng(3)
    n = 40
    tx1, reply, flight = (rng.integers(low, high, n) for low, high in ((0, 10**9), (10**7, 2 * 10**7), (100, 3000)))
    exchanges = Exchanges.from_arrays(
        np.where(np.arange(n) % 2, 1, 3), np.full(n, 2), time_ns=WHEN + np.arange(n) * 10**7,
        tx1=tx1, rx1=tx1 + flight, tx2=tx1 + flight + reply, rx2=tx1 + 2 * flight + reply,
        fpp1_dbm=rng.normal(-85, 3, n), fpp2_dbm=np.where(np.arange(n) < 30, np.nan, -84.5),
        skew1_ppm=rng.normal(size=n), truth_m=rng.normal(4, 1, n),
    )  # fmt: skip
    attitude = rng.normal(size=(20, 4))
    poses = Poses(
        WHEN + np.arange(20) * 10**8, np.array(["drone", "car"] * 10), rng.normal(size=(20, 3)),
        attitude / np.linalg.norm(attitude, axis=1)[:, None],
    )  # fmt: skip
    held = Contents(exchanges=exchanges, poses=poses)
    held.save(tmp_path / "r.uwb")
    for to in ("mcap", "rosbag2"):
        export_recording(tmp_path / "r.uwb", tmp_path / to, to=to)
    return held, tmp_path / "mcap" / "recording.mcap"


@pytest.mark.parametrize("name", ["mcap/recording.mcap", "rosbag2/rosbag2"])
def test_exported_ranges_are_imported_without_a_map_and_by_the_guess(exported, tmp_path, name):
    """They have distances and powers; the map that is guessed has no distances."""
    held, found = exported[0].exchanges, read_source(tmp_path / name, importer="bag").exchanges
    names = "time_ns initiator target range_m truth_m fpp1_dbm fpp2_dbm skew1_ppm skew2_ppm"
    for column in names.split():
        np.testing.assert_array_equal(getattr(found, column), getattr(held, column), err_msg=column)
    assert not found.tx1.any()
    e = by_guess(tmp_path, tmp_path / name).exchanges
    np.testing.assert_array_equal([e.time_ns, e.fpp1_dbm], [held.time_ns, held.fpp1_dbm])


def test_exported_poses_are_imported(exported):
    held, path = exported
    found = read_poses(path)
    for name in ("time_ns", "body", "position_m"):
        assert getattr(found, name).tolist() == getattr(held.poses, name).tolist()
    np.testing.assert_allclose(found.quaternion, held.poses.quaternion, atol=1e-15)
    assert set(read_poses(path, topics={"lorry": "/poses/car"}).body) == {"lorry"}


def written(path, messages, schema="uwb_msgs.Range", compressed=False):
    """Write messages by topic with the library of the format, in chunks."""
    mcap = pytest.importorskip("mcap.writer", reason="mcap is not installed")
    kind = mcap.CompressionType.ZSTD if compressed else mcap.CompressionType.NONE
    with path.open("wb") as file:
        writer = mcap.Writer(file, compression=kind, chunk_size=500)
        writer.start()
        number = writer.register_schema(schema, "jsonschema", b'{"type": "object"}')
        for topic, contents in messages.items():
            channel = writer.register_channel(topic, "json", number)
            for k, content in enumerate(contents):
                data = content if isinstance(content, bytes) else json.dumps(content).encode()
                writer.add_message(channel, WHEN + k * 10**7, data, WHEN + k * 10**7)
        writer.finish()
    return path


@pytest.mark.parametrize("compressed", [False, True])
def test_others_messages_in_chunks_by_a_map(tmp_path, compressed):
    rows = [
        {"header": {"stamp": {"sec": 100 + k, "nsec": 5}}, "tag": 7, "to": {"anchor": 1 + k % 3}, "mm": 1000 + k}
        for k in range(50)
    ]
    path = written(tmp_path / "t.mcap", {"/uwb": rows, "/other": [{"a": 1}]}, compressed=compressed)
    (tmp_path / "m.toml").write_text(
        '[topics."/uwb"]\n[columns]\nfrom_id = "tag"\nto_id = "to.anchor"\nrange_m = "mm"\n[units]\ndistance = "mm"\n'
    )
    found = read_source(path, map_file=tmp_path / "m.toml").exchanges
    assert found.time_ns.tolist() == [(100 + k) * 10**9 + 5 for k in range(50)]
    assert found.target.tolist() == [1 + k % 3 for k in range(50)]
    np.testing.assert_allclose(found.range_m, 1 + np.arange(50) / 1000, atol=1e-12)


def posed(x=1.0, sec=1):
    pose = {"position": {"x": x, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
    return {"timestamp": {"sec": sec, "nsec": 0}, "pose": pose}


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (b"{", "is not JSON"),
        (b"[" * 100_000, "is not JSON"),
        ([1], "is not an object of JSON"),
        ({"timestamp": 3, "pose": {}}, "is no foxglove.PoseInFrame"),
        (posed(x="here"), "is no foxglove.PoseInFrame"),
        (posed(x=float("nan")), "is no foxglove.PoseInFrame"),
        (posed(sec=10**30), "is no foxglove.PoseInFrame"),
    ],
)
def test_wrong_poses_are_one_line(tmp_path, message, said):
    path = written(tmp_path / "t.mcap", {"/poses/a": [message]}, "foxglove.PoseInFrame")
    with pytest.raises(errors.ImportTableError, match=said):
        read_poses(path)


# Versions of rosbags before 0.11.9 do not close a file that they refuse.
@pytest.mark.filterwarnings("ignore:Exception ignored in. <_io.FileIO.*z.mcap:pytest.PytestUnraisableExceptionWarning")
def test_cut_broken_and_endless_files_are_one_line(exported, tmp_path):
    data, path = exported[1].read_bytes(), tmp_path / "t.mcap"
    # A chunk that is larger than the memory when it is unpacked.
    content = struct.pack("<QQQII", 0, 0, 2**40, 0, 4) + b"zstd" + struct.pack("<Q", 0)
    bomb = b"\x89MCAP0\r\n" + struct.pack("<BQ", 0x01, 8) + bytes(8) + struct.pack("<BQ", 0x06, len(content)) + content
    longest = data[: data.index(b"uwbcal") + 6] + struct.pack("<BQ", 0x05, 2**63)
    cuts = [(data[:cut], "") for cut in range(9, len(data) - 40, 1013)]
    for broken, said in (*cuts, (longest, ""), (bomb, "a chunk unpacks to 1099511627776 bytes")):
        path.write_bytes(broken)
        with pytest.raises(errors.ImportTableError, match=one_line("t.mcap", said)):
            read_source(path)
    path.unlink()
    # An object that is nested too deeply.
    with pytest.raises(errors.ImportTableError, match=one_line("t.mcap")):
        read_source(written(path, {"/uwb": [b'{"a":' * 700 + b"1" + b"}" * 700]}))
