"""A full disk under every command that writes: one line, status 2, and no half file.

The disk is full in that no file may grow beyond some length, which the system itself enforces.
"""

import shutil
from pathlib import Path

import pytest

from tests.in_process import run

ROOT = Path(__file__).parents[1]
NOISELESS = ROOT / "scenarios" / "noiseless.toml"


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    folder = tmp_path_factory.mktemp("seeds")
    assert run("uwbsim", "run", NOISELESS, "-o", folder / "f.uwb", "--set", "run.duration_s=5").status == 0
    assert run("calib", "fit", folder / "f.uwb", "-o", folder / "c.json").status == 0
    shutil.copyfile(ROOT / "docs" / "examples" / "exchanges.csv", folder / "t.csv")
    shutil.copyfile(NOISELESS, folder / "s.toml")
    return folder


COMMANDS = (
    # A log that cannot grow, a file that cannot be completed at the end, and one that cannot even be begun.
    ("uwbsim run {s.toml} -o out.uwb --set run.duration_s=2", 40_000),
    ("uwbsim run {s.toml} -o out.uwb --set run.duration_s=2", 300_000),
    ("uwbsim run {s.toml} -o out.uwb --set run.duration_s=2", 4_000),
    ("uwbsim twin {f.uwb} -c {c.json} -o out.toml", 1_000),
    ("uwblink import csv {t.csv} -o out.uwb", 20_000),
    ("uwblink export {f.uwb} --to csv -o out", 10_000),
    ("uwblink export {f.uwb} --to mcap -o out.mcap", 10_000),
    ("uwblink export {f.uwb} --to tum -o out", 1_000),
    ("calib fit {f.uwb} -o out.json", 1_000),
    ("calib apply {f.uwb} -c {c.json} -o out.uwb", 50_000),
    ("calib export {c.json} --to csv -o out.csv", 20),
    ("calib localize {f.uwb} -c {c.json} --tum out", 1_000),
    ("calib report {f.uwb} -o out.html", 1_000),
)


def hidden(folder):
    return [path for path in folder.rglob("*") if path.name.startswith(".") or "partial" in path.name]


@pytest.mark.parametrize(("line", "most_bytes"), COMMANDS)
def test_a_full_disk_is_one_line_and_leaves_nothing(seeds, tmp_path, line, most_bytes):
    words = [str(seeds / word.strip("{}")) if word.startswith("{") else word for word in line.split()]
    ended = run(*words, folder=tmp_path, most_bytes=most_bytes)
    said = [text for text in ended.err.splitlines() if not text.startswith("warning: ")]
    assert ended.status == 2, ended
    assert len(said) == 1, ended
    assert said[0].startswith("error: ")
    assert "cannot be" in said[0]
    assert hidden(tmp_path) == []
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == []


def test_where_the_disk_has_room_the_same_commands_write(seeds, tmp_path):
    assert run("uwblink", "import", "csv", seeds / "t.csv", "-o", "out.uwb", folder=tmp_path).status == 0
    assert run("uwblink", "show", "out.uwb", folder=tmp_path).out.startswith("out.uwb: ")


def test_a_folder_that_vanishes_is_one_line(seeds, tmp_path):
    ended = run("calib", "export", seeds / "c.json", "--to", "csv", "-o", "no/out.csv", folder=tmp_path)
    assert ended.status == 2
    assert ended.err.count("\n") == 1
