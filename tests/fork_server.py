"""Runs the three commands in forks of a process that has imported everything: `python -m tests.fork_server`.

A command takes 0.4 s to import what it needs and often less to do its work, and the suite calls hundreds. Here each is
still a process of its own, with its own memory, working folder, environment, output and exit status.

Requests are lines of JSON on standard input (`argv`, `cwd`, `env`, `out`, `err`); answers are the process id of the
fork, and when it has ended its exit status, a line each.
"""

from __future__ import annotations

import atexit
import gc
import importlib
import json
import os
import pkgutil
import sys
import threading
import traceback
from typing import Any, Final

PACKAGES: Final = ("uwblink", "uwbsim", "calib")
LIBRARIES: Final = ("matplotlib.backends.backend_agg", "matplotlib.backends.backend_svg", "matplotlib.figure")


def preload() -> None:
    """Import all of the three packages, and what draws; what an extra brings may lack."""
    for name in LIBRARIES:
        importlib.import_module(name)
    for name in PACKAGES:
        package = importlib.import_module(name)
        for module in pkgutil.walk_packages(package.__path__, f"{name}."):
            if module.name.endswith("__main__"):
                continue
            try:
                importlib.import_module(module.name)
            except ModuleNotFoundError as error:
                if (error.name or "").split(".")[0] in PACKAGES:
                    raise


def run_in_fork(request: dict[str, Any]) -> int:
    """Fork, and run a command in the child; returns its process id to the parent."""
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        _take_over(request)
        status = _call(request["argv"])
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _take_over(request: dict[str, Any]) -> None:
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    for descriptor, path, flags in (
        (0, os.devnull, os.O_RDONLY),
        (1, request["out"], os.O_WRONLY),
        (2, request["err"], os.O_WRONLY),
    ):
        opened = os.open(path, flags)
        os.dup2(opened, descriptor)
        os.close(opened)
    os.closerange(3, 64)
    sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115 - it is the process's own


def _call(argv: list[str]) -> int:
    """Call a command as its script does: it is the main module, of no package."""
    sys.argv = argv
    own = sys.modules["__main__"]
    own.__package__, own.__spec__, own.__file__ = "", None, argv[0]
    main = importlib.import_module(f"{os.path.basename(argv[0])}.cli").main
    try:
        main()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    finally:
        threading._shutdown()  # type: ignore[attr-defined]
        atexit._run_exitfuncs()
    return 0


def main() -> None:
    """Answer requests until standard input ends."""
    answers = os.dup(1)
    os.dup2(2, 1)  # what imports might print is no answer
    preload()
    gc.collect()
    gc.freeze()
    for line in sys.stdin:
        pid = run_in_fork(json.loads(line))
        os.write(answers, b"%d\n" % pid)
        _, how = os.waitpid(pid, 0)
        os.write(answers, b"%d\n" % os.waitstatus_to_exitcode(how))


if __name__ == "__main__":
    main()
