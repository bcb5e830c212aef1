"""Runs `uwblink`, `uwbsim` and `calib` as processes of their own, without their importing anything anew."""

from __future__ import annotations

import atexit
import functools
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]
BIN = Path(sys.executable).parent


class ForkServer:
    """A process of `tests.fork_server`, and what asks it."""

    def __init__(self) -> None:
        """Begin to import; the first answer waits for that."""
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.fork_server"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=ROOT
        )

    def call(self, request: dict[str, object], timeout: float | None) -> int:
        """Return the exit status of a command; raises `TimeoutError`, and ends it, when it takes too long."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(request).encode() + b"\n")
        self._process.stdin.flush()
        pid = self._answer(None)
        try:
            return self._answer(timeout)
        except TimeoutError:
            os.kill(pid, signal.SIGKILL)
            self._answer(None)
            raise

    def _answer(self, timeout: float | None) -> int:
        assert self._process.stdout is not None
        descriptor, line = self._process.stdout.fileno(), b""
        end = None if timeout is None else time.monotonic() + timeout
        while not line.endswith(b"\n"):
            left = None if end is None else max(end - time.monotonic(), 0.0)
            if not select.select([descriptor], [], [], left)[0]:
                raise TimeoutError
            byte = os.read(descriptor, 1)
            if not byte:
                raise RuntimeError(f"the server of forks ended with {self._process.wait()}")
            line += byte
        return int(line)

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.communicate()


@functools.cache
def _server() -> ForkServer:
    server = ForkServer()
    atexit.register(server.close)
    return server


def run(
    *words: object,
    cwd: str | os.PathLike[str] | None = None,
    env: Mapping[str, str] | None = None,
    timeout: float | None = None,
) -> subprocess.CompletedProcess[str]:
    """Run a command as `subprocess.run` does with captured text, its first word the name of the command.

    `env` is the whole environment. What is set there for the time of importing has no effect.
    """
    argv = [str(BIN / str(words[0])), *map(str, words[1:])]
    with tempfile.TemporaryDirectory() as folder:
        out, err = (Path(folder) / name for name in ("out", "err"))
        out.touch()
        err.touch()
        request: dict[str, object] = {
            "argv": argv,
            "cwd": str(cwd or Path.cwd()),
            "env": dict(os.environ if env is None else env),
            "out": str(out),
            "err": str(err),
        }
        try:
            status = _server().call(request, timeout)
        except TimeoutError:
            raise subprocess.TimeoutExpired(argv, timeout or 0.0, out.read_bytes(), err.read_bytes()) from None
        return subprocess.CompletedProcess(argv, status, out.read_text("utf-8"), err.read_text("utf-8"))
