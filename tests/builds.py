"""Wheel and sdist of this tree, built by the backend that pyproject.toml names."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def built(folder: Path, *, of: Path = ROOT) -> list[Path]:
    """Build wheel and sdist of a tree into a folder; return both, the wheel first."""
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-d", folder, "-t", "sdist", "-t", "wheel"],
        cwd=of,
        env={"SOURCE_DATE_EPOCH": "1577836800"} | os.environ,
        check=True,
        capture_output=True,
    )
    return sorted(folder.iterdir(), key=lambda path: path.suffix != ".whl")
