"""Folders that commands write into."""

from __future__ import annotations

from pathlib import Path

from uwbsim.errors import ScenarioError


def check_folder(path: Path) -> None:
    """Raise `ScenarioError` where a folder can neither be used nor made."""
    if path.exists() and not path.is_dir():
        raise ScenarioError(f"{path}: is a file, expected a folder")
    if not path.parent.is_dir():
        raise ScenarioError(f"{path}: {path.parent} does not exist")
