"""Streams from boards and recordings, in virtual time and in real time."""

import contextlib
import doctest
import http.client
import json
import math
import select
import shutil
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pytest

import calib
import uwblink
from tests import processes
from tests.boards import bench_scenario, record_bench, served
from uwblink.boards import Progress
from uwblink.streaming import FoxgloveServer, RangeListener, StreamedRange, UdpSender
from uwblink.twr import STAMPS
from uwbsim import VirtualPorts


def flight(path, protocol="ds", **more):
    record_bench(path, uwblink.RangingPlan(rate_hz=50.0, protocol=protocol), duration_s=2.0, **more)
    return uwblink.load(path).exchanges


def from_boards(ports=None, rate_hz=50.0, pairs="all", **more):
    """Stream the boards of the bench in virtual time."""
    ports = ports or VirtualPorts(bench_scenario())
    return uwblink.stream(ports.names.values(), plan=uwblink.RangingPlan(pairs, rate_hz=rate_hz), using=ports, **more)


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A recording of the boards, which no test changes."""
    path = tmp_path_factory.mktemp("flown") / "f.uwb"
    flight(path)
    return path


def calibrated(path, tags):
    """Write a calibration with a curve, for some of the boards."""
    document = json.loads(calib.fit(calib.sample_flight()).calibration.to_json())
    document.pop("uncertainty", None)
    document["delays_ns"] = {str(tag): 0.5 - 0.25 * tag for tag in tags}
    document["delays_std_ns"] = {str(tag): 0.01 for tag in tags}
    path.write_text(json.dumps(document))
    return path


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    return calibrated(tmp_path_factory.mktemp("stream") / "c.json", (1, 2, 3))


@pytest.fixture(scope="module")
def of_two(tmp_path_factory):
    """A calibration without board 3."""
    return calibrated(tmp_path_factory.mktemp("stream") / "two.json", (1, 2))


def test_boards_are_streamed_as_they_would_be_recorded(flown):
    expected, seen = uwblink.load(flown).exchanges, Progress()
    found = list(from_boards(duration_s=2.0, listeners=[seen]))
    assert len(found) == len(expected) == seen.exchanges == pytest.approx(100, abs=2)
    for name in ("time_ns", "initiator", "target", "range_m", "fpp1_dbm", "skew2_ppm"):
        assert [getattr(one, name) for one in found] == getattr(expected, name).tolist()
    assert all(math.isnan(one.corrected_m) and math.isnan(one.sigma_m) for one in found)
    assert "corrected_m" not in found[0].to_dict()


def test_ranges_come_one_at_a_time_and_closing_closes_the_ports():
    ports = VirtualPorts(bench_scenario())
    ranges = from_boards(ports)
    first = next(ranges)
    assert ports.now_s() < 1.0, "the first range comes before the second is made"
    ranges.close()
    assert next(from_boards(ports)).time_ns > first.time_ns


@pytest.mark.parametrize("protocol", [pytest.param("ss", marks=pytest.mark.slow), "ds"])
def test_ranges_are_corrected_live_and_played_as_apply_corrects_them(tmp_path, calibration, protocol):
    """Stamps have more digits than the range that a board prints, which in SS-TWR is a whole number of ticks."""
    live: list[uwblink.StreamedRange] = []
    printed = flight(tmp_path / "f.uwb", protocol, listeners=[RangeListener(live.append, calibration)]).range_m
    calib.apply(tmp_path / "f.uwb", calib.load_calibration(calibration), tmp_path / "corrected.uwb")
    expected = uwblink.load(tmp_path / "corrected.uwb").exchanges.range_m.tolist()
    played = list(uwblink.stream(tmp_path / "f.uwb", calibration=calibration, speed=math.inf))
    assert [one.corrected_m for one in live] == [one.corrected_m for one in played] == expected
    assert [one.range_m for one in played] == printed.tolist()
    names = ("sigma_m", "clamped", "sigma_total_m", "tail_share")
    with duckdb.connect(tmp_path / "corrected.uwb", read_only=True) as opened:
        rows = opened.execute(f"SELECT {', '.join(names)} FROM corrected ORDER BY time_ns").fetchall()
    for found in (live, played):
        assert [(one.sigma_m, *(one.more[name] for name in names[1:])) for one in found] == rows


def test_a_recording_of_another_protocol_and_stamp_size_is_corrected_as_apply_does(tmp_path, calibration):
    big = 2**35
    exchanges = uwblink.Exchanges.from_arrays(
        [1, 1], [2, 3], tx1=[big, 5], rx1=[7, big], tx2=[100_007, big + 100_000], rx2=[big + 100_900, 101_005],
        skew2_ppm=[12.5, -4.0], fpp1_dbm=-85.0, fpp2_dbm=-86.0, protocol="ss-cfo", bits=40, time_ns=[0, 10**9],
        range_m=[1.0, 2.0],
    )  # fmt: skip
    uwblink.Contents(exchanges=exchanges).save(tmp_path / "f.uwb")
    expected = calib.load_calibration(calibration).apply(calib.Ranges.from_exchanges(exchanges)).corrected_m
    played = uwblink.stream(tmp_path / "f.uwb", calibration=calibration, speed=math.inf)
    assert [one.corrected_m for one in played] == expected.tolist()


def test_uncalibrated_tags_are_named_before_the_first_range(tmp_path, flown, of_two):
    with pytest.raises(ValueError, match=r"two\.json: no delay of tag 3"):
        uwblink.stream(flown, calibration=of_two)
    with pytest.raises(uwblink.errors.PlanError, match="no delay of tag 3"):
        record_bench(tmp_path / "g.uwb", listeners=[RangeListener(print, of_two)])
    assert not list(tmp_path.iterdir()), "nothing was written"
    found = list(from_boards(pairs=((1, 2),), calibration=of_two, duration_s=1.0))
    assert found
    assert all(math.isfinite(one.corrected_m) for one in found)


def test_errors_of_corrections_end_streams_and_keep_earlier_ranges(tmp_path):
    def correct(exchanges):
        if exchanges.tx1.any() and next(seen) == 20:
            raise ValueError("the calibration is broken")
        return {"corrected_m": exchanges.range_m}

    seen = iter(range(100))
    with pytest.raises(ValueError, match="the calibration is broken"):
        flight(tmp_path / "f.uwb", listeners=[RangeListener(lambda _: None, correct)])
    assert len(uwblink.load(tmp_path / "f.uwb").exchanges) == 21


@pytest.fixture
def clock(monkeypatch):
    """A clock that advances only during sleeps; yields the durations of the sleeps."""
    slept: list[float] = []
    monkeypatch.setattr(time, "monotonic", lambda: 1000.0 + math.fsum(slept))
    monkeypatch.setattr(time, "sleep", slept.append)
    return slept


def test_a_recording_plays_in_its_own_time(flown, clock):
    clock.clear()
    played = [(one.time_ns, math.fsum(clock)) for one in uwblink.stream(flown, speed=4.0)]
    assert [at for _, at in played] == pytest.approx([(when - played[0][0]) * 1e-9 / 4 for when, _ in played], abs=1e-9)
    assert played[-1][1] == pytest.approx(0.5, abs=0.02)
    assert max(clock) <= 0.1, "Ctrl-C is looked for ten times a second"
    assert len(list(uwblink.stream(flown, speed=math.inf, duration_s=1.0))) == pytest.approx(50, abs=2)


@pytest.mark.parametrize(
    ("more", "named"),
    [
        ({"speed": 0.0}, "`speed`"),
        ({"speed": math.nan}, "`speed`"),
        ({"duration_s": "long"}, "`duration_s`"),
        ({"calibration": "no.json"}, "no.json"),
        ({"calibration": "empty.json"}, "empty.json"),
    ],
)
def test_wrong_arguments_are_refused_before_the_first_range(tmp_path, monkeypatch, flown, more, named):
    (tmp_path / "empty.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    with pytest.raises((uwblink.errors.ArgumentError, uwblink.errors.PlanError), match=named):
        uwblink.stream(flown, **more)


def test_ports_that_are_not_there_and_ranges_that_are_corrected_already(tmp_path, flown, calibration):
    with pytest.raises(uwblink.errors.PortError, match="no such port"):
        uwblink.stream(["/dev/nothing", "/dev/nobody"])
    shutil.copy(flown, tmp_path / "f.uwb")
    with uwblink.Recording.open(tmp_path / "f.uwb", update=True) as opened:
        opened.append_meta({"calibration": {}})
    with pytest.raises(uwblink.errors.ArgumentError, match="already corrected"):
        uwblink.stream(tmp_path / "f.uwb", calibration=calibration)


def test_the_commands_refuse_a_calibration_of_other_boards_and_write_nothing(tmp_path, flown, of_two):
    with served() as server:
        names, out = list(server.names.values()), tmp_path / "g.uwb"
        for words in (
            ("stream", flown, "-c", of_two),
            ("stream", *names, "-c", of_two, "-o", out),
            ("record", *names, "--pairs", "all", "--live", "--calibration", of_two, "-o", out),
        ):
            done = processes.run("uwblink", *words)
            assert (done.returncode, done.stdout, "Traceback" in done.stderr) == (2, "", False)
            assert "tag 3" in done.stderr.splitlines()[-1]
    assert not out.exists()


@pytest.mark.slow
def test_a_stream_ends_if_its_reader_closes_the_pipe(flown):
    words = f"{processes.BIN / 'uwblink'} stream {flown} --speed 20 | head -n 2"
    done = subprocess.run(["bash", "-c", words], capture_output=True, text=True, timeout=120)
    assert (done.stdout.count("\n"), "Traceback" in done.stderr) == (2, False)


def test_boards_are_streamed_and_recorded_by_the_command_until_the_time_is_over(tmp_path):
    with served() as server:
        words = ("--rate", "50", "--duration", "1", "-o", tmp_path / "f.uwb")
        done = processes.succeed("uwblink", "stream", *server.names.values(), *words)
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    # The number per second is tested in virtual time; here it depends on the machine.
    assert len(rows) >= 3
    assert {(row["initiator"], row["target"]) for row in rows} == {(1, 2), (1, 3), (2, 3)}
    assert f"{len(rows)} ranges" in done.stderr
    loaded = uwblink.load(tmp_path / "f.uwb")
    recorded = dict(zip(loaded.exchanges.time_ns.tolist(), loaded.exchanges.range_m.tolist(), strict=True))
    streamed = {row["time_ns"]: row["range_m"] for row in rows}
    # Under load, a report that comes after its turn has timed out is only in the file, with a fault.
    too_late = recorded.keys() - streamed.keys()
    assert len(too_late) <= sum(fault.kind == "time-out" for fault in loaded.faults)
    assert streamed == {time_ns: range_m for time_ns, range_m in recorded.items() if time_ns not in too_late}


def test_the_example_of_the_listener_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runner = doctest.DocTestRunner(verbose=False)
    for example in doctest.DocTestFinder().find(RangeListener, "RangeListener", globs={}):
        runner.run(example)
    assert runner.failures == 0
    assert (tmp_path / "f.uwb").exists()


@pytest.fixture(scope="module")
def overheard(tmp_path_factory):
    """A recording in which every third board listens."""
    path = tmp_path_factory.mktemp("overheard") / "f.uwb"
    flight(path, passive=True)
    return path


def difference_of(contents, row, delays_ns):
    """Return the difference of a listener, corrected for delays only: the formula in `calib.data.arrivals`."""
    x, h = contents.exchanges, {name: column[row].item() for name, column in contents.overheard.items()}
    (at,) = np.flatnonzero((x.rx1 == h["rx1_n"]) & (x.tx2 == h["tx2_n"]) & (x.initiator == h["initiator"]))
    e = {name: int(getattr(x, name)[at]) for name in ("initiator", "target", "time_ns", *STAMPS)}

    def since(late, early):
        return (late - early) % 2**x.bits

    reply, final = since(e["tx2"], e["rx1"]), since(e["tx3"], e["tx2"])
    ratio = since(e["rx3"], e["rx2"]) / final
    metres, c = 299702547.0 / (499.2e6 * 128), 0.299702547
    range_m = metres * (since(e["rx2"], e["tx1"]) - ratio * reply) / 2
    raw = metres * (since(h["rx2"], h["rx1"]) * final / since(h["rx3"], h["rx2"]) - reply) - range_m
    of_range = c * (delays_ns[e["initiator"]] + ratio * delays_ns[e["target"]]) / 2
    return (e["time_ns"], e["initiator"], e["target"], h["listener"]), raw, raw + c * delays_ns[e["target"]] - of_range


def test_overheard_differences_are_streamed_with_ranges(overheard, tmp_path):
    delays_ns = {1: 0.25, 2: 0.0, 3: -0.25}
    path = tmp_path / "flat.json"
    zero, flat = ({"knots": [0.0] * 4 + [9.0] * 4, "coefficients": [v] * 4, "degree": 3} for v in (0.0, 0.05))
    zero, flat = (curve | {"range": [0.0, 9.0]} for curve in (zero, flat))
    known = json.loads(calibrated(path, (1, 2, 3)).read_text()) | {"bias_curve": zero, "sigma_curve": flat}
    path.write_text(json.dumps(known))
    contents = uwblink.load(overheard)
    found = list(uwblink.stream(overheard, calibration=path, use="receptions", speed=math.inf))
    ranges = [one for one in found if isinstance(one, uwblink.StreamedRange)]
    others = {(one.time_ns, one.initiator, one.target, one.listener): one for one in found if one not in ranges}
    assert len(ranges) == len(contents.exchanges)
    assert len(others) == len(contents.overheard["time_ns"]) > 90
    for row in range(0, len(others), 9):
        whose, raw, corrected = difference_of(contents, row, delays_ns)
        assert (others[whose].difference_m, others[whose].corrected_m) == pytest.approx((raw, corrected), abs=1e-6)
        # Five times the variance of a range if the clock rate has no error, more with a rate from stamps.
        assert others[whose].shared_m == pytest.approx(0.05, rel=1e-6)
        assert others[whose].sigma_m == pytest.approx(5**0.5 * 0.05, rel=0.02)
    assert [one.time_ns for one in found] == sorted(one.time_ns for one in found)
    # Streamed boards give the same as their recording.
    live = list(from_boards(calibration=path, use="receptions", duration_s=2.0))
    assert sorted(map(str, live)) == sorted(map(str, found))


def test_the_command_prints_a_line_a_range_and_differences_in_lines_of_their_own(overheard, calibration):
    held = uwblink.load(overheard)
    words = ("-c", calibration, "--speed", "inf", "--use", "receptions")
    done = processes.succeed("uwblink", "stream", overheard, *words)
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    ranges = [row for row in rows if "listener" not in row]
    assert [row["range_m"] for row in ranges] == held.exchanges.range_m.tolist()
    assert {"corrected_m", "sigma_m", "clamped"} <= set(ranges[0])
    names = ["time_ns", "initiator", "target", "listener", "difference_m", "corrected_m", "sigma_m", "shared_m"]
    assert [list(row) for row in rows if "listener" in row] == [names] * len(held.overheard["time_ns"])
    assert done.stderr.startswith(f"{len(ranges)} ranges")


# Received data: datagrams at a plain socket, messages at the WebSocket of a viewer.


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
            length = int.from_bytes(self.stream.read(2 if length == 126 else 8))
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
        words = ("--quiet", "--rate", "50", "--duration", "1", "--udp", f"127.0.0.1:{ear.getsockname()[1]}")
        done = processes.succeed("uwblink", "stream", *server.names.values(), *words, timeout=120)
    assert done.stdout == ""
    count = int(done.stderr.split()[0])
    assert {name for _ in range(count) for name in json.loads(ear.recv(65536))["ranges"]} == {"1_2", "1_3", "2_3"}
