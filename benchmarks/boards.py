"""Measure driver, recorder and served boards: `make bench-boards`, about five minutes."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from benchmarks.__main__ import BIN, ROOT, durations, row

BENCH = ROOT / "scenarios" / "two_boards_on_a_bench" / "bench.toml"
SECONDS = 60.0


def main() -> None:
    """Print one row per figure."""
    print("| what | goal | measured |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ten_boards(folder)
        ten_sources(folder, burst=1)
        ten_sources(folder, burst=4)
    round_trip()
    driver_share()
    decoder()


def recorded(ports: list[str], path: Path, *more: str) -> tuple[float, str]:
    """Record in a separate process; return its processor time in seconds, and the last line of its output."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [str(BIN / "uwblink"), "record", *ports, "-o", str(path), "--force", *more], capture_output=True, text=True
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        sys.exit(done.stderr)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, done.stdout.strip()


@contextmanager
def served(scenario: Path, folder: Path, *tags: int) -> Iterator[tuple[int, list[str]]]:
    """Serve boards in a separate process; yield its id, and the ports of tags, as links in a folder."""
    words = [str(BIN / "uwbsim"), "serve", str(scenario), "--link-dir", str(folder)]
    server, ports = subprocess.Popen(words, stdout=subprocess.PIPE), [str(folder / f"tag{tag}") for tag in tags]
    try:
        while not all(map(os.path.exists, ports)):
            time.sleep(0.1)
        yield server.pid, ports
    finally:
        server.send_signal(signal.SIGINT)
        server.wait()


def ten_boards(folder: Path) -> None:
    tags = "\n".join(f'[[tags]]\nid = {k}\nbody = "b{k}"\n' for k in range(10))
    bodies = "\n".join(
        f'[[bodies]]\nname = "b{k}"\nmotion = {{ model = "static", position_m = [{k % 4}.0, {k // 4}.0, 1.0] }}\n'
        for k in range(10)
    )
    scenario = folder / "ten.toml"
    scenario.write_text(f"[run]\nduration_s = 60\n[ranging]\nrate_hz = 100\n{bodies}\n{tags}")
    with served(scenario, folder / "ports", *range(10)) as (_, ports):
        cpu, line = recorded(
            ports, folder / "ten.uwb", "--pairs", "all", "--rate", "200", "--duration", str(int(SECONDS))
        )
    row(
        "ten served boards, 200 exchanges/s in total, 60 s",
        "none lost",
        f"{line.split(': ', 1)[1]}; recorder {100 * cpu / SECONDS:.0f} % of a core",
    )


def ten_sources(folder: Path, burst: int) -> None:
    """Record from ten sources that send numbered reports; every number must be in the recording."""
    from uwblink.recording.file import Recording

    words = [sys.executable, "-m", "benchmarks.sources", "10", "200", str(SECONDS), str(burst)]
    source = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    assert source.stdout is not None  # noqa: S101 - it was asked for
    ports = source.stdout.readline().split()
    path = folder / "sources.uwb"
    cpu, _ = recorded(ports, path, "--pairs", "none", "--duration", str(int(SECONDS) + 3))
    sent, unread = map(int, source.stdout.readline().split())
    source.wait()
    with Recording.open(path) as recording:
        e = recording.exchanges()
    lost = sent - len(set(zip(e.reporter.tolist(), e.tx1.tolist(), strict=True)))
    how = "in bursts of four, 64 bytes a piece" if burst > 1 else "one by one"
    row(
        f"ten ports, 200 reports/s each, {how}, 60 s",
        "none lost, below 20 % of a core",
        f"{lost} of {sent} lost ({unread} bytes unread), {100 * cpu / (SECONDS + 3):.1f} % of a core",
    )


def round_trip() -> None:
    from uwblink.boards.board import Board

    with (
        tempfile.TemporaryDirectory() as folder,
        served(BENCH, Path(folder), 10, 20) as (_, ports),
        Board.open(ports[0]) as board,
    ):
        times = durations(lambda: board.range(20), 2000, 200)
    row(
        "`twr` round trip through a pseudo-terminal, default delay",
        "median below 6 ms",
        f"median {np.median(times) * 1e3:.2f} ms, 99 % {np.quantile(times, 0.99) * 1e3:.2f} ms",
    )


def driver_share() -> None:
    """Measure the round trip to a process that only answers: driver, kernel, and the wake-up of the process."""
    from benchmarks.sources import report
    from uwblink.boards.board import Board
    from uwblink.boards.ports import Terminal

    terminal = Terminal()
    pid = os.fork()
    if pid == 0:
        line = report(1)
        import select

        while True:
            select.select([terminal.fileno or 0], [], [])
            if terminal.read():
                terminal.write(line)
    try:
        with Board.open(terminal.name) as board:
            times = durations(lambda: board.range(99), 5000, 500)
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        terminal.unplug()
    row(
        "round trip to an answerer that answers at once (driver, kernel and wake-ups)",
        "median below 150 us, 99 % below 400 us",
        f"median {np.median(times) * 1e6:.0f} us, 99 % {np.quantile(times, 0.99) * 1e6:.0f} us",
    )


def decoder() -> None:
    from benchmarks.sources import report
    from uwblink.wire.codec import Decoder, exchanges_of
    from uwblink.wire.messages import REPORTS

    reports = [report(k) for k in range(20_000)]  # one piece each, as read from a port
    rates = []
    for _ in range(6):
        messages, start = Decoder(REPORTS), time.perf_counter()
        found = exchanges_of([(k, 1, one) for k, data in enumerate(reports) for one in messages.feed(data)])
        rates.append(len(found) / (time.perf_counter() - start))
        if not np.array_equal(found.tx1, np.arange(20_000)):
            sys.exit("the decoder lost reports")
    row(
        "decoder, from bytes to columns",
        "20 000 reports/s",
        f"{np.median(rates[1:]):,.0f} reports/s".replace(",", " "),
    )


if __name__ == "__main__":
    main()
