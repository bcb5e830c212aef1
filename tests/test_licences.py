"""Packages for pip users: scenarios, reproducible builds, a complete tree; licences, hashes and lowest versions."""

import os
import re
import subprocess
import tarfile
import zipfile
from email import message_from_bytes

import pytest

from tests.bounds import lowest, requirements
from tests.builds import ROOT, built
from tests.licences import JUDGED, LINKED, LOCK, PAGE, allowed, names_of
from uwbsim import shipped_scenarios


@pytest.fixture(scope="module")
def archives(tmp_path_factory):
    return built(tmp_path_factory.mktemp("dist"))


def test_the_wheel_has_the_scenarios_and_what_they_name(archives):
    names = zipfile.ZipFile(archives[0]).namelist()
    known = {f"uwbsim/scenarios/{name}.toml" for name in shipped_scenarios()}
    assert len(known) > 15
    assert known <= set(names)
    assert "uwbsim/scenarios/bench/monopole.csv" in names
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"uwbsim", "uwblink", "calib"}


def test_the_sdist_has_what_make_demo_and_the_tests_need(archives):
    with tarfile.open(archives[1]) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a checkout: nothing says what belongs to the tree")
    tracked = {name for name in listed.stdout.splitlines() if not name.startswith((".github/", ".ci/"))}
    assert sorted(tracked - names) == []


def test_links_of_the_package_page_are_absolute_and_valid(archives):
    wheel = zipfile.ZipFile(archives[0])
    (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    page = str(message_from_bytes(wheel.read(name)).get_payload())
    with tarfile.open(archives[1]) as archive:
        files = {name.partition("/")[2] for name in archive.getnames()}
    links = re.findall(r"\]\((\S+?)\)", page)
    assert len(links) == len(re.findall(r"\]\((\S+?)\)", (ROOT / "README.md").read_text(encoding="utf-8"))) > 10
    assert [link for link in links if not link.startswith("https://")] == []
    (image,) = re.findall(r"!\[[^\]]+\]\((\S+)\)", page)
    assert image.startswith("https://raw.githubusercontent.com/")  # the page of a file on GitHub is not a picture
    own = [re.fullmatch(r"https://\S+/uwbcal/(?:blob/)?main/([^?#]+)\S*", link) for link in links]
    assert [found[1] for found in own if found and found[1] not in files] == []
    assert sum(found is not None for found in own) > 10


@pytest.mark.slow
def test_two_builds_are_the_same_bytes_wherever_the_tree_lies(archives, tmp_path):
    with tarfile.open(archives[1]) as archive:
        archive.extractall(tmp_path, filter="data")
    (tree,) = tmp_path.iterdir()
    for path in tree.rglob("*.py"):  # another date and another user
        os.utime(path, (1, 1))
    again = built(tmp_path / "dist", of=tree)
    assert [path.name for path in again] == [path.name for path in archives]
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in archives]


# docs/licences.md has all packages of the lock file, all compatible; every dependency has a lowest version.


LOCKED, TEXT = LOCK.read_text(encoding="utf-8"), PAGE.read_text(encoding="utf-8")
LINES = re.findall(r"^\| ([^|]+) \| (.*?)(?: \([^|]*\))? \| ([^|]+) \|$", TEXT, flags=re.MULTILINE)[1:]
ROWS = sorted((name, licence, purpose) for purpose, licence, names in LINES for name in names.split(", "))


def test_the_page_lists_compatible_licences_of_all_locked_packages():
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
def test_licences_are_distinguished(licence, compatible):
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
