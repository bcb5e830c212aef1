"""Run `uwblink`, `uwbsim` and `calib` in the process of the tests, or in a fork of one that has imported everything.

A command takes 0.4 s for its imports and often less for its work, and the tests run hundreds.
"""

from __future__ import annotations

import atexit
import contextlib
import importlib
import io
import multiprocessing
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any
from unittest import mock

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(
    [__name__, "matplotlib.backends.backend_agg", "matplotlib.backends.backend_svg", "matplotlib.figure"]
    + [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for name in ("uwblink", "uwbsim", "calib")
        for path in sorted((ROOT / name).rglob("*.py"))
        if path.stem not in ("__main__", "__init__")
    ]
    + ["tests.frozen"]
)


def run(*words: object, cwd: str | os.PathLike[str] | None = None, **how: Any) -> subprocess.CompletedProcess[str]:
    """Run a command like `subprocess.run` with captured text; its first word is the name of the command.

    It runs in this process unless `how` has arguments of `fork`.
    """
    if how:
        return fork(*words, cwd=cwd, **how)
    argv, out, err = list(map(str, words)), io.StringIO(), io.StringIO()
    printed = contextlib.redirect_stdout(out), contextlib.redirect_stderr(err)
    caught = warnings.catch_warnings(action="default")
    # The module that runs the tests would give the command its name (`python -m pytest`).
    named = mock.patch.object(sys, "argv", argv), mock.patch.object(sys.modules["__main__"], "__package__", None)
    with contextlib.chdir(cwd or Path.cwd()), printed[0], printed[1], caught, named[0], named[1]:
        status = _status(argv[0])
    return subprocess.CompletedProcess(argv, status, out.getvalue(), err.getvalue())


def fork(
    *words: object,
    cwd: str | os.PathLike[str] | None = None,
    env: Mapping[str, str] | None = None,
    timeout: float | None = None,
    most_bytes: int | None = None,
    limits: Mapping[int, int] | None = None,
    user: int | None = None,
) -> subprocess.CompletedProcess[str]:
    """Run a command like `run`, in a separate process.

    `env` is the whole environment; of variables that act during imports, only PYTHONPATH has an effect. No file that
    the command writes may be longer than `most_bytes`, as on a full disk; `limits` are other limits of `resource`.
    `user` removes the rights of root.
    """
    argv = [str(BIN / str(words[0])), *map(str, words[1:])]
    limits = dict(limits or {}) | ({} if most_bytes is None else {resource.RLIMIT_FSIZE: most_bytes})
    with tempfile.TemporaryDirectory() as folder:
        printed = [Path(folder) / name for name in ("out", "err")]
        settings = (str(cwd or Path.cwd()), dict(os.environ if env is None else env), limits, user)
        process = CONTEXT.Process(target=_work, args=(argv, [*map(str, printed)], *settings))
        process.start()
        process.join(timeout)
        if process.exitcode is None:
            process.kill()
            process.join()
            raise subprocess.TimeoutExpired(argv, timeout or 0.0, *(path.read_bytes() for path in printed))
        return subprocess.CompletedProcess(argv, process.exitcode, *(path.read_text("utf-8") for path in printed))


def succeed(*words: object, **how: Any) -> subprocess.CompletedProcess[str]:
    """Run a command that must end with status 0."""
    ended = run(*words, **how)
    assert ended.returncode == 0, ended
    return ended


def refuse(*words: object, naming: Iterable[object] = (), status: int = 2, **how: Any) -> str:
    """Run a command that must print only one line of error, which contains every text of `naming`; return the line."""
    ended = run(*words, **how)
    assert (ended.returncode, ended.stdout, ended.stderr.count("\n")) == (status, "", 1), ended
    assert ended.stderr.startswith("error: "), ended
    for text in naming:
        assert str(text) in ended.stderr, ended
    return ended.stderr


def wait_until(
    ready: Callable[[], object], process: subprocess.Popen[Any] | None = None, *, step_s: float = 0.01
) -> None:
    """Wait for an effect of another thread, or of a process that goes on; two minutes, because of other load."""
    end_s = time.monotonic() + 120.0
    while not ready():
        assert process is None or process.poll() is None, process.communicate()
        assert time.monotonic() < end_s
        time.sleep(step_s)


def _work(
    argv: list[str], printed: list[str], cwd: str, env: dict[str, str], limits: dict[int, int], user: int | None
) -> None:
    """Become a command: its folder, environment, output and limits; end the process with its status."""
    for descriptor, path in enumerate([os.devnull, *printed]):
        opened = os.open(path, os.O_CREAT | os.O_WRONLY if descriptor else os.O_RDONLY, 0o600)
        os.dup2(opened, descriptor)
        os.close(opened)
    sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115 - it is the process's own
    if resource.RLIMIT_FSIZE in limits:
        # Python would keep a compiled module that it could write only partly. Text is kept until the limit is removed.
        sys.dont_write_bytecode = True
        sys.stdout, sys.stderr = io.StringIO(), io.StringIO()
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(env)
    sys.path[:0] = filter(None, env.get("PYTHONPATH", "").split(os.pathsep))
    status = 1
    try:
        if user is not None:
            os.seteuid(user)
        _limit(limits)
        status = _call(argv)
    except BaseException:
        traceback.print_exc()
    finally:
        # Coverage writes its own file at exit, on a disk with space.
        _limit(dict.fromkeys(limits, resource.RLIM_INFINITY))
        atexit._run_exitfuncs()
        for descriptor, stream in enumerate((sys.stdout, sys.stderr), 1):
            stream.flush()
            if isinstance(stream, io.StringIO):
                os.write(descriptor, stream.getvalue().encode())
        os._exit(status)


def _limit(limits: Mapping[int, int]) -> None:
    """Set limits of this process, which it may raise again to the previous ones."""
    for kind, most in limits.items():
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (hard if most == resource.RLIM_INFINITY else most, hard))


def _call(argv: list[str]) -> int:
    """Call a command as its script does: it is the main module, without a package."""
    sys.argv = argv
    own: Any = sys.modules["__main__"]
    own.__package__, own.__spec__, own.__file__ = "", None, argv[0]
    try:
        return _status(os.path.basename(argv[0]))
    finally:
        threading._shutdown()  # type: ignore[attr-defined]


def _status(name: str) -> int:
    """Call the main function of a command; return the status with which it exits."""
    try:
        importlib.import_module(f"{name}.cli").main()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0
