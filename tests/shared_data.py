"""Recordings beside the checkout; tests that use them skip with a message if they are absent."""

import os
import tarfile
from csv import DictReader
from io import TextIOWrapper
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDER = Path(os.environ.get("UWBCAL_DATA", ROOT.parent / "shared" / "data"))


def shared(name):
    path = FOLDER / name
    if not path.exists():
        pytest.skip(f"{name} is not in the data folder beside this checkout (or set UWBCAL_DATA)")
    return path


def rows_of(name, ending):
    """Return the rows, by their headers, of all tables of an archive whose names have a given end."""
    with tarfile.open(shared(name)) as archive:
        # In the order of the archive, which is then decompressed once.
        return [
            row
            for member in archive
            if member.name.endswith(ending) and (file := archive.extractfile(member))
            for row in DictReader(TextIOWrapper(file))
        ]


def miluv(folder):
    """Unpack MILUV's flight among obstacles into a folder; return its path."""
    with tarfile.open(shared("miluv_cirObstacles_3_random_0.tar.xz")) as archive:
        archive.extractall(folder, filter="data")
    return folder / "cirObstacles_3_random_0"
