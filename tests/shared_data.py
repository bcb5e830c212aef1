"""Recordings that live beside the checkout, not in it; tests that use them skip, and say so, where they are absent."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDER = Path(os.environ.get("UWBCAL_DATA", ROOT.parent / "shared" / "data"))


def shared(name):
    path = FOLDER / name
    if not path.exists():
        pytest.skip(f"{name} is not in the data folder beside this checkout (or set UWBCAL_DATA)")
    return path
