"""The verdict on worlds of which it is known how they stand: judged on recordings, or made without known distances."""

from dataclasses import replace

import numpy as np
import pytest

import calib
from benchmarks.standing import standing_boards
from calib.calibration.model import Calibration
from calib.findings import Finding
from calib.fitting.fitting import fit
from calib.report import Heading, Picture, Table, Text, write_survey_report
from calib.report.results import Results
from calib.report.sections import SECTIONS
from calib.report.verdict import criteria, verdict
from tests.calib.synthetic import ranges
from uwblink.errors import UwblinkError
from uwblink.ticks import SPEED_OF_LIGHT

CONTRADICTED = "Do the ranges agree with what is said to be known?"


@pytest.fixture(scope="module")
def known() -> Calibration:
    return fit(ranges(6000), between_m=0.0).calibration


@pytest.fixture(scope="module")
def unseen():
    return replace(ranges(3000, seed=2), source="another flight")


def told(known, unseen, **changes):
    text, table = verdict(Results(calibration=known, **{"tests": [unseen]} | changes))
    assert isinstance(text, Text)
    assert isinstance(table, Table)
    assert all(row[-1] for row in table.rows), "every criterion states what it asks for"
    return text, {row[0]: row[1] for row in table.rows}


def changed(known: Calibration, **parts) -> Calibration:
    return replace(known, provenance=known.provenance | parts)


def test_what_fits_what_it_has_not_seen_is_fit_for_use(known, unseen):
    text, met = told(known, unseen)
    assert text.kind == "good"
    assert text.text.startswith("Fit for use. ")
    assert len(met) == 7, "nothing was localized, and distances were known"
    assert set(met.values()) == {"✓ yes"}


def test_without_a_test_and_with_warnings_there_are_reservations(known, unseen):
    text, met = told(known, unseen, tests=[], training=[unseen])
    assert text.kind == "doubt"
    assert met["Was it judged on recordings that the fit has not seen?"] == "! in part"
    clock = Finding(fault="clock", evidence="it jumps", remedy="leave it out", p_value=0.0)
    text, met = told(changed(known, warnings=["only 3 s of data"]), unseen, findings=[("a.uwb", clock)])
    assert text.kind == "doubt"
    assert "2 warnings, below" in text.text
    assert [question for question, how in met.items() if how != "✓ yes"] == ["Is there nothing to warn of?"]


def longer(known, unseen):
    # 0.8 ns on tag 3 alone: half of it is 12 cm in all its pairs.
    mine = (unseen.initiator == 3) | (unseen.target == 3)
    return known, replace(unseen, raw_m=unseen.raw_m + np.where(mine, 0.4e-9 * SPEED_OF_LIGHT, 0.0))


def noisier(known, unseen):
    noise = np.random.default_rng(3).normal(0, 0.15, len(unseen))
    return known, replace(unseen, raw_m=unseen.raw_m + noise)


def left_open(known, unseen):
    return changed(known, undetermined=[[1, 2], [3, 7]]), unseen


def stronger(known, unseen, share=0.6):
    weak = np.arange(len(unseen)) < share * len(unseen)
    powers = {name: np.where(weak, -70.0, getattr(unseen, name)) for name in ("fpp1_dbm", "fpp2_dbm")}
    return known, replace(unseen, **powers)


def of_other_boards(known, unseen):
    return replace(known, delays_ns={tag: -20 * delay for tag, delay in known.delays_ns.items()}), unseen


@pytest.mark.parametrize(
    ("change", "question", "words"),
    [
        (longer, "Is no pair left with a bias?", "keeps a bias of +1"),
        (noisier, "Does it say rightly how far ranges can be off?", ""),
        (left_open, "Are the antenna delays known well enough?", "tags 1, 2; 3, 7 are not determined"),
        (stronger, "Was the curve fitted at such powers?", ""),
        (of_other_boards, "Does it make ranges better?", ""),
    ],
)
def test_what_changed_since_makes_it_unfit(known, unseen, change, question, words):
    text, met = told(*change(known, unseen))
    assert (text.kind, met[question]) == ("bad", "✗ no")
    assert text.text.startswith("Not fit for use. ")
    assert words in text.text


def test_a_few_ranges_of_a_pair_do_not_make_it_unfit(known, unseen):
    """Half a metre off in four ranges of a pair says little; in a hundred it is a fault."""
    mine = np.flatnonzero((unseen.initiator + unseen.target == 10) & (abs(unseen.initiator - unseen.target) == 4))
    for count, mark in ((4, "✓ yes"), (100, "✗ no")):
        others = np.setdiff1d(np.arange(len(unseen)), mine[count:])
        raw_m = unseen.raw_m.copy()
        raw_m[mine] += 0.15
        text, met = told(known, replace(unseen, raw_m=raw_m)[others])
        assert met["Is no pair left with a bias?"] == mark
        assert (text.kind == "bad") == (mark == "✗ no")


def test_few_powers_that_were_not_fitted_are_a_reservation(known, unseen):
    assert told(*stronger(known, unseen, 0.12))[1]["Was the curve fitted at such powers?"] == "! in part"


@pytest.fixture(scope="module")
def surveyed():
    """A survey of a string with one planted reflection."""
    world = standing_boards(31, boards=4, arrangements=6, pair_error_m=0.01)
    r = world.ranges
    hit = (r.time_ns < 65e9) & (r.initiator + r.target == 7) & (abs(r.initiator - r.target) == 1)
    return calib.survey(replace(r, raw_m=r.raw_m + 0.4 * hit), known="line")


def grades(known: Calibration) -> dict[str, str]:
    """What is asked beside whether delays are known well enough, which is asked of all."""
    found = criteria(Results(calibration=known))
    return {one.question: one.grade for one in found if "antenna delays" not in one.question}


def test_each_criterion_of_a_survey_fails_where_it_should(surveyed):
    known = surveyed.calibration
    assert set(grades(known).values()) == {"good"}
    rests = known.provenance["rests_on"]
    sick = {
        CONTRADICTED: {"findings": ["A is said to be a line and is none"]},
        "Do the arrangements check each other?": {"rests_on": rests | {"freedom": 2.0}},
        "Are the constant errors of pairs those of such boards?": {"rests_on": rests | {"pair_error_m": 0.2}},
        "Are few pairs reflected?": {"reflected": [{"chance": 1.0}] * 9},
    }
    for question, parts in sick.items():
        assert {q for q, grade in grades(changed(known, **parts)).items() if grade == "bad"} == {question}
    assert grades(changed(known, second_best=2.0))["Is there no other solution?"] == "doubt"
    wide = tuple(tuple(0.04 for _ in row) for row in known.uncertainty.delays_ns2)
    unsure = replace(known, uncertainty=replace(known.uncertainty, delays_ns2=wide))
    assert grades(unsure)["Is what all delays share known?"] == "bad"


def foundations(known: Calibration):
    return SECTIONS["foundations"](Results(calibration=known))


def test_the_section_has_the_places_and_the_reflected_pair(surveyed):
    heading, text, places, picture, *rest = foundations(surveyed.calibration)
    assert heading == Heading("What it rests on")
    assert isinstance(text, Text)
    assert "36 mean ranges of pairs in 6 arrangements" in text.text
    assert isinstance(places, Table)
    assert [row[0] for row in places.rows] == ["1", "2", "3", "4", "5", "6"]
    assert isinstance(picture, Picture)
    for width, down in ((3.5, 6), (7.16, 2)):
        panels = [axes for axes in picture.draw(width).axes if axes.get_visible()]
        assert len(panels) == 6
        assert len({round(axes.get_subplotspec().rowspan.start) for axes in panels}) == down
        # Ellipses of four boards each.
        assert all(len(axes.patches) == 4 for axes in panels)
    table = rest[-1]
    assert isinstance(table, Table)
    assert table.rows[0][:2] == ["1", "3-4"]
    assert float(table.rows[0][2]) == pytest.approx(40, abs=6)


def test_a_flight_without_motion_capture_tells_what_it_rests_on(known):
    assert foundations(known) == []
    assert grades(known) == {}
    rests = {"moving": ["robot"], "known_s": 10.0, "anchors_given": ["a", "b"], "attitudes": "ahrs"}
    blind = changed(known, truth="ranges", rests_on=rests, distance_std_m=0.03)
    _, text, table = foundations(blind)
    assert isinstance(text, Text)
    assert "positions known for 10.0 s" in text.text
    assert isinstance(table, Table)
    assert ["anchors at given places", "a, b"] in table.rows
    assert list(grades(blind).values()) == ["doubt"]


def test_reports_of_a_survey_and_of_its_evaluation_say_what_it_rests_on(surveyed, tmp_path):
    page = tmp_path / "page.html"
    write_survey_report(page, surveyed.calibration)
    text = page.read_text(encoding="utf-8")
    assert "Fit for use" in text
    assert "What it rests on" in text
    assert '"surveyed"' not in text
    with pytest.raises(UwblinkError, match=r"page\.html"):
        write_survey_report(page, surveyed.calibration)
    flight = calib.load_ranges(calib.sample_flight(600))
    delays = dict.fromkeys(flight.tags(), 0.0)
    judged = replace(surveyed.calibration, delays_ns=delays, delays_std_ns={}, uncertainty=None)
    results = Results(calibration=judged, tests=[flight])
    assert CONTRADICTED in [one.question for one in criteria(results)]
    assert Heading("What it rests on") in SECTIONS["foundations"](results)
