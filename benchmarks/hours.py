"""Eight hours of recording at 200 exchanges per second, in virtual time: memory, latency and commands on the file.

`python -m benchmarks.hours record HOURS FILE` records from boards that answer at once and need no time, so that only
the recorder is measured, and adds poses of motion capture. `python -m benchmarks.hours commands FILE` measures show,
doctor, fit, apply and export on that file, each in a separate process. `python -m benchmarks.hours write EXCHANGES
FILE` writes a flight for that, without boards.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from bisect import bisect
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.flights import Plan, fly
from benchmarks.large import peak_mb
from uwblink.boards import record as writer
from uwblink.boards.listeners import Heard, Progress
from uwblink.boards.ranging_plan import RangingPlan
from uwblink.boards.record import record
from uwblink.recording.contents import Contents
from uwblink.recording.file import Recording
from uwblink.recording.schema import FrameRow, Poses
from uwblink.wire.codec import Decoder, encode
from uwblink.wire.messages import REPORTS, GetId, IdReport, RangeCommand, RangeReport

RATE_HZ: Final = 200.0
BEGIN_NS: Final = 1_000_000_000
"""Start of flights by their own clock."""

ANSWER_NS: Final = 4_000_000
ROUND_S: Final = 100.0
"""Period after which the motion of bodies repeats."""

A_ROUND: Final = 4_000
"""Number of different reports of the boards; they repeat."""

MANY_A_ROUND: Final = 80_000
"""Number of reports such that positions in a report are at most 15 ms older than those of the poses."""

LINES_EVERY_S: Final = 1_800.0

FILE: Final = "long.uwb"
COMMANDS: Final = (
    ("uwblink", "show", FILE),
    ("calib", "doctor", FILE),
    ("calib", "fit", FILE, "-o", "long.json", "--force"),
    ("calib", "apply", FILE, "-c", "long.json", "-o", "corrected.uwb", "--force"),
    *(("uwblink", "export", FILE, "--to", to, "-o", to, "--force") for to in ("parquet", "csv", "tum", "mcap")),
)


class AnsweringPort:
    """A port of a board that answers every command after `ANSWER_NS` of virtual time."""

    def __init__(self, ports: AnsweringPorts, name: str) -> None:
        """Take the ports that it belongs to."""
        self._ports, self.name = ports, name
        self.board = int(name)
        self.due: deque[tuple[int, bytes]] = deque()

    def read(self, timeout_s: float) -> bytes:
        """Return available bytes, after waiting for at most a time-out."""
        if not self.due or self.due[0][0] > self._ports.time_ns:
            self._ports.wait([self], timeout_s)
        found = b""
        while self.due and self.due[0][0] <= self._ports.time_ns:
            found += self.due.popleft()[1]
        return found

    def write(self, data: bytes) -> None:
        """Accept a command."""
        self.due.append((self._ports.time_ns + ANSWER_NS, self._ports.answer(self.board, data)))

    def now_s(self) -> float:
        """Return the virtual time."""
        return self._ports.now_s()

    def close(self) -> None:
        """Discard unread bytes."""
        self.due.clear()


class AnsweringPorts:
    """Ports of such boards; virtual time advances only during waits. Reports are those of a flight, repeated."""

    def __init__(self, seed: int = 1, a_round: int = A_ROUND) -> None:
        """Create the reports of one period (`a_round`) of the flight."""
        self.time_ns = 0
        self.flight = fly(Plan(seconds=ROUND_S, per_second=a_round / ROUND_S), seed)
        e = self.flight.exchanges
        self._reports: dict[bytes, tuple[list[int], list[bytes]]] = {}
        for k in range(len(e)):
            report = RangeReport(
                int(e.target[k]), float(e.range_m[k]),
                *(int(getattr(e, name)[k]) for name in ("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")),
                *(float(getattr(e, name)[k]) for name in ("fpp1_dbm", "fpp2_dbm", "skew1_ppm", "skew2_ppm")),
            )  # fmt: skip
            key = self._key(int(e.initiator[k]), int(e.target[k]))
            times, reports = self._reports.setdefault(key, ([], []))
            times.append(int(e.time_ns[k]) - BEGIN_NS)
            reports.append(encode(report))
        self.pairs = tuple(sorted((i, j) for i, j in (map(int, key.split()) for key in self._reports) if i < j))
        self.names = [str(board) for board in sorted({*e.initiator.tolist(), *e.target.tolist()})]

    def answer(self, board: int, data: bytes) -> bytes:
        """Return the answer of a board to a command."""
        if data == encode(GetId()):
            return encode(IdReport(board))
        times, reports = self._reports[self._key(board, int(data.split(b"|")[1]))]
        return reports[bisect(times, self.time_ns % int(ROUND_S * 1e9)) - 1]

    def poses(self, seconds: float) -> Iterator[Poses]:
        """Yield the poses of some seconds, one period at a time."""
        p = self.flight.poses
        begin, end = BEGIN_NS, BEGIN_NS + int(ROUND_S * 1e9)
        one = p[np.flatnonzero((p.time_ns >= begin) & (p.time_ns < end))]
        one = one[np.argsort(one.time_ns, kind="stable")]
        for k in range(int(np.ceil(seconds / ROUND_S))):
            yield replace(one, time_ns=one.time_ns + k * int(ROUND_S * 1e9) - BEGIN_NS)

    @staticmethod
    def _key(board: int, target: int) -> bytes:
        return b"%d %d" % (board, target)

    def open(self, name: str) -> AnsweringPort:
        """Return a port."""
        return AnsweringPort(self, name)

    def wait(self, ports: Sequence[AnsweringPort], timeout_s: float) -> Sequence[AnsweringPort]:
        """Advance the time until bytes are available, or until the time-out."""
        until = self.time_ns + int(timeout_s * 1e9) + 1
        due = min((port.due[0][0] for port in ports if port.due), default=until)
        self.time_ns = max(self.time_ns, min(due, until))
        return [port for port in ports if port.due and port.due[0][0] <= self.time_ns]

    def now_s(self) -> float:
        """Return the virtual time in seconds."""
        return self.time_ns * 1e-9

    def host_ns(self) -> int:
        """Return the virtual time in nanoseconds."""
        return self.time_ns

    def moved(self, name: str, _number: str | None) -> str | None:
        """Return the same name, because ports do not change."""
        return name


COMMITS: Final[list[tuple[float, float]]] = []
"""Start and end of each commit of the recorder."""


class TimedWriter(writer.RecordingWriter):
    """A writer that stores the durations of its commits."""

    def _write(self) -> None:
        begin, rows = time.monotonic(), self.waiting
        super()._write()
        if rows:
            COMMITS.append((begin, time.monotonic()))


def recording(hours: float, path: Path) -> None:
    """Record in virtual time; print a line per half hour. Times are processor times."""
    writer.RecordingWriter = TimedWriter  # type: ignore[misc]
    ports = AnsweringPorts(a_round=MANY_A_ROUND)
    print("| hour | exchanges | file | memory | commit, median (99 %) | message to row, 99 % | times real time* |")
    print("|---|---|---|---|---|---|---|", flush=True)
    plan = RangingPlan(ports.pairs, rate_hz=RATE_HZ, tags=tuple(ports.flight.tags))
    record(ports.names, path, plan, duration_s=hours * 3600, using=ports, watch=_Lines(path).watch, force=True)
    with Recording.open(path, update=True, memory_mb=64) as recorded:
        for poses in ports.poses(hours * 3600):
            recorded.append("poses", poses)


class _Lines:
    """Prints the measurements since the last line."""

    def __init__(self, path: Path) -> None:
        self._next_s = LINES_EVERY_S
        self._began = time.process_time()
        self.path = path

    def watch(self, progress: Progress) -> None:
        if progress.time_s < self._next_s:
            return
        commits = np.array(COMMITS)
        COMMITS.clear()
        taken = np.diff(commits, axis=1)[:, 0]
        # Messages that arrive just after a batch was taken wait until the next batch is committed.
        late = commits[1:, 1] - commits[:-1, 0]
        pages = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        now = time.process_time()
        print(
            f"| {progress.time_s / 3600:.1f} | {progress.exchanges} | {self.path.stat().st_size / 1e6:.0f} MB | "
            f"{pages / 1e6:.0f} MB | {1e3 * np.median(taken):.0f} ms ({1e3 * np.percentile(taken, 99):.0f}) | "
            f"{1e3 * np.percentile(late, 99):.0f} ms | {LINES_EVERY_S / (now - self._began):.0f} |",
            flush=True,
        )
        self._began = now
        self._next_s += LINES_EVERY_S


def growth(path: Path) -> None:
    """Print the times of commits of one second of messages, into an empty recording and into an existing one."""
    print("| exchanges in the file | commit of a second, median (99 %) |")
    print("|---|---|")
    second = _a_second()
    with tempfile.TemporaryDirectory() as folder, Recording.create(Path(folder) / "new.uwb", live=True) as empty:
        print(f"| none | {_commits(empty, second)} |", flush=True)
    with Recording.open(path, update=True) as long:
        print(f"| {long.count('exchanges')} | {_commits(long, second)} |", flush=True)


def _a_second() -> list[writer.Row]:
    """Return the data that a recorder writes per second: reports and their bytes."""
    ports, decoder = AnsweringPorts(), Decoder(REPORTS)
    rows: list[writer.Row] = []
    for k in range(int(RATE_HZ)):
        board, target = ports.pairs[k % len(ports.pairs)]
        command = encode(RangeCommand(target))
        answer = ports.answer(board, command)
        rows += [FrameRow(k, str(board), "out", command), FrameRow(k, str(board), "in", answer)]
        rows += [Heard(k, board, event) for event in decoder.feed(answer)]
    return rows


def _commits(recording: Recording, rows: list[writer.Row]) -> str:
    taken = []
    for _ in range(200):
        begin = time.thread_time()
        with recording.transaction():
            writer.append_rows(recording, rows)
        taken.append(time.thread_time() - begin)
    return f"{1e3 * np.median(taken):.1f} ms ({1e3 * np.percentile(taken, 99):.1f})"


def commands(path: Path) -> None:
    """Measure each command on a recording, and then commits into it, which change the recording."""
    print("| command | processor time | largest memory |")
    print("|---|---|---|")
    for words, seconds, memory_mb in measured(path):
        print(f"| `{words}` | {seconds:.1f} s | {memory_mb:.0f} MB |", flush=True)
    growth(path)


def measured(path: Path) -> Iterator[tuple[str, float, float]]:
    """Yield each command, its processor time, and its peak memory."""
    with tempfile.TemporaryDirectory() as folder:
        for words in COMMANDS:
            named = [str(path.absolute()) if word == FILE else word for word in words]
            process = subprocess.Popen(
                [sys.executable, "-m", *named], cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            _, status, used = os.wait4(process.pid, 0)
            if os.waitstatus_to_exitcode(status):
                sys.exit(f"{' '.join(words)}: ended with {os.waitstatus_to_exitcode(status)}")
            yield " ".join(words), used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def write(exchanges: int, path: Path) -> None:
    """Write a flight of three bodies with two tags each, and their poses fifty times a second."""
    flight = fly(Plan(seconds=exchanges / RATE_HZ, per_second=RATE_HZ), 1)
    Contents(exchanges=flight.exchanges, tags=flight.tags, poses=flight.poses).save(path)
    print(f"{len(flight.exchanges)} exchanges, {len(flight.poses)} poses, made with {peak_mb():.0f} MB", flush=True)


def main(words: list[str]) -> None:
    """Run the action that the first argument names."""
    what, *rest = words
    if what == "record":
        recording(float(rest[0]), Path(rest[1]))
    elif what == "write":
        write(int(rest[0]), Path(rest[1]))
    elif what == "growth":
        growth(Path(rest[0]))
    else:
        commands(Path(rest[0]))


if __name__ == "__main__":
    main(sys.argv[1:])
