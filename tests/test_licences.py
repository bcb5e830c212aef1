"""Everything in the lock is in docs/licences.md, and nothing incompatible is."""

import re

import pytest

from tests.licences import JUDGED, LINKED, LOCK, PAGE, allowed, names_of

LINES = re.findall(
    r"^\| ([^|]+) \| (.*?)(?: \([^|]*\))? \| ([^|]+) \|$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE
)[1:]
ROWS = sorted((name, licence, purpose) for purpose, licence, names in LINES for name in names.split(", "))


def test_the_page_lists_what_the_lock_does():
    assert [name for name, _, _ in ROWS] == names_of(LOCK.read_text(encoding="utf-8"))


@pytest.mark.parametrize(("name", "licence", "purpose"), ROWS)
def test_each_is_compatible(name, licence, purpose):
    assert allowed(name, licence), licence
    assert licence
    if licence in LINKED and purpose == "always":
        assert name in PAGE.read_text(encoding="utf-8").partition("<!--")[0], "what is not permissive is spoken of"


@pytest.mark.parametrize(
    "licence", ["", "GPL-3.0-or-later", "MIT AND GPL-2.0-only", "Proprietary", "AGPL-3.0 OR SSPL-1.0"]
)
def test_what_may_not_stand_there_is_noticed(licence):
    assert not allowed("one", licence)
    assert "one" not in JUDGED


@pytest.mark.parametrize("licence", ["MIT", "GPL-2.0-only OR MIT", "Apache-2.0 WITH LLVM-exception", "BSD AND MIT"])
def test_what_may_is_let_pass(licence):
    assert allowed("one", licence)


def test_every_line_of_the_lock_has_its_hashes():
    entries = LOCK.read_text(encoding="utf-8").split("\n")
    pinned = [row for row in entries if re.match(r"[A-Za-z0-9]", row)]
    assert len(pinned) > 100
    assert [row for row in pinned if not row.endswith("\\")] == []
    assert [
        row for row in entries if row.startswith("    ") and not re.match(r"    --hash=sha256:[0-9a-f]{64}( \\)?$", row)
    ] == []
