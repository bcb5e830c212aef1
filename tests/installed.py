"""The installation of a pip user: the wheel in an empty environment, and the commands of the README, without a
checkout.

`python -m tests.installed [FOLDER]` builds the wheel and installs it with the dependencies that pip chooses. It prints
the time of each step, and the size of the environment.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

from tests import pages
from tests.builds import built

FIRST: Final = (
    "uwbsim --version",
    "uwbsim scenarios",
    "uwbsim run icra2023/test1 -o short.uwb --set run.duration_s=5",
    "uwblink show short.uwb",
    "calib sample -o sample.uwb",
    "calib fit sample.uwb -o sample.json",
    "uwbsim schema",
)


def timed(what: str, command: list[str], cwd: Path, path: str) -> None:
    """Run a command, and print its time; raises `SystemExit` with its output if it fails."""
    begun = time.monotonic()
    # The environment must not lead to a checkout.
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}
    done = subprocess.run(command, cwd=cwd, env=clean | {"PATH": path}, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{what}: status {done.returncode}\n{done.stdout}{done.stderr}")
    print(f"{time.monotonic() - begun:7.1f} s  {what}", flush=True)


def size_mb(folder: Path) -> float:
    """Return the size of the files in a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink()) / 1e6


def main(folder: Path) -> int:
    """Build, install, and run all commands in a folder."""
    wheel, _ = built(folder / "dist")
    environment, work = folder / "env", folder / "work"
    work.mkdir()
    path = f"{environment / 'bin'}{os.pathsep}{os.environ['PATH']}"
    timed("an empty environment", [sys.executable, "-m", "venv", str(environment)], folder, path)
    before = size_mb(environment)
    python = str(environment / "bin" / "python")
    timed("pip install of the wheel", [python, "-m", "pip", "install", "--quiet", str(wheel)], folder, path)
    print(f"{size_mb(environment) - before:7.0f} MB in {environment.name} beyond pip itself")
    blocks = (block for block in pages.blocks(pages.ROOT / "README.md") if block.language == "sh")
    for line in [*FIRST, "uwbsim scenarios -o scenarios", *(line for b in blocks for line in pages.lines(b.code))]:
        timed(line, shlex.split(line), work, path)
    return 0


if __name__ == "__main__":
    if len(sys.argv) > 1:
        place = Path(sys.argv[1]).resolve()
        place.mkdir(parents=True, exist_ok=True)
        sys.exit(main(place))
    with tempfile.TemporaryDirectory() as temporary:
        sys.exit(main(Path(temporary)))
