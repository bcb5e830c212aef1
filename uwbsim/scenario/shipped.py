"""Scenarios that come with the package: found by name, listed, copied."""

from __future__ import annotations

import difflib
import os
import re
import tomllib
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from types import MappingProxyType
from typing import Final

from uwblink.output import made_folder, whole
from uwbsim.errors import ScenarioError

SUFFIX: Final = ".toml"
LINKED: Final = re.compile(r'file\s*=\s*"([^"\n]+)"')


def shipped_scenarios() -> Mapping[str, Path]:
    """Return the scenarios that come with the package: their files by name, in order of names.

    `load`, `preview`, `show` and all commands take the names, too.

    >>> import uwbsim
    >>> "icra2023/train" in uwbsim.shipped_scenarios()
    True
    >>> uwbsim.load("icra2023/train").run.duration_s
    240.0
    """
    folder = _folder()
    named = {path.relative_to(folder).with_suffix("").as_posix(): path for path in folder.rglob(f"*{SUFFIX}")}
    return MappingProxyType(dict(sorted(named.items())))


def _folder() -> Path:
    """Return the folder beside the package's modules, where a wheel puts it, or at the top of a checkout."""
    package = Path(__file__).parents[1]
    inside = package / "scenarios"
    return inside if inside.is_dir() else package.parent / "scenarios"


def found(path: Path) -> Path:
    """Return the file of a shipped scenario by its name, as in icra2023/train; another path as it is.

    A file that is there goes before a name.
    """
    if os.path.exists(path) or path.is_absolute():  # False, where Path.exists raises: for want of permission
        return path
    return shipped_scenarios().get(path.as_posix().removesuffix(SUFFIX), path)


def nearest(path: Path) -> str:
    """Return `, did you mean ...?` with the shipped scenarios that a path could stand for; nothing where none is."""
    plain, known = path.as_posix().removesuffix(SUFFIX), list(shipped_scenarios())
    parts = [name for name in known if plain in name.split("/")]
    near = [] if os.path.lexists(path) else parts or difflib.get_close_matches(plain, known, 2)
    return f", did you mean {' or '.join(near)}?" if near else ""


def title(path: Path) -> str:
    """Return what a scenario is about: the first sentence of the comment that it begins with, else its run's name."""
    head = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        head.append(line.lstrip("# "))
    sentence = re.split(r"(?<=[.:])\s", " ".join(head))[0].rstrip(".:")
    return sentence or str(tomllib.loads(path.read_text(encoding="utf-8"))["run"].get("name", ""))


def listed(names: Iterable[str] = ()) -> dict[str, str]:
    """Return what shipped scenarios are about, by name; raises what `copy_scenarios` raises for `names`."""
    return {name: title(path) for name, path in _chosen(list(names)).items()}


def copy_scenarios(names: Iterable[str], folder: Path, *, force: bool = False) -> list[Path]:
    """Copy shipped scenarios, and the files that they name, into a folder, in the places where they lie beside another.

    `names` are those of `shipped_scenarios`, or of their folders; none are all. Returns what was written. Raises
    `ScenarioError` for a name that is not there, with nothing written, and what `whole` raises.
    """
    top = _folder().resolve()
    chosen = _chosen(list(names)).values()
    files = dict.fromkeys([*(path.resolve() for path in chosen), *(one for path in chosen for one in _linked(path))])
    places = {path: folder / path.relative_to(top) for path in files}
    with ExitStack() as every:
        for path, place in places.items():
            every.enter_context(made_folder(place.parent))
            every.enter_context(whole(place, force=force)).write_bytes(path.read_bytes())
    return [*places.values()]


def _chosen(names: list[str]) -> Mapping[str, Path]:
    known = shipped_scenarios()
    chosen: dict[str, Path] = {}
    for name in names:
        plain = name.removesuffix(SUFFIX).rstrip("/")
        some = {other: path for other, path in known.items() if other == plain or other.startswith(f"{plain}/")}
        if not some:
            raise ScenarioError(f"{name}: no such scenario; known are {', '.join(known)}")
        chosen |= some
    return chosen if names else known


def _linked(path: Path) -> list[Path]:
    names = LINKED.findall(path.read_text(encoding="utf-8"))
    return [(path.parent / name).resolve() for name in names]
