"""What pip users get: scenarios with the packages, the same bytes from every build, a tree that is complete."""

import os
import re
import subprocess
import tarfile
import zipfile
from email import message_from_bytes

import pytest

from tests.builds import ROOT, built
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


def test_links_of_the_page_of_the_package_are_absolute_and_lead_to_files_of_the_sdist(archives):
    wheel = zipfile.ZipFile(archives[0])
    (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    page = str(message_from_bytes(wheel.read(name)).get_payload())
    with tarfile.open(archives[1]) as archive:
        files = {name.partition("/")[2] for name in archive.getnames()}
    links = re.findall(r"\]\((\S+?)\)", page)
    assert len(links) == len(re.findall(r"\]\((\S+?)\)", (ROOT / "README.md").read_text(encoding="utf-8"))) > 10
    assert [link for link in links if not link.startswith("https://")] == []
    (image,) = re.findall(r"!\[[^\]]+\]\((\S+)\)", page)
    assert image.startswith("https://raw.githubusercontent.com/")  # the page of a file on GitHub is no picture
    own = [re.fullmatch(r"https://\S+/uwbcal/(?:blob/)?main/([^?#]+)\S*", link) for link in links]
    assert [found[1] for found in own if found and found[1] not in files] == []
    assert sum(found is not None for found in own) > 10


def test_two_builds_are_the_same_bytes_wherever_the_tree_lies(archives, tmp_path):
    with tarfile.open(archives[1]) as archive:
        archive.extractall(tmp_path, filter="data")
    (tree,) = tmp_path.iterdir()
    for path in tree.rglob("*.py"):  # another day, another hand
        os.utime(path, (1, 1))
    again = built(tmp_path / "dist", of=tree)
    assert [path.name for path in again] == [path.name for path in archives]
    assert [path.read_bytes() for path in again] == [path.read_bytes() for path in archives]
