"""Everything in the lock is in docs/licences.md, and nothing incompatible is; every dependency has a lowest version."""

import re

import pytest

from tests.bounds import lowest, requirements
from tests.licences import JUDGED, LINKED, LOCK, PAGE, allowed, names_of

LOCKED, TEXT = LOCK.read_text(encoding="utf-8"), PAGE.read_text(encoding="utf-8")
LINES = re.findall(r"^\| ([^|]+) \| (.*?)(?: \([^|]*\))? \| ([^|]+) \|$", TEXT, flags=re.MULTILINE)[1:]
ROWS = sorted((name, licence, purpose) for purpose, licence, names in LINES for name in names.split(", "))


def test_the_page_lists_what_the_lock_does_and_all_of_it_is_compatible():
    assert [name for name, _, _ in ROWS] == names_of(LOCKED)
    assert [row for row in ROWS if not row[1] or not allowed(row[0], row[1])] == []
    linked = {name for name, licence, purpose in ROWS if licence in LINKED and purpose == "always"}
    assert [name for name in linked if name not in TEXT.partition("<!--")[0]] == [], "the page speaks of them"


@pytest.mark.parametrize(
    ("licence", "compatible"),
    [
        *((each, False) for each in ("", "GPL-3.0-or-later", "MIT AND GPL-2.0-only", "AGPL-3.0 OR SSPL-1.0", "Own")),
        *((each, True) for each in ("MIT", "GPL-2.0-only OR MIT", "Apache-2.0 WITH LLVM-exception", "BSD AND MIT")),
    ],
)
def test_licences_are_told_apart(licence, compatible):
    assert allowed("one", licence) == compatible
    assert "one" not in JUDGED


def test_every_line_of_the_lock_has_its_hashes():
    pinned = re.findall(r"^[A-Za-z0-9].*$", LOCKED, flags=re.MULTILINE)
    assert len(pinned) > 100
    assert [row for row in pinned if not row.endswith("\\")] == []
    hashes = re.findall(r"^    .*$", LOCKED, flags=re.MULTILINE)
    assert [row for row in hashes if not re.match(r"    --hash=sha256:[0-9a-f]{64}( \\)?$", row)] == []


def test_every_requirement_has_a_lowest_version():
    listed = [lowest(row) for row in requirements()]
    assert any(row.startswith("duckdb==") for row in listed)
    assert len({row.split("==")[0] for row in listed}) == len(listed)
    for row in ("numpy", "numpy>2", "numpy>=2,<3", "numpy==2.1"):
        with pytest.raises(ValueError, match="names no lowest version"):
            lowest(row)
