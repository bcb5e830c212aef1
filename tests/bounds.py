"""Dependencies at the ends of their ranges: `python -m tests.bounds lowest|newest` prints requirements for pip.

`lowest` are the lowest versions in pyproject.toml, `newest` the newest versions.
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path
from typing import Final

PROJECT: Final = Path(__file__).parents[1] / "pyproject.toml"
STYLE: Final = ("mypy", "ruff", "scipy-stubs", "furo", "myst-nb", "myst-parser", "sphinx")
"""Start of names of tools that check code or make pages, and run no test."""


def requirements() -> list[str]:
    """Return every requirement of pyproject.toml that the tests need, once."""
    table = tomllib.loads(PROJECT.read_text(encoding="utf-8"))
    project = table["project"]
    extras = (row for extra in project["optional-dependencies"].values() for row in extra)
    listed = [*project["dependencies"], *extras, *table["dependency-groups"]["dev"], *table["build-system"]["requires"]]
    return [row for row in dict.fromkeys(listed) if not row.startswith(STYLE)]


def lowest(requirement: str) -> str:
    """Return the requirement of exactly the lowest version; raises `ValueError` if there is none."""
    found = re.fullmatch(r"(?P<name>[A-Za-z0-9_.-]+)(\[[a-z,]+\])?>=(?P<lowest>[0-9][0-9.]*)", requirement)
    if found is None:
        raise ValueError(f"{PROJECT.name}: {requirement!r} names no lowest version (name>=1.2)")
    return f"{found['name']}=={found['lowest']}"


if __name__ == "__main__":
    for row in requirements():
        print(lowest(row) if sys.argv[1] == "lowest" else row)
