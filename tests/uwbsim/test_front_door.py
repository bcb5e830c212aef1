import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

import uwbsim
from uwblink import Recording
from uwblink.database import write_tables
from uwblink.twr import COLUMNS

NOISELESS = Path(__file__).parents[2] / "scenarios" / "noiseless.toml"
SHORT = {"run.duration_s": 2.0}


def test_a_scenario_is_a_file_a_text_tables_or_itself():
    text = NOISELESS.read_text(encoding="utf-8").replace("duration_s = 60.0", "duration_s = 2.0")
    tables = tomllib.loads(text)
    before = tomllib.loads(text)
    loaded = uwbsim.load(NOISELESS, SHORT)
    flights = [uwbsim.simulate(source) for source in (loaded, text, tables)]
    assert (tables, len(flights[0].exchanges)) == (before, 320)
    for flight in flights[1:]:
        for name in COLUMNS:
            np.testing.assert_array_equal(getattr(flight.exchanges, name), getattr(flights[0].exchanges, name))
    assert uwbsim.load(str(NOISELESS), SHORT) == uwbsim.load(NOISELESS, ["run.duration_s=2.0"]) == loaded


def test_a_notebook_shows_the_tags_of_a_scenario():
    scenario = uwbsim.load(NOISELESS, {"tags.1.skew_ppm": 1.5, "run.name": "<b>"})
    page = scenario._repr_html_()
    rows = [re.findall("<td>(.*?)</td>", row) for row in re.findall("<tr>(.*?)</tr>", page)]
    tag = scenario.tags[1]
    expected = [str(tag.id), tag.body, "random-flight", *(f"{x:g}" for x in (*tag.lever_arm_m, tag.delay_ns)), "1.5"]
    assert (rows[2], len(rows), "12 pairs" in page) == (expected, 7, True)
    assert ("&lt;b&gt;" in page, page.count("data:image/png")) == (True, 1)


def test_printed_and_saved_flights_agree(tmp_path):
    flight = uwbsim.simulate(uwbsim.load(NOISELESS, SHORT))
    lines = str(flight).splitlines()
    assert (2 <= len(lines) <= 6, max(map(len, lines)) <= 100) == (True, True)
    assert "320 exchanges (ds) of 6 tags on 3 bodies in 2 s" in lines[0]
    page = flight._repr_html_()
    assert (lines[1].strip() in page, page.count("<tr>"), page.count("data:image/png")) == (True, 8, 1)
    flight.save(tmp_path / "f.uwb")
    with Recording.open(tmp_path / "f.uwb") as recording:
        np.testing.assert_array_equal(recording.exchanges().rx2, flight.exchanges.rx2)
        assert recording.meta()["planted"] == flight.planted
    with pytest.raises(FileExistsError):
        flight.save(tmp_path / "f.uwb")
    flight.save(tmp_path / "f.uwb", force=True)


# Tables that are complete or absent; sweeps and comparisons test their content.


ROWS = [{"name": "a", "n": 1, "x": 0.5}, {"name": "b", "n": 2, "x": None}]


class Failing:
    """Rows that can be read once, and the second time only partly."""

    def __init__(self):
        self.left = 3

    def __iter__(self):
        for row in ROWS:
            self.left -= 1
            if self.left < 0:
                raise KeyboardInterrupt
            yield row


def test_tables_that_fail_half_way_leave_what_was_there(tmp_path):
    table, parquet = tmp_path / "t.csv", tmp_path / "t.parquet"
    write_tables(table, parquet, ROWS, force=False)
    before = table.read_bytes(), parquet.read_bytes()
    with pytest.raises(KeyboardInterrupt):
        write_tables(table, parquet, Failing(), force=True)
    assert (table.read_bytes(), parquet.read_bytes()) == before
    assert sorted(file.name for file in tmp_path.iterdir()) == ["t.csv", "t.parquet"]
