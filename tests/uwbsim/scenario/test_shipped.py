"""Scenarios that come along, by name: found, listed, copied."""

from pathlib import Path
from typing import Any

import pytest

import uwbsim
from tests import processes
from uwbsim.scenario import copy_scenarios, listed, shipped_scenarios


def test_every_one_is_told_of():
    told = listed()
    assert list(told) == list(shipped_scenarios()) == sorted(told)
    assert all(4 < len(text) < 200 for text in told.values())
    assert len(set(told.values())) == len(told), "two are told of alike"


def test_a_name_does_for_a_file_where_there_is_none(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    by_name = uwbsim.load("nlos_office/office")
    assert by_name == uwbsim.load(shipped_scenarios()["nlos_office/office"])
    assert uwbsim.load("noiseless.toml") == uwbsim.load("noiseless")
    own = (shipped_scenarios()["noiseless"]).read_text().replace("seed = ", "seed = 7")
    Path("noiseless.toml").write_text(own)
    assert uwbsim.load("noiseless.toml").run.seed != uwbsim.load("noiseless").run.seed
    with pytest.raises(uwbsim.ScenarioError, match=r"no such scenario file \(\.toml\) or name"):
        uwbsim.load("icra2024/train")
    for wrong, near in (("icra2023/tset1", "icra2023/test1 or"), ("hall.toml", "hall_with_metal/hall or lasting")):
        with pytest.raises(uwbsim.ScenarioError, match=f"or name, did you mean {near}"):
            uwbsim.load(wrong)
    with pytest.raises(uwbsim.ScenarioError, match=r"or name \(see uwbsim scenarios\)"):
        uwbsim.load("flight.uwb")
    number: Any = 3
    with pytest.raises(uwbsim.UwbsimError, match="`source`: found int, expected a path, a name"):
        uwbsim.simulate(number)


def test_copies_run_on_their_own(tmp_path):
    written = copy_scenarios(["nlos_office"], tmp_path / "mine")
    assert {path.relative_to(tmp_path).as_posix() for path in written} == {
        "mine/nlos_office/office.toml",
        "mine/nlos_office/monopole.csv",
    }
    assert uwbsim.load(written[0]) == uwbsim.load("nlos_office/office")
    everything = copy_scenarios([], tmp_path / "all")
    assert len(everything) == len(shipped_scenarios()) + 2
    with pytest.raises(uwbsim.ScenarioError, match="nonsense: no such scenario; known are anchors"):
        copy_scenarios(["icra2023", "nonsense"], tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_the_command_copies_and_replaces_only_when_told(tmp_path):
    def run(*words):
        return processes.run("uwbsim", "scenarios", *words, cwd=tmp_path)

    assert "icra2023/train" in run().stdout
    assert run("icra2023", "-o", "s").stdout.splitlines() == [
        f"s/icra2023/{n}.toml" for n in ("test1", "test2", "train")
    ]
    again = ("uwbsim", "scenarios", "icra2023", "-o", "s")
    processes.refuse(*again, cwd=tmp_path, naming=["s/icra2023/test1.toml: exists already", "--force"])
    assert run("icra2023", "-o", "s", "--force").returncode == 0
