"""Calibrations whose provenance is damaged: one line and status 2, or everything that does not need the entry."""

import json
import operator

import pytest

import calib
from tests import processes


@pytest.fixture(scope="module")
def document():
    """The document of a survey of the tags of the sample."""
    return json.loads(calib.survey(calib.sample_arrangements(), known="line").calibration.to_json())


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        (("geometry",), None),
        (("geometry", "freedom"), "many"),
        (("geometry", "arrangements"), 3),
        (("pairs",), None),
        (("warnings",), 3),
        (("findings",), [1, "x"]),
        (("findings",), 3),
        (("reflected",), [{"chance": "high"}]),
        (("surveyed",), [{"name": 1}]),
        (("undetermined",), [3]),
        (("second_best",), "none"),
    ],
    ids=str,
)
def test_a_damaged_entry_is_one_line_where_it_is_used(document, tmp_path, entry, value):
    processes.succeed("calib", "sample", "-o", tmp_path / "a.uwb", "-n", "900")
    changed = json.loads(json.dumps(document))
    table = changed["provenance"]
    for key in entry[:-1]:
        table = operator.getitem(table, key)
    table[entry[-1]] = value
    (tmp_path / "c.json").write_text(json.dumps(changed))
    page = tmp_path / "r.html"
    judged = processes.run("calib", "evaluate", tmp_path / "a.uwb", "-c", tmp_path / "c.json", "--report", page)
    shown = processes.run("calib", "show", tmp_path / "c.json")
    for done in (judged, shown):
        assert "Traceback" not in done.stderr
        assert done.returncode in (0, 2)
        if done.returncode:
            assert "its provenance is not as uwbcal writes it" in " ".join(done.stderr.split())
    assert page.exists() == (judged.returncode == 0)


def test_calibrations_of_version_0_2_are_read_by_the_old_names_of_keys(document):
    older = {"geometry": "rests_on", "undetermined_text": "left_open"}
    provenance = {older.get(key, key): value for key, value in document["provenance"].items()}
    assert "rests_on" in provenance
    known = calib.Calibration.from_json(json.dumps(document | {"provenance": provenance}))
    assert known == calib.Calibration.from_json(json.dumps(document))


def test_flat_curves_are_shown_at_one_power(document):
    text = repr(calib.Calibration.from_json(json.dumps(document)))
    (line,) = [line for line in text.splitlines() if line.startswith("  lifted power")]
    assert len(line.removeprefix("  lifted power").split()) == 1
