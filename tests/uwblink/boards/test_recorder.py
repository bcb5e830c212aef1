"""The recorder on served boards: all data are in the file, also after faults of boards, disk and process."""

import re
import signal
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.boards import bench_scenario, record_bench, served
from tests.processes import BIN, wait_until
from uwblink import Listener, RangingPlan, Recording, Tag, errors, load, raw_range, record
from uwblink.boards import Progress, decode_again
from uwblink.recording.schema import FrameRow
from uwblink.wire.messages import IdReport, Skipped
from uwbsim import VirtualPorts


def stored(path):
    with Recording.open(path) as recording:
        return recording.exchanges(), recording.faults(), recording.frames(), recording.meta()


def test_an_arrangement_is_marked_from_beginning_to_end(tmp_path):
    record_bench(tmp_path / "a.uwb", duration_s=1.0, arrangement="A", known="plane")
    with Recording.open(tmp_path / "a.uwb") as recording:
        (mark,) = recording.arrangements()
        time_ns = recording.exchanges().time_ns
    assert (mark.name, mark.known) == ("A", "plane")
    assert mark.start_ns <= time_ns.min() < time_ns.max() < mark.end_ns < mark.start_ns + 1.2e9


def places_of(*numbers):
    return RangingPlan(tags=tuple(Tag(number, "drone", (0.1, 0.0, 0.0)) for number in numbers))


@pytest.mark.parametrize(
    ("given", "error", "said"),
    [
        ({"arrangement": "A", "known": "plane", "order": (30, 10, 20)}, errors.PlanError, "order"),
        ({"arrangement": "A", "known": "line", "order": (10, 20)}, errors.PlanError, "each of the boards at the"),
        ({"known": "line"}, errors.PlanError, "known"),
        ({"arrangement": "A", "known": "ring"}, errors.PlanError, "known"),
        (
            {"plan": places_of(20, 10)},
            errors.PlanError,
            "the plan has positions of the tags 10, 20, but the boards at the ports are 1, 2, 3",
        ),
        ({"listeners": [3]}, TypeError, "listeners: found 3, expected a Listener or a function"),
        *(({"duration_s": seconds}, errors.PlanError, "duration_s") for seconds in (0.0, -1.0, float("nan"))),
    ],
)
def test_impossible_arrangements_plans_listeners_and_durations_are_refused(tmp_path, given, error, said):
    with pytest.raises(error, match=said):
        record_bench(tmp_path / "a.uwb", **given)
    assert not list(tmp_path.iterdir())


def test_bytes_of_boards_are_in_the_file_and_decode_to_its_exchanges(tmp_path):
    path, ports = tmp_path / "f.uwb", VirtualPorts(bench_scenario())
    done = record_bench(path, replace(places_of(1), rate_hz=100.0), ports, duration_s=1.5)
    exchanges, faults, frames, meta = stored(path)
    assert 145 <= len(exchanges) == done.exchanges == done.tried <= 151
    assert (faults, meta["ports"]) == ([], {str(k): ports.names[k] for k in ports.names})
    ends = set(zip(exchanges.initiator.tolist(), exchanges.target.tolist(), strict=True))
    assert (ends, sum(frame.direction == "out" for frame in frames)) == ({(1, 2), (1, 3), (2, 3)}, done.tried)
    with Recording.open(path) as recording:
        again = decode_again(recording)
    assert again.skipped_bytes == 0
    for name in ("time_ns", "initiator", "target", "tx1", "rx3", "range_m", "skew2_ppm"):
        order = np.argsort(exchanges.time_ns, kind="stable")
        np.testing.assert_array_equal(getattr(again.exchanges, name), getattr(exchanges, name)[order])
    # Exchanges have the requested rate, and correct times.
    assert np.median(np.diff(np.sort(exchanges.time_ns))) == pytest.approx(1e7, rel=0.1)


def test_overheard_exchanges_impulse_responses_and_target_reports(tmp_path):
    path, ports = tmp_path / "f.uwb", VirtualPorts(bench_scenario())
    plan = RangingPlan(((1, 2),), rate_hz=10.0, target_reports=True, get_cir=True)
    done = record_bench(path, plan, ports, duration_s=2.0, passive=True)
    assert not any(board.passive for board in ports.bench.boards.values()), "listening is switched off again"
    with Recording.open(path) as recording:
        # Each of twenty exchanges is reported by both ends and overheard by the third, each with its impulse response.
        assert 19 <= recording.count("overheard") == done.overheard == done.exchanges == done.tried <= 20
        assert recording.count("cirs") == done.cirs == 3 * done.tried
        reporters = set(recording.exchanges().reporter.tolist())
    assert (reporters, done.faults) == ({1, 2}, {})


class Unplugging(Listener):
    """Disconnects board 3 after 30 turns, and connects it again after 20 good turns of the others."""

    def __init__(self, server):
        self.server, self.turns, self.others, self.back = server, 0, 0, 0

    def on_turn(self, turn):
        self.turns += 1
        if self.turns == 30:
            self.server.unplug(3)
        if self.turns > 30 and turn.pair == (1, 2) and turn.report:
            self.others += 1
            if self.others == 25:
                self.server.plug(3)
        self.back += self.others > 25 and 3 in turn.pair and turn.report is not None


def test_an_unplugged_board_leaves_the_others_running_and_resumes(tmp_path):
    path = tmp_path / "f.uwb"
    with served(link_dir=tmp_path / "ports") as server:
        cable = Unplugging(server)
        how: Any = {"duration_s": 60.0, "passive": True, "listeners": [cable], "stop": lambda: cable.back > 30}
        record(server.names.values(), path, RangingPlan(rate_hz=100.0), **how)
    found = load(path)
    e, heard = found.exchanges, found.overheard
    (out,), (back,) = ([f.time_ns for f in found.faults if f.kind == kind] for kind in ("unplugged", "replugged"))
    others = e.time_ns[(e.initiator == 1) & (e.target == 2)]
    assert np.count_nonzero((others > out) & (others < back)) >= 15
    assert np.any(e.time_ns[(e.initiator == 3) | (e.target == 3)] > back)
    again = heard["time_ns"][heard["listener"] == 3] > back
    assert np.any(again), "passive listening was lost with the power and is restored"


@pytest.mark.slow
def test_hanging_boards_and_damaged_lines_are_faults_without_wrong_ranges(tmp_path):
    path, counts = tmp_path / "f.uwb", Progress()
    faults = [
        {"kind": "hang", "tag": 3, "at_s": 0.5},
        {"kind": "garble-bytes", "share": 0.0005},
        {"kind": "split-writes", "share": 0.3, "gap_ms": 1.0},
        {"kind": "lose-frames", "share": 0.05},
    ]

    def enough():
        return counts.exchanges > 100 and {"time-out", "garbage"} <= counts.faults.keys()

    with served(faults=faults) as server:
        record(server.names.values(), path, RangingPlan(), duration_s=60.0, listeners=[counts], stop=enough)
    exchanges, found, _, _ = stored(path)
    assert {"time-out", "garbage"} <= {fault.kind for fault in found}
    assert len(exchanges) > 25
    # A damaged line that still decodes would be a range that its own stamps contradict.
    assert np.mean(np.abs(raw_range(exchanges) - exchanges.range_m) < 2e-4) > 0.97


def test_two_boards_with_one_id_and_absent_ports_are_refused_before_anything_is_written(tmp_path):
    with served() as one, served() as two:
        (tmp_path / "mine.uwb").write_text("mine")
        first, second = one.names[1], one.names[2]
        for ports, plan, name, error, said in (
            ([first, two.names[1]], RangingPlan(), "f.uwb", errors.PlanError, "both have the id 1"),
            ([first, "/dev/nothing"], RangingPlan(), "f.uwb", errors.PortMissingError, "no such port"),
            ([first, second], RangingPlan(((1, 9),)), "f.uwb", errors.PlanError, "contains 9"),
            ([first, second], RangingPlan(), "mine.uwb", errors.RecordingExistsError, None),
        ):
            with pytest.raises(error, match=said):
                record(ports, tmp_path / name, plan)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("mine.uwb", "mine")]


def command(path, server, *more):
    ports = [str(name) for name in server.names.values()]
    return [str(BIN / "uwblink"), "record", *ports, "-o", str(path), "--pairs", "all", "--force", *more]


def wait_for_rows(path, process):
    """Wait until a recorder has committed some hundred rows."""
    log = Path(f"{path}.wal")
    wait_until(lambda: log.exists() and log.stat().st_size > 30_000, process)


def test_ctrl_c_ends_cleanly_and_completely(tmp_path):
    path = tmp_path / "f.uwb"
    with served() as server:
        process = subprocess.Popen(command(path, server), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        wait_for_rows(path, process)
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, "Traceback" in err) == (0, False), err
    count = len(load(path).exchanges)
    good, late = (int((re.search(pattern, out) or [0, 0])[1]) for pattern in (r"(\d+) of ", r"time-out (\d+)"))
    # Under load, a report may come after its time-out: it is stored, and its turn has failed.
    assert 0 < good <= count <= good + late
    assert not Path(f"{path}.wal").exists()


def held_up_s(process):
    """Return how long the threads of a process have waited for a processor."""
    try:
        texts = [path.read_text() for path in Path(f"/proc/{process.pid}/task").glob("*/schedstat")]
    except OSError:  # other systems than Linux
        return 0.0
    return sum(int(text.split()[1]) for text in texts) * 1e-9


@pytest.mark.slow
def test_kill_9_loses_nothing_older_than_a_quarter_of_a_second(tmp_path):
    path, ages = tmp_path / "f.uwb", []
    # In addition to the processor, the recorder waits for a disk that others use: one try in four must meet the
    # promise.
    for attempt in range(4):
        with served() as server:
            process = subprocess.Popen(command(path, server), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            wait_for_rows(path, process)
            before_s = held_up_s(process)
            time.sleep(0.3 + 0.073 * attempt)
            others_s = held_up_s(process) - before_s
            process.kill()
            killed_ns = time.time_ns()
            process.wait()
        exchanges, _, frames, _ = stored(path)
        assert len(exchanges) > 20
        # Up to 50 ms pass between reports on three boards, in addition to the promised 0.25 s.
        ages.append((killed_ns - max(frame.time_ns for frame in frames)) * 1e-9 - others_s)
        if ages[-1] < 0.3:
            return
        for left in tmp_path.iterdir():  # also the log, for which the next recorder waits
            left.unlink()
    raise AssertionError(f"bytes of the last {ages} s were lost")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["f.uwb", ".f.uwb.*"])
def test_a_recorder_that_is_killed_as_it_begins_leaves_a_recording_or_nothing(tmp_path, kind):
    """Killed when the file appears, or its temporary file."""
    path = tmp_path / "f.uwb"
    with served() as server:
        process = subprocess.Popen(command(path, server), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        wait_until(lambda: any(tmp_path.glob(kind)), process, step_s=0.0)
        process.kill()
        process.wait()
    if path.exists():
        found = load(path)
        assert (found.meta["source"], len(found.exchanges) < 50) == ("boards", True)
    else:
        assert kind != "f.uwb"


def test_damage_other_messages_and_the_bytes_of_an_unfinished_one_are_decoded_again(tmp_path):
    report = b"R05|2|3.0550|1|2|3|4|5|6|-87.4977|-87.5239|-3.4971|3.5222\r\n"
    pieces = [("a", b"\xff" + report), ("b", b"R01|7\r\n\xff\r\n"), ("a", report + b"R05|2|3.0")]
    with Recording.create(tmp_path / "r.uwb", meta={"ports": {"1": "a", "7": "b"}}) as recording:
        recording.append("frames", [FrameRow(k, name, "in", data) for k, (name, data) in enumerate(pieces)])
        again = decode_again(recording)
    others = [(one.board, one.message) for one in again.others if not isinstance(one.message, Skipped)]
    assert (again.exchanges.initiator.tolist(), others) == ([1, 1], [(7, IdReport(7))])
    assert (again.messages, again.skipped_bytes) == (3, len(b"\xff" + b"\xff\r\n" + b"R05|2|3.0"))
