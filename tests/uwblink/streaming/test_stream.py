"""Streams: what comes out of boards and recordings, in virtual time and in this one."""

import doctest
import json
import math
import subprocess
import sys
import time
from pathlib import Path

import pytest

import calib
import uwblink
from tests import processes
from tests.boards import bench_scenario, served
from uwblink.boards import Progress
from uwblink.errors import ArgumentError, PlanError, PortError
from uwblink.streaming import RangeListener
from uwbsim.boards.virtual_port import VirtualPorts

BIN = Path(sys.executable).parent


def flight(path, **more):
    ports = VirtualPorts(bench_scenario())
    plan = uwblink.RangingPlan(rate_hz=50.0)
    uwblink.record(ports.names.values(), path, plan, duration_s=4.0, using=ports, **more)
    return uwblink.load(path).exchanges


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    """A calibration of boards 1, 2 and 3, with tag 3 left out of its delays."""
    path = tmp_path_factory.mktemp("stream") / "c.json"
    known = calib.fit(calib.sample_flight()).calibration
    document = json.loads(known.to_json())
    document.pop("uncertainty", None)
    for name in ("delays_ns", "delays_std_ns"):
        document[name] = {"1": 0.5, "2": -0.25}
    path.write_text(json.dumps(document))
    return path


def test_boards_are_streamed_as_they_would_be_recorded(tmp_path):
    expected = flight(tmp_path / "f.uwb")
    ports, seen = VirtualPorts(bench_scenario()), Progress()
    plan = uwblink.RangingPlan(rate_hz=50.0)
    names = list(ports.names.values())
    found = list(uwblink.stream(names, plan=plan, duration_s=4.0, using=ports, listeners=[seen]))
    assert len(found) == len(expected) == seen.exchanges == pytest.approx(200, abs=2)
    for name in ("time_ns", "initiator", "target", "range_m", "fpp1_dbm", "skew2_ppm"):
        assert [getattr(one, name) for one in found] == getattr(expected, name).tolist()
    assert all(math.isnan(one.corrected_m) and math.isnan(one.sigma_m) for one in found)
    assert "corrected_m" not in found[0].to_dict()


def test_ranges_come_one_at_a_time_and_closing_closes_the_ports():
    ports = VirtualPorts(bench_scenario())
    ranges = uwblink.stream(list(ports.names.values()), using=ports)
    first = next(ranges)
    assert ports.now_s() < 1.0, "the first range comes before the second is made"
    ranges.close()
    again = next(uwblink.stream(list(ports.names.values()), using=ports))
    assert again.time_ns > first.time_ns


def test_a_recording_is_corrected_row_by_row_as_apply_does(tmp_path, calibration):
    expected = flight(tmp_path / "f.uwb")
    known = calib.load_calibration(calibration)
    found = list(uwblink.stream(tmp_path / "f.uwb", calibration=calibration, speed=math.inf))
    assert [one.range_m for one in found] == expected.range_m.tolist()
    for one, e in zip(found, range(len(expected)), strict=True):
        if 3 in (one.initiator, one.target):
            assert math.isnan(one.corrected_m)
            assert one.more == {}
            continue
        ranges = calib.Ranges.from_exchanges(expected[e : e + 1])
        applied = known.apply(ranges)
        # The board printed its range with four decimals; delays of 0.25 ns times a skew of ppm are far below.
        assert one.corrected_m == pytest.approx(float(applied.corrected_m[0]), abs=2e-4)
        assert one.sigma_m == pytest.approx(float(applied.sigma_m[0]), rel=1e-9)
        assert one.more["clamped"] == bool(applied.clamped[0])


def test_a_recording_plays_in_its_own_time(tmp_path):
    flight(tmp_path / "f.uwb")
    began = time.monotonic()
    played = [(one.time_ns, time.monotonic() - began) for one in uwblink.stream(tmp_path / "f.uwb", speed=4.0)]
    # Never early; late by what a loaded machine makes it.
    assert all(at >= (when - played[0][0]) * 1e-9 / 4 - 1e-3 for when, at in played)
    assert played[-1][1] == pytest.approx(1.0, abs=0.5)
    assert len(list(uwblink.stream(tmp_path / "f.uwb", speed=math.inf, duration_s=1.0))) == pytest.approx(50, abs=2)


@pytest.mark.parametrize(
    ("more", "named"),
    [
        ({"speed": 0.0}, "`speed`"),
        ({"speed": math.nan}, "`speed`"),
        ({"duration_s": "long"}, "`duration_s`"),
        ({"calibration": "no.json"}, "no.json"),
    ],
)
def test_what_cannot_be_is_said_before_the_first_range(tmp_path, more, named):
    flight(tmp_path / "f.uwb")
    with pytest.raises((ArgumentError, PlanError), match=named):
        uwblink.stream(tmp_path / "f.uwb", **more)


def test_ports_that_are_not_there_and_ranges_that_are_corrected_already(tmp_path, calibration):
    with pytest.raises(PortError, match="no such port"):
        uwblink.stream(["/dev/nothing", "/dev/nobody"])
    flight(tmp_path / "f.uwb")
    with uwblink.Recording.open(tmp_path / "f.uwb", update=True) as opened:
        opened.append_meta({"calibration": {}})
    with pytest.raises(ArgumentError, match="corrected already"):
        uwblink.stream(tmp_path / "f.uwb", calibration=calibration)


def run(*words, **more):
    return processes.run("uwblink", *words, timeout=120, **more)


def test_the_command_prints_a_line_a_range(tmp_path, calibration):
    expected = flight(tmp_path / "f.uwb")
    done = run("stream", tmp_path / "f.uwb", "-c", calibration, "--speed", "inf")
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [row["range_m"] for row in rows] == expected.range_m.tolist()
    assert {"corrected_m", "sigma_m", "clamped"} <= set(rows[0])
    assert done.stderr == f"{len(rows)} ranges\n"


def test_a_reader_that_goes_away_ends_the_stream(tmp_path):
    flight(tmp_path / "f.uwb")
    words = f"{BIN / 'uwblink'} stream {tmp_path / 'f.uwb'} --speed 20 | head -n 2"
    done = subprocess.run(["bash", "-c", words], capture_output=True, text=True, timeout=120)
    assert done.stdout.count("\n") == 2
    assert "Traceback" not in done.stderr


def test_mistakes_are_one_line(tmp_path):
    flight(tmp_path / "f.uwb")
    for words, named in (
        (["--udp", "here"], "--udp"),
        (["--udp", "127.0.0.1:0"], "--udp"),
        (["--udp", "no.such.host.invalid:9870"], "no such host"),
        (["--foxglove", "x:y"], "--foxglove"),
        (["--rate", "5"], "for boards"),
        (["-o", tmp_path / "g.uwb"], "for boards"),
    ):
        done = run("stream", tmp_path / "f.uwb", *words)
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr.startswith("error: ")
        assert done.stderr.count("\n") == 1
        assert named in done.stderr


def test_boards_are_streamed_and_recorded_by_the_command_until_the_time_is_over(tmp_path):
    with served() as server:
        out = tmp_path / "f.uwb"
        done = run("stream", *server.names.values(), "--rate", "50", "--duration", "1", "-o", out)
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(rows) > 10
    assert {(row["initiator"], row["target"]) for row in rows} == {(1, 2), (1, 3), (2, 3)}
    assert f"{len(rows)} ranges" in done.stderr
    loaded = uwblink.load(out)
    recorded = dict(zip(loaded.exchanges.time_ns.tolist(), loaded.exchanges.range_m.tolist(), strict=True))
    streamed = {row["time_ns"]: row["range_m"] for row in rows}
    # On a machine that is held up, a report that comes after its turn has timed out is in the file alone, with a fault.
    too_late = recorded.keys() - streamed.keys()
    assert len(too_late) <= sum(fault.kind == "time-out" for fault in loaded.faults)
    assert streamed == {time_ns: range_m for time_ns, range_m in recorded.items() if time_ns not in too_late}


def test_ranges_are_called_back_while_boards_are_recorded(tmp_path):
    found: list[uwblink.StreamedRange] = []
    expected = flight(tmp_path / "f.uwb", listeners=[RangeListener(found.append, lambda *_: {"corrected_m": 7.0})])
    assert [one.time_ns for one in found] == expected.time_ns.tolist()
    assert {one.corrected_m for one in found} == {7.0}
    with pytest.raises(PlanError, match=r"none\.json"):
        RangeListener(print, tmp_path / "none.json")


def test_the_example_of_the_listener_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runner = doctest.DocTestRunner(verbose=False)
    for example in doctest.DocTestFinder().find(RangeListener, "RangeListener", globs={}):
        runner.run(example)
    assert runner.failures == 0
    assert (tmp_path / "f.uwb").exists()
