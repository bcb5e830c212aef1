import doctest
import tomllib
from pathlib import Path

import numpy as np
import pytest

import uwbsim
from uwblink import Recording
from uwblink.twr import COLUMNS

NOISELESS = Path(__file__).parents[2] / "scenarios" / "noiseless.toml"
SHORT = {"run.duration_s": 2.0}


@pytest.mark.parametrize("name", uwbsim.__all__)
def test_every_example_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runner = doctest.DocTestRunner()
    for example in doctest.DocTestFinder(recurse=False).find(getattr(uwbsim, name), name):
        assert runner.run(example).failed == 0


def test_a_scenario_is_a_file_a_text_tables_or_itself():
    text = NOISELESS.read_text(encoding="utf-8").replace("duration_s = 60.0", "duration_s = 2.0")
    tables = tomllib.loads(text)
    before = tomllib.loads(text)
    loaded = uwbsim.load(NOISELESS, SHORT)
    flights = [uwbsim.simulate(source) for source in (loaded, text, tables)]
    assert tables == before
    assert len(flights[0].exchanges) == 320
    for flight in flights[1:]:
        for name in COLUMNS:
            np.testing.assert_array_equal(getattr(flight.exchanges, name), getattr(flights[0].exchanges, name))
    assert uwbsim.load(str(NOISELESS), SHORT) == uwbsim.load(NOISELESS, ["run.duration_s=2.0"]) == loaded


@pytest.mark.parametrize(
    ("source", "overrides", "message"),
    [
        ("run = {\n", (), r"^scenario: not valid TOML"),
        ({"ranging": {"rate_hz": 1.0}}, (), r"^scenario: run: missing"),
        ("nowhere.toml", (), r"nowhere\.toml: no such scenario file"),
        (NOISELESS, ["run"], r"^`overrides`: found 'run' *, expected key"),
        (NOISELESS, {"run.seed.x": 1}, r"^run\.seed\.x: seed is not a table"),
    ],
)
def test_mistakes_say_where(source, overrides, message):
    with pytest.raises(uwbsim.ScenarioError, match=message):
        uwbsim.simulate(uwbsim.load(source, overrides))


def test_what_a_flight_prints_and_saves_is_true(tmp_path):
    flight = uwbsim.simulate(uwbsim.load(NOISELESS, SHORT))
    lines = str(flight).splitlines()
    assert (2 <= len(lines) <= 6, max(map(len, lines)) <= 100) == (True, True)
    assert "320 exchanges (ds) of 6 tags on 3 bodies in 2 s" in lines[0]
    flight.save(tmp_path / "f.uwb")
    with Recording.open(tmp_path / "f.uwb") as recording:
        np.testing.assert_array_equal(recording.exchanges().rx2, flight.exchanges.rx2)
        assert recording.meta()["planted"] == flight.planted
    with pytest.raises(FileExistsError):
        flight.save(tmp_path / "f.uwb")
    flight.save(tmp_path / "f.uwb", force=True)
