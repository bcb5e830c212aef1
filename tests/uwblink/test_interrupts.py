"""Ctrl-C: a summary, the right exit status, a closed file, no traceback."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.boards import served

BIN = Path(sys.executable).parent


def started(*words):
    return subprocess.Popen(
        [str(BIN / words[0]), *words[1:]], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def ended(process, number=signal.SIGINT):
    process.send_signal(number)
    out, err = process.communicate(timeout=60)
    assert "Traceback" not in err, err
    return out, err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_twr_prints_each_line_when_it_comes_and_a_summary_at_the_end(number):
    with served() as server:
        process = started("uwblink", "twr", server.names[1], "2", "-n", "1000000", "--json")
        first = json.loads(process.stdout.readline())
        assert (first["initiator"], first["target"]) == (1, 2)
        assert process.poll() is None, "the line came while it goes on"
        out, _ = ended(process, number)
    *rows, last = [json.loads(line) for line in out.splitlines()]
    assert process.returncode == 130
    assert last["summary"]["exchanges"] == 1 + len(rows) < 1_000_000
    assert last["summary"]["mean_m"] == pytest.approx(3.0, abs=0.5)


def test_twr_that_is_not_interrupted_has_status_0_and_a_summary():
    with served() as server:
        done = subprocess.run(
            [str(BIN / "uwblink"), "twr", server.names[1], "2", "-n", "5", "--json"], capture_output=True, text=True
        )
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0
    assert [set(row) == {"summary"} for row in rows] == [False] * 5 + [True]
    assert rows[-1]["summary"]["exchanges"] == 5
