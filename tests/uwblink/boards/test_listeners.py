"""Listeners of a recorder, in virtual time: they hear what the file gets."""

import pytest

import uwblink
from tests.boards import bench_scenario
from uwblink.boards.record import identify
from uwblink.boards.recorder import Recorder
from uwblink.recording.file import Recording
from uwblink.wire.messages import RangeReport
from uwbsim.boards.virtual_board import VirtualPorts


def recorded(path, ports, *listeners, seconds=4.0, **more):
    plan = uwblink.RangingPlan(rate_hz=50.0)
    names = list(ports.names.values())
    return uwblink.record(names, path, plan, duration_s=seconds, listeners=listeners, using=ports, **more)


def test_a_function_hears_every_message_that_the_file_gets(tmp_path):
    heard: list[uwblink.Heard] = []
    done = recorded(tmp_path / "f.uwb", VirtualPorts(bench_scenario()), heard.append)
    reports = [h for h in heard if isinstance(h.message, RangeReport)]
    # In virtual time at 50 Hz none is missing.
    assert len(reports) == done.exchanges == done.tried == pytest.approx(200, abs=1)
    with Recording.open(tmp_path / "f.uwb") as recording:
        exchanges = recording.exchanges()
    assert [h.message.tx1 for h in reports] == exchanges.tx1.tolist()
    assert [h.board for h in reports] == exchanges.initiator.tolist()


class Everything(uwblink.Listener):
    def __init__(self):
        self.bytes, self.turns, self.faults = {"in": b"", "out": b""}, [], []

    def on_bytes(self, time_ns, port, direction, data):
        self.bytes[direction] += data

    def on_turn(self, turn):
        self.turns.append(turn)

    def on_fault(self, fault):
        self.faults.append(fault)


def test_a_listener_is_told_bytes_turns_and_faults(tmp_path):
    ports, listener = VirtualPorts(bench_scenario(), lost_share=0.4), Everything()
    done = recorded(tmp_path / "f.uwb", ports, listener)
    assert len(listener.turns) == done.tried
    assert sum(t.report is not None for t in listener.turns) == done.exchanges < done.tried
    with Recording.open(tmp_path / "f.uwb") as recording:
        assert [f.detail for f in listener.faults] == [f.detail for f in recording.faults()]
        for way in ("in", "out"):
            assert listener.bytes[way] == b"".join(f.data for f in recording.frames() if f.direction == way)


def test_a_listener_that_raises_ends_the_recording_with_everything_before_in_the_file(tmp_path):
    count = 0

    def fail(heard):
        nonlocal count
        count += isinstance(heard.message, RangeReport)
        if count == 20:
            raise ZeroDivisionError("a mistake of the user's")

    with pytest.raises(ZeroDivisionError):
        recorded(tmp_path / "f.uwb", VirtualPorts(bench_scenario()), fail)
    with Recording.open(tmp_path / "f.uwb") as recording:
        assert len(recording.exchanges()) == 20


def test_a_recorder_needs_no_file(tmp_path):
    ports = VirtualPorts(bench_scenario())
    heard: list[uwblink.Heard] = []
    found = identify(ports.names.values(), ports)
    recorder = Recorder(found, uwblink.RangingPlan(), [(1, 2)], [as_listener(heard)], ports=ports)
    recorder.run(1.0)
    recorder.close()
    assert recorder.progress.exchanges == sum(isinstance(h.message, RangeReport) for h in heard) > 100


def as_listener(heard):
    from uwblink.boards.listeners import CallbackListener

    return CallbackListener(heard.append)


def test_what_is_no_listener_is_refused(tmp_path):
    with pytest.raises(TypeError, match="listeners: found 3, expected a Listener or a function"):
        recorded(tmp_path / "f.uwb", VirtualPorts(bench_scenario()), 3)
    assert list(tmp_path.iterdir()) == []


def test_durations_that_are_none_are_refused(tmp_path):
    for wrong in (0.0, -1.0, float("nan")):
        with pytest.raises(uwblink.UwblinkError, match="duration_s"):
            recorded(tmp_path / "f.uwb", VirtualPorts(bench_scenario()), seconds=wrong)


def damaged(ports, hit):
    """Damage what comes from board 1 in the way that `hit` says."""
    arrived = ports.bench.send

    def send(time_ns, tag, data):
        arrived(time_ns, tag, hit(data) if tag == 1 else data)

    ports.bench.send = send


def test_one_damaged_line_is_one_fault(tmp_path):
    """An impulse response of 6000 bytes in 22 pieces, of which one byte in the middle is damaged."""
    ports, seen = VirtualPorts(bench_scenario()), []

    def hit(data):
        # The fifth piece of each response; bars inside it are places where nothing starts.
        seen.append(data)
        in_response = data.startswith(b"|")
        number = sum(1 for d in reversed(seen) if d.startswith((b"|", b"S10"))) if in_response else 0
        return data[:10] + b"x" + data[11:] if in_response and number % 21 == 5 else data

    damaged(ports, hit)
    plan = uwblink.RangingPlan(pairs=((1, 2),), rate_hz=5.0, get_cir=True)
    done = uwblink.record(ports.names.values(), tmp_path / "f.uwb", plan, duration_s=4.0, using=ports)
    assert done.exchanges == done.tried == 20
    assert done.faults == {"garbage": 20}
