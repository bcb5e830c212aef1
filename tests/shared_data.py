"""Recordings that live beside the checkout, not in it; tests that use them skip, and say so, where they are absent."""

import os
import tarfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDER = Path(os.environ.get("UWBCAL_DATA", ROOT.parent / "shared" / "data"))


def shared(name):
    path = FOLDER / name
    if not path.exists():
        pytest.skip(f"{name} is not in the data folder beside this checkout (or set UWBCAL_DATA)")
    return path


def miluv(folder):
    """Unpack MILUV's flight among obstacles into a folder; returns where it is."""
    with tarfile.open(shared("miluv_cirObstacles_3_random_0.tar.xz")) as archive:
        archive.extractall(folder, filter="data")
    return folder / "cirObstacles_3_random_0"
