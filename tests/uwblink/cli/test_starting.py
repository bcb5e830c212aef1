"""What a command does before anything is imported for it."""

import os
import signal
import subprocess
import sys

import pytest

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
def test_linear_algebra_takes_one_thread_unless_asked_for_more(asked, threads):
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


def test_a_command_that_is_done_keeps_its_status_when_it_is_interrupted():
    done = subprocess.run([sys.executable, "-c", INTERRUPTED_AT_THE_END], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


STUCK = """
import os, signal, sys, time
import typer
from uwblink.cli.shared import run

app = typer.Typer()

@app.command()
def wait():
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(10)
    finally:  # cleaning up, which the second signal leaves alone and the third one ends
        os.kill(os.getpid(), signal.SIGINT)
        print("cleaned", flush=True)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(10)

run(app, arguments=[])
"""


def test_a_third_interrupt_ends_a_command_that_hangs():
    done = subprocess.run([sys.executable, "-c", STUCK], capture_output=True, text=True, timeout=9)
    assert (done.returncode, done.stdout) == (-signal.SIGINT, "cleaned\n")


IMPORTED = """
import os, signal, weakref

class Lock:
    pass

# As the import system has it: an exception in a weak reference's callback is printed and dropped.
lock = Lock()
reference = weakref.ref(lock, lambda _: os.kill(os.getpid(), signal.SIGINT))
del lock
"""


def test_an_interrupt_during_an_import_is_not_dropped(tmp_path):
    (tmp_path / "imported.py").write_text(IMPORTED)
    command = (
        STUCK.split("app =")[0]
        + """
app = typer.Typer()

@app.command()
def work():
    import imported
    time.sleep(10)
    print("went on")

run(app, arguments=[])
"""
    )
    done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, timeout=9, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")
