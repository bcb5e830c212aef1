"""What arrives at the other end: datagrams at a plain socket, messages at a viewer's WebSocket."""

import json
import math
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import uwblink
from tests.boards import served
from tests.uwblink.streaming.clients import FoxgloveClient
from uwblink.errors import PortError
from uwblink.streaming import FoxgloveServer, StreamedRange, UdpSender

BIN = Path(sys.executable).parent

ONE = StreamedRange(
    time_ns=1_706_822_508_042_560_815,
    initiator=10,
    target=20,
    range_m=3.25,
    corrected_m=3.0,
    sigma_m=0.03,
    fpp1_dbm=-85.5,
    fpp2_dbm=math.nan,
    skew1_ppm=1.5,
    skew2_ppm=-1.5,
    more={"clamped": False, "tail_probability": 0.125},
)


@pytest.fixture
def ear():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.bind(("127.0.0.1", 0))
        found.settimeout(20)
        yield found


def test_a_datagram_is_a_range_as_a_plotter_takes_it(ear):
    with UdpSender(str(ear.getsockname()[1])) as sender:
        sender.send(ONE)
    assert json.loads(ear.recv(65536)) == {
        "timestamp": pytest.approx(1_706_822_508.042_560_815, abs=1e-6),
        "ranges": {
            "10_20": {
                "range_m": 3.25, "corrected_m": 3.0, "sigma_m": 0.03, "fpp1_dbm": -85.5, "skew1_ppm": 1.5,
                "skew2_ppm": -1.5, "clamped": False, "tail_probability": 0.125,
            }
        },
    }  # fmt: skip


def test_sending_to_nobody_is_no_error(ear):
    port = ear.getsockname()[1]
    ear.close()
    with UdpSender(f"localhost:{port}") as sender:
        for _ in range(3):
            sender.send(ONE)


def test_a_viewer_gets_a_topic_a_pair_with_its_schema():
    with FoxgloveServer("0") as server:
        viewer = FoxgloveClient(server.url)
        assert viewer.text()["op"] == "serverInfo"
        server.send(ONE)
        (channel,) = viewer.text()["channels"]
        assert (channel["topic"], channel["encoding"], channel["schemaName"]) == ("/ranges/10_20", "json", "uwb.Range")
        schema = json.loads(channel["schema"])
        viewer.send({"op": "subscribe", "subscriptions": [{"id": 7, "channelId": channel["id"]}]})
        for _ in range(200):
            server.send(ONE)
            time.sleep(0.01)
        subscription, time_ns, content = viewer.message()
        viewer.close()
    assert (subscription, time_ns) == (7, ONE.time_ns)
    assert content["timestamp"] == {"sec": 1_706_822_508, "nsec": 42_560_815}
    assert (content["corrected_m"], content["sigma_m"], content["clamped"]) == (3.0, 0.03, False)
    assert "fpp2_dbm" not in content, "JSON has no word for what was not measured"
    kinds: dict[str, type | tuple[type, ...]] = {
        "integer": int,
        "number": (int, float),
        "boolean": bool,
        "object": dict,
    }
    for name, value in content.items():
        assert isinstance(value, kinds[schema["properties"][name]["type"]]), name


def test_a_port_that_is_taken_and_a_missing_extra_are_said(monkeypatch):
    with FoxgloveServer("0") as server, pytest.raises(PortError, match="cannot be served there"):
        FoxgloveServer(server.url.removeprefix("ws://"))
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(PortError, match=r"pip install 'uwbcal\[foxglove\]'"):
        FoxgloveServer("0")


def test_how_long_a_range_takes_from_the_port_to_somebody_else(ear):
    """From the poll, by the host's clock, to the datagram at another process's socket."""
    with served() as server:
        address = f"127.0.0.1:{ear.getsockname()[1]}"
        words = [BIN / "uwblink", "stream", *server.names.values(), "--rate", "100", "--duration", "3", "--quiet"]
        process = subprocess.Popen([*map(str, words), "--udp", address], stderr=subprocess.PIPE, text=True)
        late_ms: list[float] = []
        series: set[str] = set()
        while len(late_ms) < 100:
            row = json.loads(ear.recv(65536))
            late_ms.append((time.time() - row["timestamp"]) * 1e3)
            series |= set(row["ranges"])
        _, said = process.communicate(timeout=60)
    assert series == {"1_2", "1_3", "2_3"}
    assert "ranges" in said
    # docs/streaming.md has the figure of an idle machine; what is held here is that nothing waits for anything.
    assert np.median(late_ms) < 20


def test_the_front_door_and_the_room_offer_the_same():
    assert uwblink.stream is __import__("uwblink.streaming", fromlist=["stream"]).stream
