"""Sweeps: equal results with any workers, also after faults, and no run twice."""

import contextlib
import csv
import importlib
import os
import re
import shutil
import signal
import subprocess
import sys
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pytest

from tests.errors import one_line
from tests.processes import BIN, refuse, succeed, wait_until
from tests.registered import registered
from uwblink.errors import UwblinkError
from uwblink.protocols.table import PROTOCOLS
from uwbsim import ParameterError, ScenarioError, UwbsimError, load_design, run_sweep
from uwbsim.sweep.executors import Cluster, ClusterLostError, Processes
from uwbsim.sweep.runner import ResultStore, SweepSummary
from uwbsim.world.channel import CHANNEL_EFFECTS, ChannelEffect

HEAD = '[sweep]\nscenario = "icra2023/test1"\nprotocols = ["ss-cfo", "ds"]\n'
GRID = '[vary]\n"ranging.response_delay_uus" = [300, 1500]\n"radio.rx_noise_ps" = [0.0, 50.0, 100.0]\n'


def plan(tmp_path, text=HEAD + "ranges = 3000\nseeds = 2\n" + GRID, name="plan.toml"):
    path = tmp_path / name
    path.write_text(text)
    return load_design(path)


def rows(folder):
    with (folder / "results.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_a_grid_has_every_combination_with_every_seed(tmp_path):
    p = plan(tmp_path)
    assert (p.points, p.total) == (6, 12)
    runs = [p.run(k) for k in range(12)]
    assert len({(*r.values.values(), r.seed) for r in runs}) == 12
    assert runs[0].values == {"ranging.response_delay_uus": 300, "radio.rx_noise_ps": 0.0}


def test_a_latin_hypercube_has_one_value_in_each_part_of_each_axis(tmp_path):
    spans = '{ low = 10.0, high = 1000.0, scale = "log" }', "{ low = 300, high = 6000 }"
    vary = f'[vary]\n"radio.rx_noise_ps" = {spans[0]}\n"ranging.response_delay_uus" = {spans[1]}\n'
    p = plan(tmp_path, f'{HEAD}design = "latin-hypercube"\nsamples = 20\n{vary}')
    points = [p.run(k).values for k in range(20)]
    noise, delay = (np.array([point[key] for point in points]) for key in points[0])
    assert sorted(np.floor(np.log10(noise / 10) / 2 * 20).astype(int)) == list(range(20))
    assert {type(point["ranging.response_delay_uus"]) for point in points} == {int}
    assert np.all(np.diff(np.histogram(delay, np.linspace(300, 6000, 6))[0]) <= 1)
    assert abs(np.corrcoef(np.log(noise), delay)[0, 1]) < 0.6, "axes are shuffled apart"


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    folder = tmp_path_factory.mktemp("alone")
    p = plan(folder)
    assert run_sweep(p, folder / "out", workers=1).done == 12
    return p, folder / "out"


def test_results_are_rows_with_settings_versions_and_outcomes(alone):
    found = rows(alone[1])
    names = {"scenario", "seed", "uwbcal", "numpy", "python", "status", "ranging.response_delay_uus", "std_m"}
    assert (len(found), names - set(found[0]), {row["status"] for row in found}) == (24, set(), {"ok"})
    with duckdb.connect() as db:
        same = db.execute("SELECT number, std_m FROM read_parquet(?)", [str(alone[1] / "results.parquet")]).fetchall()
    assert same == [(int(r["number"]), float(r["std_m"])) for r in found]
    quiet, loud = (
        np.mean([float(r["std_m"]) for r in found if r["radio.rx_noise_ps"] == n and r["protocol"] == "ds"])
        for n in ("0.0", "100.0")
    )
    assert loud > quiet


@pytest.mark.slow
def test_a_process_that_dies_is_replaced_and_several_give_the_same_bytes(alone, tmp_path, monkeypatch):
    p, out = alone
    pools: list[object] = []

    class Fragile(Processes):
        def submit(self, chunk):
            # A process of the first pool ends, and one of the pool that replaces it: the number of chunks varies.
            super().submit(chunk)
            if self._pool not in pools and len(pools) < 2:
                pools.append(self._pool)
                next(process for process in self._pool._processes.values() if process.is_alive()).kill()

    monkeypatch.setattr("uwbsim.sweep.runner.workers_for", lambda count, scheduler, known: Fragile(2, known))
    run_sweep(p, tmp_path / "out")
    assert len(pools) == 2
    assert (tmp_path / "out" / "results.csv").read_bytes() == (out / "results.csv").read_bytes()


@pytest.mark.slow
def test_a_chunk_that_a_broken_pool_never_reports_is_done_again(alone, tmp_path, monkeypatch):
    p, out = alone

    class Silent(Processes):
        patience_s = 0.2
        silent: Future[Any] | None = None

        def submit(self, chunk):
            super().submit(chunk)
            if self.silent is None:
                # As in the race condition: the pool does not know the chunk, and breaks.
                (last,) = self._running
                self.silent = Future()
                self._running = {self.silent: self._running[last]}
                for process in list(self._pool._processes.values()):
                    process.kill()

    monkeypatch.setattr("uwbsim.sweep.runner.workers_for", lambda count, scheduler, known: Silent(1, known))
    assert run_sweep(p, tmp_path / "out").done == 12
    assert (tmp_path / "out" / "results.csv").read_bytes() == (out / "results.csv").read_bytes()


@pytest.mark.slow
def test_a_dask_cluster_survives_the_death_of_a_worker(tmp_path):
    distributed = pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    p = plan(tmp_path, (HEAD + "ranges = 2_000\nseeds = 4\n" + GRID))
    seen: list[float] = []

    def kill_one(fraction):
        seen.append(fraction)
        if len(seen) == 3:
            assert fraction < 0.9, "there is nothing left to do"
            os.kill(next(iter(cluster.workers.values())).pid, signal.SIGKILL)

    quiet = {"dashboard_address": "127.0.0.1:0", "silence_logs": 50}
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, **quiet) as cluster:
        summary = run_sweep(p, tmp_path / "out", scheduler=cluster.scheduler_address, progress=kill_one)
    assert (summary.done, summary.failed, len(seen) > 2) == (24, 0, True)
    run_sweep(p, tmp_path / "alone", workers=1)
    assert (tmp_path / "out" / "results.csv").read_bytes() == (tmp_path / "alone" / "results.csv").read_bytes()


CALIBRATIONS = HEAD.replace('["ss-cfo", "ds"]', '["ds"]') + 'kind = "calibrate"\n'
CALIBRATE = CALIBRATIONS + '[vary]\n"run.duration_s" = [1, 2]\n'


def test_calibrations_are_swept_too_failed_runs_are_rows_and_others_continue(tmp_path):
    changes = ('"ranging.rate_hz" = 99999.0', '"run.duration_s" = 5', '"run.duration_s" = 0.2')
    text = CALIBRATIONS + 'design = "list"\n' + "".join(f"[[list]]\n{change}\n" for change in changes)
    summary = run_sweep(plan(tmp_path, text), tmp_path / "out", workers=1)
    assert (summary.done, summary.failed) == (3, 2)
    fast, good, short = rows(tmp_path / "out")
    assert [row["status"] for row in (fast, good, short)] == ["failed", "ok", "failed"]
    assert ("rate_hz" in fast["error"], "too few" in short["error"]) == (True, True)
    assert float(good["full_robust_std_m"]) < float(good["raw_robust_std_m"])
    assert float(good["delays_rms_ns"]) < 0.3


STRANGER = """
from dataclasses import replace
from typing import Any
import numpy as np

def figures(flight):
    return {"count": len(flight.exchanges), "weakest_dbm": float(flight.exchanges.fpp1_dbm.min())}

def failing(flight):
    raise KeyError("no such figure")

def weaker(link, ends):
    return replace(link, power_dbm=link.power_dbm - 3.0)

def flight_ticks(spans):
    return (spans.dt41 - spans.dt32) / 2

def delay_weights(spans):
    return np.full_like(spans.dt41, 0.5), np.full_like(spans.dt41, 0.5)
"""


@pytest.fixture
def stranger(tmp_path, monkeypatch):
    """A module of a user, which other processes of this computer find on the same path."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    (folder / "stranger.py").write_text(STRANGER)
    monkeypatch.syspath_prepend(folder)
    yield importlib.import_module("stranger")
    del sys.modules["stranger"]


@pytest.mark.slow
def test_functions_of_a_stranger_reach_other_processes(tmp_path, stranger):
    """An evaluation, a protocol and an effect of the channel, with the same results as in this process."""
    own = {"flight_ticks": stranger.flight_ticks, "delay_weights": stranger.delay_weights}
    with registered(PROTOCOLS, replace(PROTOCOLS["ss"], name="mine", **own)):
        p = plan(tmp_path, CALIBRATE.replace('["ds"]', '["ss", "mine"]'))
        run_sweep(p, tmp_path / "without", workers=1, evaluate=stranger.figures)
        with registered(CHANNEL_EFFECTS, ChannelEffect("weaker", stranger.weaker)):
            for workers in (1, 2):
                run_sweep(p, tmp_path / str(workers), workers=workers, evaluate=stranger.figures)
    assert (tmp_path / "1" / "results.csv").read_bytes() == (tmp_path / "2" / "results.csv").read_bytes()
    counts = {
        name: [int(row["count"]) for row in rows(tmp_path / "2") if row["protocol"] == name] for name in ("ss", "mine")
    }
    assert counts["ss"] == counts["mine"]
    assert counts["ss"][1] == pytest.approx(2 * counts["ss"][0], abs=2)
    before, after = ([float(row["weakest_dbm"]) for row in rows(tmp_path / name)] for name in ("without", "2"))
    # Boards print powers of whole counts: at -97 dBm a step is 0.015 dB.
    np.testing.assert_allclose(np.subtract(before, after), 3.0, atol=0.03)


def test_errors_of_functions_fail_only_their_run(tmp_path, stranger):
    summary = run_sweep(plan(tmp_path, CALIBRATE), tmp_path / "out", workers=1, evaluate=stranger.failing)
    assert (summary.done, summary.failed) == (2, 2)
    assert {row["error"] for row in rows(tmp_path / "out")} == {"'no such figure'"}


def test_functions_that_other_processes_cannot_import_and_absent_ones_are_refused(tmp_path, stranger, monkeypatch):
    monkeypatch.setattr("uwbsim.sweep.design.entry_points", lambda **_: ())
    for text, more, said in (
        (
            (CALIBRATE,),
            {"workers": 2, "evaluate": lambda flight: {}},
            "`evaluate`: found <function .*lambda.* cannot import",
        ),
        ((CALIBRATE,), {"workers": 0, "evaluate": stranger.figures}, "`workers`: found 0"),
        ((), {"evaluate": stranger.figures}, "`evaluate`: can only be used with sweeps of flights"),
        ((CALIBRATE,), {"workers": 1}, ".*no installed distribution offers one"),
    ):
        with pytest.raises(ParameterError, match=f"^{said}"):
            run_sweep(plan(tmp_path, *text), tmp_path / "out", **more)
    assert not (tmp_path / "out").exists()


def test_folders_and_files_that_do_not_fit_are_refused(alone, tmp_path):
    p, out = alone
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").write_text("mine")
    for design, folder, resume, said in (
        (p, out, False, r"^`resume`: .* already contains results of this sweep"),
        (plan(tmp_path, name="other.toml"), out, True, r"another sweep, plan\.toml"),
        (plan(tmp_path, HEAD + "ranges = 3001\nseeds = 2\n" + GRID), out, True, "has changed"),
        (p, tmp_path / "new", True, "contains no sweep"),
        (p, tmp_path / "full", False, "other files"),
    ):
        with pytest.raises(ScenarioError, match=said):
            run_sweep(design, folder, workers=1, resume=resume)
    assert run_sweep(p, out, workers=1, resume=True).done == 0


def test_a_scheduler_that_does_not_answer_is_named(alone, tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    monkeypatch.setattr(Cluster, "connect_s", 1)
    with pytest.raises(UwbsimError, match=r"tcp://127.0.0.1:9 does not answer within 1 s"):
        run_sweep(alone[0], tmp_path / "out", scheduler="tcp://127.0.0.1:9")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "fragment"),
    [
        ("", "sweep: missing"),
        ("[sweep", "not valid TOML"),
        ("[swoop]", "swoop: unknown key"),
        ("[sweep]\n", "sweep.scenario"),
        (HEAD + "seed = 3\n", "did you mean seeds"),
        (HEAD + 'kind = "guess"\n', "sweep.kind: found 'guess'"),
        (HEAD + "ranges = 0\n", "sweep.ranges: found 0"),
        (HEAD + "seeds = -1\n", "seeds"),
        (HEAD + "seeds = 10000000000000000000\n", "seeds"),
        (HEAD.replace('["ss-cfo", "ds"]', "[[1]]"), "sweep.protocols"),
        (HEAD.replace('"ds"', '"tdoa"'), "tdoa"),
        (HEAD + '[vary]\n"ranging.rate_hz" = 5\n', "list of values"),
        (HEAD + '[vary]\n"ranging.rate_hertz" = [5]\n', "did you mean rate_hz"),
        (HEAD + '[vary]\n"tags.17.delay_ns" = [5]\n', "index"),
        (HEAD + 'design = "list"\n', "[[list]]"),
        (HEAD + 'design = "latin-hypercube"\n[vary]\n"ranging.rate_hz" = { low = 5, high = 1 }\n', "low below high"),
    ],
)
def test_wrong_sweeps_are_refused(tmp_path, text, fragment):
    with pytest.raises(ScenarioError, match=one_line(fragment)):
        plan(tmp_path, text)


# Sweeps during faults of computers: a damaged store, two sweeps in one folder, a scheduler that ends.


@pytest.fixture
def done(alone, tmp_path):
    p, out = alone
    shutil.copytree(out, tmp_path / "out")
    return p, tmp_path / "out"


def with_sql(statement):
    return lambda store: duckdb.connect(str(store)).execute(statement).close()


@pytest.mark.slow
@pytest.mark.parametrize(
    "damage",
    [
        lambda store: os.truncate(store, 20_000),
        lambda store: store.write_bytes(store.read_bytes()[:12_288] + os.urandom(store.stat().st_size - 12_288)),
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


@pytest.mark.slow
def test_two_sweeps_cannot_have_one_folder(done):
    p, out = done
    said = f"{out}/results.duckdb: another sweep writes its results there; give another folder"
    with ResultStore.open(out / "results.duckdb"):
        refuse("uwbsim", "sweep", p.path, "-o", out, "--workers", 1, "--resume", naming=[said], timeout=60)
    assert len(rows(out)) == 24


@pytest.mark.slow
def test_a_full_disk_ends_a_sweep_with_one_line_and_keeps_what_was_done(tmp_path):
    plan(tmp_path, HEAD + 'ranges = 100\n[vary]\n"radio.rx_noise_ps" = [0.0, 50.0]\n')
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are looked up in /proc")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_sweep_that_ends_early_leaves_no_worker_and_goes_on_where_it_was(tmp_path, number):
    p, out, words = plan(tmp_path, HEAD + "ranges = 4_000\nseeds = 8\n" + GRID), tmp_path / "out", tmp_path / "words"
    with words.open("w") as stream:
        command = [BIN / "uwbsim", "sweep", p.path, "-o", out, "--workers", "2"]
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


ENDS_WORKERS = """
import os, sys, time
if '--multiprocessing-fork' in sys.argv:
    os._exit(9)
from concurrent.futures import process

close = process._ThreadWakeup.close
def close_late(pipe):
    time.sleep(2)
    close(pipe)
def wake(pipe):
    if not pipe._closed:
        time.sleep(3 * process._global_shutdown)
        pipe._writer.send_bytes(b'')
process._ThreadWakeup.close, process._ThreadWakeup.wakeup = close_late, wake
"""


@pytest.mark.slow
def test_a_worker_that_dies_as_it_begins_is_one_line(tmp_path):
    """An installed module may end a process that imports it, as may a lack of memory.

    On a busy machine the pool still closes its pipe while the command ends.
    """
    (tmp_path / "p.toml").write_text(ENDLESS)
    (tmp_path / "sitecustomize.py").write_text(ENDS_WORKERS)
    env = os.environ | {"PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    words = [str(BIN / "uwbsim"), "sweep", "p.toml", "-o", "out", "--workers", "2"]
    done = subprocess.run(words, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "--workers" in done.stderr
    assert not (tmp_path / "out").exists()
