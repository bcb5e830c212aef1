"""MCAP files, read by the library of the format."""

import json

import numpy as np
import pytest
from mcap.reader import make_reader

from uwblink.errors import RecordingError
from uwblink.exporters import export_recording
from uwblink.recording.contents import Contents
from uwblink.recording.schema import Fault, Poses
from uwblink.twr import Exchanges


def read(path):
    with path.open("rb") as file:
        messages = []
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            content = json.loads(message.data)
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            assert set(content) <= set(json.loads(schema.data)["properties"])
            messages.append((message.log_time, channel.topic, schema.name, content))
    return messages


@pytest.fixture
def recording(tmp_path):
    when = 1_706_822_508_042_560_815
    e = Exchanges.from_arrays(
        [1, 2], [2, 1], time_ns=[when + 5, when], tx1=[0, 9], rx1=[5, 3], tx2=[1005, 1003], rx2=[3000, 3009],
        fpp1_dbm=[-80.5, np.nan],
    )  # fmt: skip
    poses = Poses.from_arrays([when + 1], "drone", [[1.0, 2.0, 3.0]], [[0.0, 0.0, 0.6, 0.8]])
    imu = {n: np.array([k * 1.0]) for k, n in enumerate(("wx", "wy", "wz", "ax", "ay", "az"))}
    held = Contents(
        exchanges=e,
        poses=poses,
        imu={"time_ns": np.array([when + 2]), "body": np.array(["drone"]), **imu},
        height={"time_ns": np.array([when + 3]), "body": np.array(["drone"]), "height_m": np.array([0.5])},
        temperature={
            "time_ns": np.array([when + 6]),
            "tag": np.array([2]),
            "temperature_c": np.array([31.5]),
            "supply_v": np.array([np.nan]),
        },
        faults=[Fault(when + 4, "7", "time-out", 'no "answer"')],
    )
    held.save(tmp_path / "r.uwb")
    return tmp_path / "r.uwb", when


def test_every_message_is_there_in_order_of_time(recording, tmp_path):
    path, when = recording
    assert export_recording(path, tmp_path / "out", to="mcap") == {"recording.mcap": 8}
    messages = read(tmp_path / "out" / "recording.mcap")
    assert [logged - when for logged, *_ in messages] == [0, 1, 1, 2, 3, 4, 5, 6]
    by_topic = {topic: (name, content) for _, topic, name, content in messages}
    name, content = by_topic["/poses/drone"]
    assert name == "foxglove.PoseInFrame"
    assert content["pose"]["position"] == {"x": 1.0, "y": 2.0, "z": 3.0}
    assert content["pose"]["orientation"] == {"x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8}
    assert content["timestamp"] == {"sec": 1_706_822_508, "nsec": 42_560_816}
    name, content = by_topic["/tf"]
    assert (name, content["parent_frame_id"], content["child_frame_id"]) == (
        "foxglove.FrameTransform",
        "world",
        "drone",
    )
    assert by_topic["/ranges/1_2"][1]["fpp1_dbm"] == -80.5
    assert by_topic["/ranges/1_2"][1]["range_m"] == pytest.approx(4.690357)
    assert "fpp1_dbm" not in by_topic["/ranges/2_1"][1], "JSON has no word for what was not measured"
    assert by_topic["/imu/drone"][1]["linear_acceleration"] == {"x": 3.0, "y": 4.0, "z": 5.0}
    assert by_topic["/height/drone"][1]["height_m"] == 0.5
    assert by_topic["/temperature/2"][1].keys() == {"timestamp", "temperature_c"}
    assert by_topic["/faults"][1]["message"] == 'time-out: no "answer"'


@pytest.mark.parametrize(
    ("time_ns", "x", "said"), [(-5, 1.0, "before 1970"), (5, np.nan, "a number that is not finite")]
)
def test_what_json_cannot_say_is_one_line(tmp_path, time_ns, x, said):
    sample = Exchanges.from_arrays([1], [2], time_ns=[time_ns], tx1=[0], rx1=[5], tx2=[1005], rx2=[3000])
    poses = Poses(np.array([9]), np.array(["drone"]), np.array([[x, 1.0, 0.0]]), np.array([[0.0, 0.0, 0.0, 1.0]]))
    Contents(exchanges=sample, poses=poses).save(tmp_path / "r.uwb")
    with pytest.raises(RecordingError, match=said):
        export_recording(tmp_path / "r.uwb", tmp_path / "out", to="mcap")
    assert not (tmp_path / "out").exists()
