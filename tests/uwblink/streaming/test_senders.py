"""Received data: datagrams at a plain socket, messages at the WebSocket of a viewer."""

import contextlib
import http.client
import json
import math
import select
import socket
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import uwblink
from tests.boards import bench_scenario, served
from tests.processes import BIN
from uwblink.streaming import FoxgloveServer, StreamedRange, UdpSender
from uwbsim.boards.virtual_board import VirtualPorts

LISTENING = Path("/proc/net/tcp")


class FoxgloveClient:
    """A viewer that implements WebSocket (RFC 6455) and the protocol of Foxglove literally."""

    def __init__(self, url, name=None, origin=None):
        """Connect as a page of an `origin` that uses a `name` for the server."""
        host, port = url.removeprefix("ws://").rsplit(":", 1)
        self.connection = http.client.HTTPConnection(host.strip("[]"), int(port), timeout=20)
        headers = {
            "Host": name or host,
            "Upgrade": "websocket",
            "Connection": "Upgrade",
            "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
            "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Protocol": "foxglove.sdk.v1",
        } | ({"Origin": origin} if origin else {})
        self.connection.request("GET", "/", headers=headers)
        self.answer = self.connection.getresponse()
        self.stream = self.answer.fp

    def receive(self):
        """Return opcode and payload of the next frame; servers do not mask."""
        first, length = self.stream.read(2)
        if length >= 126:
            size = 2 if length == 126 else 8
            length = int.from_bytes(self.stream.read(size))
        return first & 0x0F, self.stream.read(length)

    def text(self):
        opcode, payload = self.receive()
        assert opcode == 1
        return json.loads(payload)

    def message(self):
        """Return subscription, time and content of the next message data."""
        opcode, payload = self.receive()
        kind, subscription, time_ns = struct.unpack_from("<BIQ", payload)
        assert (opcode, kind) == (2, 1)
        return subscription, time_ns, json.loads(payload[13:])

    def send(self, document):
        data = json.dumps(document).encode()
        self.connection.sock.sendall(bytes([0x81, 0x80 | len(data)]) + b"\0\0\0\0" + data)

    def close(self):
        self.answer.close()
        self.connection.close()


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


def test_datagrams_have_the_format_of_plotters(ear):
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


def test_sending_without_receivers_is_no_error(ear):
    port = ear.getsockname()[1]
    ear.close()
    with UdpSender(f"localhost:{port}") as sender:
        for _ in range(3):
            sender.send(ONE)


def test_viewers_get_a_topic_per_pair_with_schema():
    with FoxgloveServer("0") as server:
        viewer = FoxgloveClient(server.url)
        assert (viewer.answer.status, viewer.text()["op"]) == (101, "serverInfo")
        server.send(ONE)
        (channel,) = viewer.text()["channels"]
        assert (channel["topic"], channel["encoding"], channel["schemaName"]) == ("/ranges/10_20", "json", "uwb.Range")
        schema = json.loads(channel["schema"])
        viewer.send({"op": "subscribe", "subscriptions": [{"id": 7, "channelId": channel["id"]}]})
        # Until the server has read the subscription.
        while not select.select([viewer.connection.sock], [], [], 0.01)[0]:
            server.send(ONE)
        subscription, time_ns, content = viewer.message()
        viewer.close()
    assert (subscription, time_ns) == (7, ONE.time_ns)
    assert content["timestamp"] == {"sec": 1_706_822_508, "nsec": 42_560_815}
    assert (content["corrected_m"], content["sigma_m"], content["clamped"]) == (3.0, 0.03, False)
    assert "fpp2_dbm" not in content, "JSON has no word for what was not measured"
    kinds: dict[str, Any] = {"integer": int, "number": (int, float), "boolean": bool, "object": dict}
    for name, value in content.items():
        assert isinstance(value, kinds[schema["properties"][name]["type"]]), name


@pytest.mark.parametrize(
    ("name", "origin", "status"),
    [
        (None, None, 101),
        (None, "https://app.foxglove.dev", 101),
        ("localhost:8765", "http://localhost:8080", 101),
        (None, "file://", 101),
        ("robot.local:8765", "http://robot.local", 101),
        (None, "https://evil.example", 403),
        (None, "http://evil.example:8765", 403),
        (None, "null", 403),
        (None, "https://foxglove.dev.evil.example", 403),
        (None, "https://notfoxglove.dev", 403),
        (None, "http://app.foxglove.dev", 403),
        (None, "http://localhost.evil.example", 403),
        (None, "http://[", 403),
        ("evil.example:8765", "http://evil.example:8765", 403),
        ("evil.example", None, 403),
        ("localhost.evil.example", None, 403),
        ("127.0.0.1.evil.example", None, 403),
        ("[", None, 403),
    ],
)
def test_other_web_sites_get_no_ranges(gated, name, origin, status):
    viewer = FoxgloveClient(gated.url, name, origin)
    assert viewer.answer.status == status
    if status == 101:
        assert viewer.text()["op"] == "serverInfo"
    else:
        assert viewer.stream.read() == b"", "the server hung up"
    viewer.close()


@pytest.fixture(scope="module")
def gated():
    with FoxgloveServer("0") as server:
        yield server


def test_wrong_requests_have_no_effect(gated, capfd):
    port = int(gated.url.rsplit(":", 1)[1])
    for request in (b"", b"\r\n", b"\xff" * 70_000, b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 200 + b"\r\n"):
        with socket.create_connection(("127.0.0.1", port), timeout=20) as client, contextlib.suppress(OSError):
            client.sendall(request)
            client.shutdown(socket.SHUT_WR)
            assert client.recv(100) in (
                b"",
                b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\nConnection: close\r\n\r\n",
            )
    viewer = FoxgloveClient(gated.url)
    assert viewer.answer.status == 101
    viewer.close()
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("address", ["{}", ":{}"])
def test_a_port_without_a_host_is_of_this_computer_alone(address):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with FoxgloveServer(address.format(port)) as server:
        assert server.url == f"ws://127.0.0.1:{port}"
        if LISTENING.exists():
            addresses = [line.split()[1].split(":") for line in LISTENING.read_text().splitlines()[1:]]
            mine = [place for place, number in addresses if int(number, 16) == port]
            assert mine == ["0100007F"], "at 127.0.0.1, and nowhere else"
        # Another address of this computer, at which a server for all addresses would answer.
        with socket.socket() as other:
            other.settimeout(5)
            assert other.connect_ex(("127.0.0.2", port))


def test_used_ports_and_missing_extras_are_named(monkeypatch):
    with FoxgloveServer("0") as server, pytest.raises(uwblink.errors.PortError, match="cannot be served there"):
        FoxgloveServer(server.url.removeprefix("ws://"))
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(uwblink.errors.PortError, match=r"pip install 'uwbcal\[foxglove\]'"):
        FoxgloveServer("0")


@pytest.mark.slow
def test_ranges_arrive_within_20_ms_of_their_poll(ear):
    """By the time of the boards, so that other load has no effect; docs/boards.md has the figures."""
    ports, late_ms = VirtualPorts(bench_scenario()), []
    with UdpSender(str(ear.getsockname()[1])) as sender:
        for found in uwblink.stream(list(ports.names.values()), duration_s=1.0, using=ports):
            assert isinstance(found, uwblink.StreamedRange)
            sender.send(found)
            assert json.loads(ear.recv(65536))["timestamp"] == pytest.approx(found.time_ns * 1e-9, abs=1e-6)
            late_ms.append((ports.host_ns() - found.time_ns) * 1e-6)
    assert len(late_ms) > 50
    assert 0 < min(late_ms) < max(late_ms) < 20


def test_the_command_sends_datagrams_and_prints_no_ranges(ear):
    with served() as server:
        words = [BIN / "uwblink", "stream", *server.names.values(), "--quiet", "--rate", "50", "--duration", "1"]
        words += ["--udp", f"127.0.0.1:{ear.getsockname()[1]}"]
        done = subprocess.run([*map(str, words)], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "")
    count, _ = done.stderr.split(maxsplit=1)
    series: set[str] = set()
    for _ in range(int(count)):
        series |= set(json.loads(ear.recv(65536))["ranges"])
    assert series == {"1_2", "1_3", "2_3"}
