"""The dependencies at the ends of their bounds: `python -m tests.bounds lowest|newest` prints what pip should install.

`lowest` are the versions that pyproject.toml names as the first ones that will do, `newest` whatever is newest.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Final

PROJECT: Final = Path(__file__).parents[1] / "pyproject.toml"
STYLE: Final = ("mypy", "ruff", "scipy-stubs", "furo", "myst-nb", "myst-parser", "sphinx")
"""What looks at code or makes pages of it, and runs no test."""

BOUND: Final = re.compile(r"(?P<name>[A-Za-z0-9_.-]+)(\[[a-z,]+\])?>=(?P<lowest>[0-9][0-9.]*)")


def requirements() -> list[str]:
    """Return every requirement of pyproject.toml that the tests need, once."""
    with PROJECT.open("rb") as file:
        table = tomllib.load(file)
    project = table["project"]
    extras = (row for extra in project["optional-dependencies"].values() for row in extra)
    listed = [*project["dependencies"], *extras, *table["dependency-groups"]["dev"], *table["build-system"]["requires"]]
    return [row for row in dict.fromkeys(listed) if row not in STYLE and not row.startswith(STYLE)]


def lowest(requirement: str) -> str:
    """Return the requirement of exactly its lowest version; raises `ValueError` for one without."""
    found = BOUND.fullmatch(requirement)
    if found is None:
        raise ValueError(f"{PROJECT.name}: {requirement!r} names no lowest version (name>=1.2)")
    return f"{found['name']}=={found['lowest']}"


CHOICES: Final[dict[str, Callable[[str], str]]] = {"lowest": lowest, "newest": str}


def main(choice: str) -> int:
    """Print the requirements, a line each."""
    for row in requirements():
        sys.stdout.write(CHOICES[choice](row) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:]))
