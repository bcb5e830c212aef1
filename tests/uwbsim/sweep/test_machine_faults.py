"""Sweeps during faults of computers: a damaged store, two sweeps in one folder, a scheduler that ends."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import duckdb
import pytest

from tests.errors import one_line
from tests.processes import CONTEXT, refuse, succeed, wait_until
from tests.uwbsim.sweep.test_sweep import GRID, HEAD, plan, rows
from uwblink.errors import UwblinkError
from uwbsim.sweep.executors import ClusterLostError
from uwbsim.sweep.runner import ResultStore, SweepSummary, TableError, run_sweep

pytestmark = pytest.mark.slow

UWBSIM = str(Path(sys.executable).parent / "uwbsim")
SMALL = HEAD + 'ranges = 100\n[vary]\n"radio.rx_noise_ps" = [0.0, 50.0]\n'


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    p = plan(folder, SMALL)
    assert run_sweep(p, folder / "out", workers=1).done == 2
    return p, folder / "out"


@pytest.fixture
def done(finished, tmp_path):
    p, out = finished
    shutil.copytree(out, tmp_path / "out")
    return p, tmp_path / "out"


def cut(store):
    store.write_bytes(store.read_bytes()[:20_000])


def garbage(store):
    data = bytearray(store.read_bytes())
    data[12_288:] = os.urandom(len(data) - 12_288)
    store.write_bytes(bytes(data))


def with_sql(*statements):
    def change(store):
        with duckdb.connect(str(store)) as db:
            for statement in statements:
                db.execute(statement)

    return change


@pytest.mark.parametrize(
    "damage",
    [
        cut,
        garbage,
        with_sql("UPDATE identity SET value = NULL"),
        with_sql("UPDATE identity SET value = '{'"),
        with_sql("ALTER TABLE identity DROP COLUMN value"),
        with_sql("DROP TABLE results"),
        with_sql("ALTER TABLE results DROP COLUMN number"),
        with_sql("UPDATE results SET document = NULL"),
        with_sql("UPDATE results SET document = '[1]'"),
        with_sql("UPDATE results SET number = NULL"),
    ],
    ids=["cut", "garbage", "no identity", "no json", "column", "table", "number", "null", "list", "no number"],
)
def test_a_damaged_store_is_one_line_and_stays_as_it_is(done, damage):
    p, out = done
    damage(out / "results.duckdb")
    before = (out / "results.csv").read_bytes()
    with pytest.raises(UwblinkError, match=one_line(str(out))):  # which is status 2 of the command
        run_sweep(p, out, workers=1, resume=True)
    assert (out / "results.csv").read_bytes() == before


def _hold(path, pipe):
    with ResultStore.open(path):
        pipe.send("open")
        pipe.recv()


def test_two_sweeps_cannot_have_one_folder(done):
    p, out = done
    ours, theirs = CONTEXT.Pipe()
    other = CONTEXT.Process(target=_hold, args=(out / "results.duckdb", theirs))
    other.start()
    assert ours.recv() == "open"
    with pytest.raises(TableError) as caught:
        run_sweep(p, out, workers=1, resume=True)
    ours.send("close")
    other.join()
    assert str(caught.value) == f"{out}/results.duckdb: another sweep writes its results there; give another folder"
    assert len(rows(out)) == 4


def test_a_full_disk_ends_a_sweep_with_one_line_and_keeps_what_was_done(tmp_path):
    plan(tmp_path, SMALL)
    words = ("uwbsim", "sweep", tmp_path / "plan.toml", "-o", tmp_path / "out", "--workers", "1")
    refuse(*words, most_bytes=8000)
    assert not (tmp_path / "out" / "results.csv").exists()
    # With space on the disk again, the same command continues.
    (tmp_path / "out" / "results.duckdb").unlink(missing_ok=True)
    succeed(*words)


SCHEDULER = """
import sys
from distributed import LocalCluster
if __name__ == "__main__":
    quiet = {"dashboard_address": "127.0.0.1:0", "silence_logs": 50}
    with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", **quiet) as c:
        print(c.scheduler_address, flush=True)
        sys.stdin.read()
"""


def test_a_scheduler_that_goes_away_is_named_and_what_was_done_is_kept(tmp_path):
    pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    import dask

    p = plan(tmp_path, HEAD + "ranges = 60_000\nseeds = 24\n")
    words = [sys.executable, "-c", SCHEDULER]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=tmp_path) as cluster:
        address = cluster.stdout.readline().strip()
        gone = pytest.raises(
            ClusterLostError, match=rf"^{address}: the connection to the scheduler is lost; results so far are kept"
        )
        # Time during which the client tries to reconnect; the default is half a minute.
        with dask.config.set({"distributed.comm.timeouts.connect": "1s"}), gone:
            run_sweep(p, tmp_path / "out", scheduler=address, progress=lambda _: cluster.kill())
    with ResultStore.open(tmp_path / "out" / "results.duckdb") as store:
        before = store.done()
    assert 0 < len(before) < p.total


def test_results_of_another_version_are_not_gone_on_with(done):
    p, out = done
    with_sql("UPDATE identity SET value = '\"0.0.1\"' WHERE key = 'uwbcal'")(out / "results.duckdb")
    refuse("uwbsim", "sweep", p.path, "-o", out, "--workers", 1, "--resume", naming=[out, "0.0.1"])


ENDLESS = "sweep = { scenario = 'noiseless', protocols = ['ds'], ranges = 20000, seeds = 100000 }\n"


def session(leader):
    """Return the processes of a session that still run."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            pid, rest = stat.parent.name, stat.read_text().rsplit(")", 1)[1].split()
            if int(rest[3]) == leader and rest[0] != "Z":
                found.append(int(pid))
    return found


def signals_blocked(pid):
    bits = int(re.search(r"SigBlk:\s*(\w+)", Path(f"/proc/{pid}/status").read_text())[1], 16)
    return {number for number in signal.Signals if bits >> (number - 1) & 1}


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are looked up in /proc")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_sweep_that_ends_early_leaves_no_worker_and_goes_on_where_it_was(tmp_path, number):
    p, out, words = plan(tmp_path, HEAD + "ranges = 4_000\nseeds = 8\n" + GRID), tmp_path / "out", tmp_path / "words"
    with words.open("w") as stream:
        command = [UWBSIM, "sweep", p.path, "-o", out, "--workers", "2"]
        process = subprocess.Popen(command, stdout=stream, stderr=stream, start_new_session=True)
    try:
        # The log grows with every result; ten thousand bytes are a few of them.
        log = out / "results.duckdb.wal"
        wait_until(lambda: log.exists() and log.stat().st_size > 10_000)
        # Workers ignore Ctrl-C, which a terminal sends to all of them, so that the sweep handles it; they can be
        # terminated.
        blocked = [signals_blocked(pid) for pid in session(process.pid)]
        assert [sum(one in some for some in blocked) for one in (signal.SIGINT, signal.SIGTERM)] == [2, 0]
        (os.killpg if number == signal.SIGINT else os.kill)(process.pid, number)
        assert process.wait(60) == (130 if number == signal.SIGINT else -number)
        wait_until(lambda: not session(process.pid))
    finally:
        for left in session(process.pid):
            os.kill(left, signal.SIGKILL)
    if number == signal.SIGINT:  # Python's resource tracker may report a kill
        (said,) = words.read_text().splitlines()
        assert "interrupted; finished runs are kept, and --resume continues" in said
        assert not log.exists(), "the store is closed"
        assert not (out / "results.csv").exists(), "which is written when all is done"
    with ResultStore.open(out / "results.duckdb") as store:
        before = len(store.done())
    assert 0 < before < p.total
    assert run_sweep(p, out, workers=1, resume=True) == SweepSummary(p.total - before, 0, before)
    assert [int(row["number"]) for row in rows(out)] == [k for k in range(p.total) for _ in range(2)], "nothing twice"


def test_a_worker_that_dies_as_it_begins_is_one_line(tmp_path):
    """An installed module may end a process that imports it, as may a lack of memory."""
    (tmp_path / "p.toml").write_text(ENDLESS)
    (tmp_path / "sitecustomize.py").write_text("import os, sys\nif '--multiprocessing-fork' in sys.argv: os._exit(9)\n")
    env = os.environ | {"PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    words = [UWBSIM, "sweep", "p.toml", "-o", "out", "--workers", "2"]
    done = subprocess.run(words, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "--workers" in done.stderr
    assert not (tmp_path / "out").exists()
