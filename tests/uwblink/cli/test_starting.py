"""What a command does before anything is imported for it."""

import os
import subprocess
import sys

import pytest

THREADS = """
from uwblink.cli.starting import start

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
