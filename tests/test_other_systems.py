"""Commands on systems without features of Linux: pseudo-terminals, POSIX file locks, signal masks."""

import os
import subprocess
import sys

import pytest

from tests.shared_data import ROOT

# Libraries are imported before: their own variants for other systems are not tested here.
WITHOUT = """
import os, signal, sys
import duckdb, matplotlib.figure, multiprocessing, numpy, scipy.sparse.linalg, serial, serial.tools.list_ports, simpy
import shutil, subprocess, tempfile

sys.modules.update(dict.fromkeys(("fcntl", "grp", "pty", "pwd", "resource", "termios", "tty")))
for module, names in (
    (signal, ("SIGALRM", "SIGHUP", "SIGKILL", "SIGPIPE", "pthread_kill", "pthread_sigmask", "setitimer")),
    (os, ("O_NOFOLLOW", "O_NONBLOCK", "fchmod", "fork", "getuid", "mkfifo", "openpty", "sched_getaffinity")),
):
    for name in names:
        delattr(module, name)

import calib.cli, uwblink.cli, uwbsim.cli

for line in sys.argv[1:]:
    sys.argv = line.split()
    try:
        {"calib": calib, "uwblink": uwblink, "uwbsim": uwbsim}[sys.argv[0]].cli.main()
    except SystemExit as end:
        print(end.code or 0, line, flush=True)
"""


@pytest.mark.slow
def test_all_but_virtual_boards_works_without_what_linux_has(tmp_path):
    lines = {
        "calib sample -o flight.uwb": 0,
        "calib fit flight.uwb -o c.json": 0,
        "calib apply flight.uwb -c c.json -o corrected.uwb": 0,
        "uwblink show corrected.uwb": 0,
        "uwblink export corrected.uwb --to csv -o tables": 0,
        "uwbsim run icra2023/test1 -o simulated.uwb --set run.duration_s=1": 0,
        "uwbsim serve icra2023/test1": 2,
    }
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT, *lines],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert [line for line in done.stdout.splitlines() if line.partition(" ")[2] in lines] == [
        f"{status} {line}" for line, status in lines.items()
    ], done.stderr
    warning, error = done.stderr.splitlines()
    assert warning.startswith("warning: 3 pairs are just enough to determine the delays")
    assert error == "error: this system has no pseudo-terminals; use Linux or macOS"
