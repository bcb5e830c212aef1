"""Names of files that are no UTF-8, which the system takes and DuckDB does not: one line, and nothing left behind."""

import os
from pathlib import Path

import pytest

import calib
from tests import processes
from uwblink import Contents

NOISELESS = Path(__file__).parents[1] / "scenarios" / "noiseless.toml"
STRANGE = os.fsdecode(b"no\xff")


@pytest.fixture
def folder(tmp_path):
    for ending in (".uwb", ".csv"):
        (tmp_path / f"{STRANGE}{ending}").write_text("time_s,from_id,to_id,range_m\n0.0,1,2,3.0\n")
    flight = calib.sample_flight(300)
    Contents(exchanges=flight.exchanges, poses=flight.poses, tags=flight.tags).save(tmp_path / "f.uwb")
    return tmp_path


@pytest.mark.parametrize(
    "line",
    [
        "uwblink show @.uwb",
        "uwbsim run scenario -o new@.uwb",
        "uwblink export f.uwb --to csv -o @",
        "uwblink import csv @.csv -o o.uwb",
        "uwbsim compare scenario -o @ -n 200 --protocols ds",
    ],
)
def test_where_tables_are_written_or_read_they_are_refused(folder, line):
    before = set(folder.iterdir())
    words = [str(NOISELESS) if word == "scenario" else word.replace("@", STRANGE) for word in line.split()]
    ended = processes.run(*words, cwd=folder)
    assert ended.returncode == 2, ended
    assert ended.stderr.count("\n") == 1
    assert "no\\udcff" in ended.stderr
    assert "must be UTF-8" in ended.stderr
    assert set(folder.iterdir()) == before


def test_text_is_written_all_the_same(folder):
    calib.fit(folder / "f.uwb").calibration.save(folder / "c.json")
    (folder / "c.json").rename(folder / f"{STRANGE}.json")
    ended = processes.run("calib", "export", f"{STRANGE}.json", "--to", "c-header", "-o", "c.h", cwd=folder)
    assert ended.returncode == 0, ended.stderr
    assert (folder / "c.h").read_text(encoding="utf-8")


def test_bytes_of_a_line_are_sent_as_they_are(folder):
    ended = processes.run("uwblink", "send", "/dev/nothing", STRANGE, cwd=folder)
    assert ended.returncode == 2, ended
    assert ended.stderr.startswith("error: /dev/nothing: no such port")
