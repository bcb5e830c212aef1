"""Commands in processes that are forked from one which has imported everything: as users run them, without the wait."""

from __future__ import annotations

import contextlib
import io
import multiprocessing
import os
import resource
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

MODULES = ["uwblink.cli", "uwbsim.cli", "calib.cli", "calib.report", "uwblink.pages.pdf", "uwbsim.twins"]
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload([__name__, *MODULES])


class Ended(NamedTuple):
    """How a command ended, and what it printed."""

    status: int | str | None
    out: str
    err: str


def run(*words: Any, folder: Path | None = None, most_bytes: int | None = None, user: int | None = None) -> Ended:
    """Run a command in a process of its own, in `folder`.

    No file that it writes may be longer than `most_bytes`, as on a full disk; `user` takes its rights away.
    """
    ours, theirs = CONTEXT.Pipe()
    process = CONTEXT.Process(target=_work, args=(theirs, [str(w) for w in words], folder, most_bytes, user))
    process.start()
    theirs.close()
    try:
        return Ended(*ours.recv())
    finally:
        process.join(60)


def _work(pipe: Connection, words: list[str], folder: Path | None, most_bytes: int | None, user: int | None) -> None:
    if folder is not None:
        os.chdir(folder)
    if most_bytes is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))
    if user is not None:
        os.seteuid(user)
    pipe.send(call(_main(words[0]), words))


def _main(name: str) -> Callable[[], object]:
    import calib.cli
    import uwblink.cli
    import uwbsim.cli

    return {"uwblink": uwblink.cli.main, "uwbsim": uwbsim.cli.main, "calib": calib.cli.main}[name]


def call(main: Callable[[], object], words: list[str]) -> tuple[int | str | None, str, str]:
    """Call a command's function with words; returns its status, and what it printed. An exception is its own status."""
    printed, errors = io.StringIO(), io.StringIO()
    status: int | str | None = 0
    sys.argv = words
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(errors):
        try:
            main()
        except SystemExit as end:
            status = end.code
        except BaseException as error:
            status = f"{type(error).__name__}: {error}"
    return status or 0, printed.getvalue(), errors.getvalue()
