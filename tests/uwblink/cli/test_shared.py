"""Functions of the three commands: errors as one line, statuses, warnings of plug-ins, flags for parameters."""

import io
import os
import re
import signal
import subprocess
import sys
import warnings

import numpy as np
import pytest

import uwblink
from tests.processes import wait_until
from uwblink.cli import shared


class MineError(Exception):
    """An error of another package."""


class WorseError(MineError):
    """An error with its own status."""


def run_as_command(work, *errors, **how):
    """Run a function as the only command of an app."""
    app = shared.new_app("Try.")
    app.command("work")(work)
    shared.run(app, *errors, arguments=["work"], **how)


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (None, 0, ""),
        (
            uwblink.errors.RecordingError("f.uwb: exists; or `force` and `map_file`"),
            2,
            "error: f.uwb: exists; or --force and --map\n",
        ),
        (MineError("mine"), 2, "error: mine\n"),
        (WorseError("worse"), 1, "error: worse\n"),
        (MineError("a\nb\x1b[31m \ud800"), 2, "error: a\\nb\\x1b[31m \\ud800\n"),
        (OSError(36, "File name too long", "aaa"), 2, "error: aaa: File name too long\n"),
        (MemoryError(), 2, "error: not enough memory; nothing was written\n"),
    ],
)
def test_an_error_is_one_line_and_a_status(error, code, line, capsys):
    def fail() -> None:
        if error:
            raise error

    with pytest.raises(SystemExit) as end:
        run_as_command(fail, MineError, statuses={WorseError: 1})
    assert (end.value.code, capsys.readouterr().err) == (code, line)


def test_infinite_results_are_errors(capsys):
    def fail() -> None:
        print((np.array([1e300]) * 1e300)[0])

    with warnings.catch_warnings(), pytest.raises(SystemExit) as end:
        warnings.simplefilter("default")
        run_as_command(fail)
    out, err = capsys.readouterr()
    told = err.startswith("error: numbers are too large for the computation (overflow")
    assert (end.value.code, out, told) == (2, "", True)


def test_unexpected_errors_are_raised():
    def fail() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run_as_command(fail)


def test_only_warnings_of_plug_ins_become_lines(capsys):
    def warn() -> None:
        warnings.simplefilter("always")
        warnings.warn("left out", uwblink.errors.PluginWarning, stacklevel=1)
        warnings.warn("other", UserWarning, stacklevel=1)

    with pytest.warns(UserWarning, match="other") as caught, pytest.raises(SystemExit):
        run_as_command(warn)
    assert ([str(w.message) for w in caught], capsys.readouterr().err) == (["other"], "warning: left out\n")


@pytest.mark.parametrize("package", ["uwblink", "uwbsim", "calib"])
def test_python_m_is_the_command(package):
    found = subprocess.run([sys.executable, "-m", package, "--version"], capture_output=True, text=True, check=True)
    first, beside = found.stdout.splitlines()
    assert first == f"{package} {uwblink.__version__}"
    assert re.fullmatch(r"Python 3\.[0-9.]+, numpy [0-9.]+, .*duckdb [0-9.]+, .*", beside)


# Actions of a command before its imports.


THREADS = """
from uwblink.cli import start

def command():
    import numpy
    from threadpoolctl import threadpool_info
    print(*(library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"))

start(command)
"""


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="on one core linear algebra has one thread anyway")
@pytest.mark.parametrize(("asked", "threads"), [(None, "1"), ("2", "2")])
def test_linear_algebra_uses_one_thread_by_default(asked, threads):
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    if asked:
        environment |= {"OPENBLAS_NUM_THREADS": asked, "MKL_NUM_THREADS": asked}
    done = subprocess.run([sys.executable, "-c", THREADS], capture_output=True, text=True, env=environment, check=True)
    assert set(done.stdout.split()) == {threads}


INTERRUPTED_AT_THE_END = """
import atexit, os, signal
from uwblink.cli import start

def command():
    # Registered first, so called last: when the command has ended and its files are written.
    atexit.register(os.kill, os.getpid(), signal.SIGINT)

start(command)
"""


STUCK = """
import os, signal, sys, time
import typer
from uwblink.cli.shared import run

app = typer.Typer()

@app.command()
def wait():
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(100)
    finally:  # cleaning up, which the second signal leaves alone and the third one ends
        os.kill(os.getpid(), signal.SIGINT)
        print("cleaned", flush=True)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(100)

run(app, arguments=[])
"""


IMPORTED = """
import os, signal, weakref

class Lock:
    pass

# As the import system has it: an exception in a weak reference's callback is printed and dropped.
lock = Lock()
reference = weakref.ref(lock, lambda _: os.kill(os.getpid(), signal.SIGINT))
del lock
"""


IMPORTING = f"""
{STUCK.split("app =")[0]}
app = typer.Typer()

@app.command()
def work():
    import imported
    time.sleep(100)
    print("went on")

run(app, arguments=[])
"""


@pytest.mark.parametrize(
    ("script", "status", "out", "err"),
    [
        pytest.param(INTERRUPTED_AT_THE_END, 0, "", "", id="a finished command keeps its status"),
        pytest.param(STUCK, -signal.SIGINT, "cleaned\n", "", id="the third ends a command that hangs"),
        pytest.param(IMPORTING, 130, "", "interrupted\n", id="one during an import is not dropped"),
    ],
)
def test_interrupts(tmp_path, script, status, out, err):
    (tmp_path / "imported.py").write_text(IMPORTED)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=90, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (status, out, err)


# The progress line of a command.


def test_progress_on_a_terminal_is_shown_and_removed(monkeypatch):
    screen = io.StringIO()
    monkeypatch.setattr(screen, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stderr", screen)
    with shared.waiting("fitting [1]") as update:
        update("drawing")
        update(0.25)
        wait_until(lambda: all(shown in screen.getvalue() for shown in ("fitting [1]", "drawing", "25%")))
    assert screen.getvalue().endswith("\x1b[2K")


def test_progress_is_not_shown_elsewhere(capsys):
    with shared.waiting("fitting") as update:
        update(0.5)
    assert capsys.readouterr() == ("", "")
