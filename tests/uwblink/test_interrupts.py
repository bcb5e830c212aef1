"""Ctrl-C: a summary, the right exit status, a closed file, no traceback."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

import calib
import uwblink
import uwbsim
from tests import processes
from tests.boards import served
from tests.shared_data import ROOT


def started(*words):
    environment = os.environ | {"PYTHONFAULTHANDLER": "1"}
    command = [str(processes.BIN / words[0]), *words[1:]]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


def ended(process, number=signal.SIGINT):
    process.send_signal(number)
    try:
        out, err = process.communicate(timeout=60)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGABRT)  # it prints in its own folder
        raise AssertionError(process.communicate()) from None
    assert "Traceback" not in err, err
    return out, err


def test_twr_prints_each_line_when_it_comes_and_a_summary_at_the_end():
    with served() as server:
        process = started("uwblink", "twr", server.names[1], "2", "-n", "1000000", "--json")
        # A buffer would keep lines that came with the first one from what is read at the end.
        begun = os.read(process.stdout.fileno(), 65_536).decode()
        assert process.poll() is None, "the line came while it goes on"
        out, _ = ended(process)
    *rows, last = [json.loads(line) for line in (begun + out).splitlines()]
    assert process.returncode == 130
    assert {(row["initiator"], row["target"]) for row in rows} == {(1, 2)}
    assert last["summary"]["exchanges"] == len(rows) < 1_000_000
    assert last["summary"]["mean_m"] == pytest.approx(3.0, abs=0.5)


def test_twr_that_is_not_interrupted_has_status_0_and_a_summary():
    with served() as server:
        said = processes.succeed("uwblink", "twr", server.names[1], "2", "-n", "5", "--json").stdout
    rows = [json.loads(line) for line in said.splitlines()]
    assert [set(row) == {"summary"} for row in rows] == [False] * 5 + [True]
    assert rows[-1]["summary"]["exchanges"] == 5


def files(folder):
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    path = tmp_path_factory.mktemp("flight") / "f.uwb"
    uwbsim.simulate(ROOT / "scenarios" / "icra2023" / "test1.toml").save(path)
    return path


@pytest.mark.slow
def test_an_interrupted_report_is_reported_and_leaves_no_partial_file(flight, tmp_path):
    process = started("calib", "report", str(flight), "-o", str(tmp_path / "page.html"))
    processes.wait_until(lambda: is_working(process), process)
    time.sleep(1.0)
    _, err = ended(process)
    # On a fast machine it may have ended before.
    assert process.returncode in (130, 0)
    assert ("interrupted" in err) == (process.returncode == 130)
    assert files(tmp_path) == ([] if process.returncode else ["page.html"])
    assert files(flight.parent) == ["f.uwb"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "words"),
    [
        (signal.SIGTERM, ("uwbsim", "run", "icra2023/test1", "-o", "f.uwb", "--set", "run.duration_s=100")),
        (signal.SIGINT, ("uwblink", "export", "../long.uwb", "--to", "csv", "-o", "f")),
        (signal.SIGINT, ("uwblink", "import", "csv", "../long.csv", "-o", "f.uwb")),
        (signal.SIGTERM, ("calib", "apply", "../long.uwb", "-c", "../c.json", "-o", "f.uwb")),
    ],
)
def test_a_terminated_writer_leaves_no_file(long, tmp_path, words, number):
    """Interrupted when the first file appears in its folder."""
    folder = long.parent / f"{tmp_path.name}"
    folder.mkdir()
    process = subprocess.Popen(
        [str(processes.BIN / words[0]), *words[1:]],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    processes.wait_until(lambda: any(folder.iterdir()), process, step_s=0.002)
    _, err = ended(process, number)
    assert ((process.returncode, err), list(folder.iterdir())) == ((130, "interrupted\n"), [])


@pytest.fixture(scope="module")
def long(tmp_path_factory):
    """A recording and a table that take a second to write, and a calibration of their tags."""
    folder = tmp_path_factory.mktemp("long")
    flight = calib.sample_flight(300_000)
    uwblink.Contents(exchanges=flight.exchanges, poses=flight.poses, tags=flight.tags).save(folder / "long.uwb")
    calib.fit(calib.sample_flight(2000)).calibration.save(folder / "c.json")
    rows = (f"{k}.25,{k % 5},9,{3.25 + k % 7:.3f},-80.5,-81.5\n" for k in range(600_000))
    (folder / "long.csv").write_text("time_s,from_id,to_id,range_m,fpp1,fpp2\n" + "".join(rows))
    return folder / "long.uwb"


def is_working(process):
    """Return whether a process has used half a second of processor time, so that its start is over."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rsplit(")", 1)[1].split()
    return int(fields[11]) + int(fields[12]) > os.sysconf("SC_CLK_TCK") / 2
