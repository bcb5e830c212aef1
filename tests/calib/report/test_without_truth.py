"""Reports of calibrations made without known distances: criteria on surveys of which it is known how they stand."""

from dataclasses import replace

import pytest

import calib
from benchmarks.standing import standing_boards
from calib.calibration.model import Calibration
from calib.errors import BadInputError
from calib.report import Heading, Picture, Table, Text, write_survey_report
from calib.report.results import Results
from calib.report.sections import SECTIONS, render
from calib.report.verdict import BAD, DOUBT, GOOD, Criterion, criteria
from uwblink.errors import UwblinkError

CONTRADICTED = "Do the ranges agree with what is said to be known?"


@pytest.fixture(scope="module")
def surveyed():
    """A survey of a string with one planted reflection."""
    world = standing_boards(31, boards=4, arrangements=6, pair_error_m=0.01)
    r = world.ranges
    hit = (r.time_ns < 65e9) & (r.initiator + r.target == 7) & (abs(r.initiator - r.target) == 1)
    return calib.survey(replace(r, raw_m=r.raw_m + 0.4 * hit), known="line")


def changed(known: Calibration, **parts) -> Calibration:
    return replace(known, provenance=known.provenance | parts)


def without_truth(known: Calibration) -> list[Criterion]:
    """What is asked beside whether delays are known well enough, which is asked of all."""
    return [one for one in criteria(Results(calibration=known)) if "antenna delays" not in one.question]


def foundations(known: Calibration):
    return SECTIONS["foundations"](Results(calibration=known))


def grades(known: Calibration) -> dict[str, str]:
    return {one.question: one.grade for one in without_truth(known)}


def test_a_sound_survey_meets_its_criteria_and_each_states_its_threshold(surveyed):
    found = without_truth(surveyed.calibration)
    assert {one.grade for one in found} == {GOOD}
    assert all(one.asked and one.told for one in found)


def test_each_criterion_fails_where_it_should(surveyed):
    known = surveyed.calibration
    rests = known.provenance["rests_on"]
    sick = {
        CONTRADICTED: changed(known, findings=["A is said to be a line and is none"]),
        "Do the arrangements check each other?": changed(known, rests_on=rests | {"freedom": 2.0}),
        "Are the constant errors of pairs those of such boards?": changed(
            known, rests_on=rests | {"pair_error_m": 0.2}
        ),
        "Are few pairs reflected?": changed(known, reflected=[{"chance": 1.0}] * 9),
    }
    for question, one in sick.items():
        assert {q for q, grade in grades(one).items() if grade == BAD} == {question}
    assert grades(changed(known, second_best=2.0))["Is there no other solution?"] == DOUBT
    wide = replace(
        known.uncertainty, delays_ns2=tuple(tuple(0.04 for _ in row) for row in known.uncertainty.delays_ns2)
    )
    assert grades(replace(known, uncertainty=wide))["Is what all delays share known?"] == BAD


def test_the_section_has_the_places_and_the_reflected_pair(surveyed):
    heading, text, places, picture, *rest = foundations(surveyed.calibration)
    assert heading == Heading("What it rests on")
    assert isinstance(text, Text)
    assert "36 mean ranges of pairs in 6 arrangements" in text.text
    assert isinstance(places, Table)
    assert [row[0] for row in places.rows] == ["1", "2", "3", "4", "5", "6"]
    assert isinstance(picture, Picture)
    for width, down in ((3.5, 6), (7.16, 2)):
        drawn = picture.draw(width)
        panels = [axes for axes in drawn.axes if axes.get_visible()]
        assert len(panels) == 6
        assert len({round(axes.get_subplotspec().rowspan.start) for axes in panels}) == down
        # Ellipses of four boards each.
        assert all(len(axes.patches) == 4 for axes in panels)
    table = rest[-1]
    assert isinstance(table, Table)
    assert table.rows[0][:2] == ["1", "3-4"]
    assert float(table.rows[0][2]) == pytest.approx(40, abs=6)


def test_places_come_back_from_a_file_as_they_were_found(surveyed, tmp_path):
    surveyed.save(tmp_path / "c.json")
    (row, *_), (one, *_) = (
        calib.load_calibration(tmp_path / "c.json").provenance["surveyed"],
        surveyed.arrangements,
    )
    back = type(one).from_dict(row)
    assert (back.name, back.known, back.frame) == (one.name, one.known, one.frame)
    for mine, theirs in zip(back.boards, one.boards, strict=True):
        assert mine.position_m == pytest.approx(theirs.position_m, abs=1e-5)
        assert mine.covariance_m2 == pytest.approx(theirs.covariance_m2, rel=1e-3, abs=1e-12)


def test_a_flight_without_motion_capture_tells_what_it_rests_on():
    known = calib.fit(calib.sample_flight()).calibration
    assert foundations(known) == []
    assert without_truth(known) == []
    rests = {"moving": ["robot"], "known_s": 10.0, "anchors_given": ["a", "b"], "attitudes": "ahrs"}
    blind = changed(known, truth="ranges", rests_on=rests, distance_std_m=0.03)
    _, text, table = foundations(blind)
    assert isinstance(text, Text)
    assert "positions known for 10.0 s" in text.text
    assert isinstance(table, Table)
    assert ["anchors at given places", "a, b"] in table.rows
    assert [one.grade for one in without_truth(blind)] == [DOUBT]


def test_the_report_is_written_once_and_has_a_verdict(surveyed, tmp_path):
    page = tmp_path / "page.html"
    write_survey_report(page, surveyed.calibration)
    told = page.read_text(encoding="utf-8")
    assert "Fit for use" in told
    assert "What it rests on" in told
    assert '"surveyed"' not in told
    with pytest.raises((BadInputError, UwblinkError), match="exists"):
        write_survey_report(page, surveyed.calibration)


def test_an_evaluation_of_such_a_calibration_has_the_section(surveyed):
    flight = calib.sample_flight(600)
    known = replace(
        surveyed.calibration,
        delays_ns=dict.fromkeys([t.tag for t in flight.tags], 0.0),
        delays_std_ns={},
        uncertainty=None,
    )
    told = render(flight, known)
    assert "What it rests on" in told
    assert CONTRADICTED in told
