"""Folders that commands write into."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Final

from uwblink.output import check_output
from uwbsim.errors import ScenarioError

__all__: Final = ["check_folder"]


def check_folder(path: Path, names: Iterable[str] = (), *, force: bool = False) -> None:
    """Raise `ScenarioError` where a folder can neither be used nor made.

    `names` are files to be written there: raises what `check_output` raises for those.
    """
    if path.exists() and not path.is_dir():
        raise ScenarioError(f"{path}: is a file, expected a folder")
    if not path.parent.is_dir():
        raise ScenarioError(f"{path}: {path.parent} does not exist")
    for name in names if path.is_dir() else ():
        check_output(path / name, force=force)
