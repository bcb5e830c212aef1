"""Says what commands have loaded when they end: `python -m tests.loaded_modules [MODULE...]`.

Requests are lines of JSON on standard input: `commands`, each its words, `folder` to run in, and the modules `watched`.
They run one after the other in a fork of this process, which has imported the three apps, what typer reads options
with, and the modules given; the answer is a line with, for each, its status, what it printed, and the modules seen.
"""

from __future__ import annotations

import importlib.util
import io
import json
import os
import sys
import traceback
from contextlib import redirect_stderr, redirect_stdout
from typing import Any, Final

PACKAGES: Final = ("uwblink", "uwbsim", "calib")
READERS: Final = ("typer._adapters",)
"""What typer reads options with, in the versions that have it apart."""


def _run(words: list[str], watched: set[str]) -> dict[str, Any]:
    printed, status = io.StringIO(), 0
    if not words:
        return {"status": 0, "printed": "", "loaded": sorted(watched & set(sys.modules))}
    sys.argv = words
    with redirect_stdout(printed), redirect_stderr(printed):
        try:
            importlib.import_module(f"{words[0]}.cli").main()
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else int(end.code is not None)
        except Exception:
            status = 1
            traceback.print_exc()
    return {"status": status, "printed": printed.getvalue(), "loaded": sorted(watched & set(sys.modules))}


def _child(request: dict[str, Any], answer: int) -> None:
    """Run in a fork, and end it."""
    try:
        os.chdir(request["folder"])
        watched = set(request["watched"])
        found = [_run(words, watched) for words in request["commands"]]
        with open(answer, "w", encoding="utf-8") as pipe:
            pipe.write(json.dumps(found))
    finally:
        os._exit(0)


def main() -> None:
    """Answer requests until standard input ends."""
    readers = (name for name in READERS if importlib.util.find_spec(name))
    for name in (*(f"{package}.cli.commands" for package in PACKAGES), *readers, *sys.argv[1:]):
        importlib.import_module(name)
    for line in sys.stdin:
        ours, theirs = os.pipe()
        pid = os.fork()
        if not pid:
            _child(json.loads(line), theirs)
        os.close(theirs)
        with open(ours, encoding="utf-8") as pipe:
            print(pipe.read() or "[]", flush=True)
        os.waitpid(pid, 0)


if __name__ == "__main__":
    main()
