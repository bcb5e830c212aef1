"""The licences of all installed packages: `python -m tests.licences` writes them into docs/licences.md.

Names are those of requirements-dev.lock; licences are stated by the installed distributions.
"""

from __future__ import annotations

import contextlib
import re
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Final

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT: Final = Path(__file__).parents[1]
LOCK: Final = ROOT / "requirements-dev.lock"
PAGE: Final = ROOT / "docs" / "licences.md"
BEGIN, END = "<!-- licences:begin -->", "<!-- licences:end -->"

PERMISSIVE: Final = frozenset(
    {"0BSD", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "BSD", "CC0-1.0", "ISC", "MIT", "MIT-0", "MIT-CMU", "HPND"}
    | {"any-OSI", "PSF-2.0", "Python-2.0", "Unlicense", "Zlib", "MPL-2.0"}
)
"""Licences of packages that can be installed with a program under the MIT licence without conditions for it."""

LINKED: Final = frozenset({"LGPL-3.0", "LGPL-3.0-only", "LGPL-3.0-or-later"})
"""Licences of packages that may be imported, unchanged and replaceable, by a program under another licence."""

JUDGED: Final = {
    "docutils": "its GPL is that of a mode for Emacs, which its wheel does not contain",
}
"""Distributions with unclear statements, and the licences found by hand."""

SPELT: Final = {
    "mit license": "MIT",
    "the mit license (mit)": "MIT",
    "bsd license": "BSD",
    "bsd 3-clause license": "BSD-3-Clause",
    "bsd-3": "BSD-3-Clause",
    "new bsd": "BSD-3-Clause",
    "3-clause bsd": "BSD-3-Clause",
    "apache software license": "Apache-2.0",
    "apache license 2.0": "Apache-2.0",
    "apache license, version 2.0": "Apache-2.0",
    "apache 2.0": "Apache-2.0",
    "apache": "Apache-2.0",
    "isc license (iscl)": "ISC",
    "isc license": "ISC",
    "python software foundation license": "PSF-2.0",
    "psf": "PSF-2.0",
    "mozilla public license 2.0 (mpl 2.0)": "MPL-2.0",
    "gnu lesser general public license v3 (lgplv3)": "LGPL-3.0",
    "gnu lesser general public license": "LGPL-3.0",
    "lgplv3+": "LGPL-3.0-or-later",
}
"""Other names of licences, from the time before SPDX identifiers."""


def names_of(lock: str) -> list[str]:
    """Return the names in a lock file, each once, in order."""
    return sorted({canonicalize_name(name) for name in re.findall(r"^([\w.-]+)==", lock, flags=re.MULTILINE)})


def licence_of(name: str) -> str:
    """Return the licence of a distribution as an SPDX expression, or its own statement if that is not one."""
    try:
        told = distribution(name).metadata
    except PackageNotFoundError:
        return ELSEWHERE.get(name, "")
    if told["License-Expression"]:
        return str(told["License-Expression"])
    classified = [c.split(" :: ")[-1] for c in told.get_all("Classifier") or [] if c.startswith("License ::")]
    words = [c for c in classified if c != "OSI Approved"] or [str(told["License"] or "").splitlines()[:1][0].strip()]
    return " AND ".join(sorted({SPELT.get(word.lower(), word) for word in words}))


def installed_with(requirements: list[str]) -> set[str]:
    """Return the names of distributions that are installed with some distributions, including these."""
    waiting = list(map(Requirement, requirements))
    known: set[str] = set()
    while waiting:
        name = canonicalize_name(waiting.pop().name)
        if name not in known:
            known.add(name)
            with contextlib.suppress(PackageNotFoundError):
                needs = map(Requirement, distribution(name).requires or [])
                waiting += [need for need in needs if "extra ==" not in str(need.marker)]
    return known


def rows() -> list[tuple[str, str, str]]:
    """Return name, licence and purpose of all packages in the lock file that are installed here."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    plain = installed_with(project["dependencies"])
    extra = {name: installed_with(listed) - plain for name, listed in project["optional-dependencies"].items()}
    found = []
    for name in names_of(LOCK.read_text(encoding="utf-8")):
        extras = [f"extra `{key}`" for key, members in extra.items() if name in members]
        found.append((name, licence_of(name), "always" if name in plain else ", ".join(extras) or "development"))
    return found


ELSEWHERE: Final = {
    "appnope": "BSD-2-Clause",
    "cffi": "MIT-0",
    "colorama": "BSD-3-Clause",
    "pycparser": "BSD-3-Clause",
}
"""Licences of packages for other systems, as their projects state them."""


def table(found: list[tuple[str, str, str]]) -> str:
    """Return the rows as a table in Markdown: a line for each licence and purpose."""
    notes = {name: f" ({told})" for name, told in JUDGED.items()}
    groups: dict[tuple[str, str], list[str]] = {}
    for name, licence, purpose in found:
        groups.setdefault((purpose, licence + notes.get(name, "")), []).append(name)
    lines = [f"| {purpose} | {licence} | {', '.join(names)} |" for (purpose, licence), names in sorted(groups.items())]
    return "\n".join(["| installed | licence | distributions |", "|---|---|---|", *lines])


def allowed(name: str, licence: str) -> bool:
    """Return whether one of the alternatives of an expression, with all its parts, is compatible."""
    bare = re.sub(r"\s+WITH\s+\S+", "", licence.replace("(", "").replace(")", ""))
    alternatives = ({part.strip() for part in one.split(" AND ")} for one in bare.split(" OR "))
    return name in JUDGED or any(parts <= PERMISSIVE | LINKED for parts in alternatives)


def main() -> int:
    """Write the table into the page; print incompatible licences, and return 1 if there are any."""
    found = rows()
    text = PAGE.read_text(encoding="utf-8")
    before, after = text[: text.index(BEGIN) + len(BEGIN)], text[text.index(END) :]
    PAGE.write_text(f"{before}\n{table(found)}\n{after}", encoding="utf-8")
    wrong = [row for row in found if not allowed(row[0], row[1])]
    for name, licence, purpose in wrong:
        sys.stderr.write(f"{name}: {licence or 'says no licence'} ({purpose})\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
