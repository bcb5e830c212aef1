"""Numbers of evaluations, reports and exports, read from them and compared with a separate computation."""

import csv
import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.stats import t as student

import calib
from benchmarks.standing import standing_boards
from calib.data.samples import stamped
from calib.findings import Finding
from calib.report import Heading, write_survey_report
from calib.report.results import Results
from calib.report.sections import SECTIONS
from calib.report.verdict import criteria, verdict
from tests import pages, processes
from tests.calib.report.page_of_numpy import LIGHT, STAGES, TICK_S, Corrected, Tables, columns, curve, number
from tests.calib.synthetic import ranges
from uwblink import SPEED_OF_LIGHT, Contents, Tag, UwblinkError
from uwblink.pages import figures

DELAYS_NS = {"1": 0.31, "2": -0.24, "3": 0.12}
MISSED_NS = {1: 0.31, 2: -0.24, 3: 0.42}
"""True delays of tags: those of the calibration, except tag 3, whose corrected ranges are too short."""

KNOTS = [0.1, 0.1, 0.1, 0.1, 0.9, 1.8, 1.8, 1.8, 1.8]
KNOWN = {
    "schema_version": 1,
    "delays_ns": DELAYS_NS,
    "delays_std_ns": {"1": 0.01, "2": 0.03, "3": 0.02},
    "loss": "mixture",
    "scale_ns": 0.1,
    "lift": "mean-of-lifted",
    "alpha_dbm": -82.0,
    "speed_of_light": LIGHT,
    "bias_curve": {"knots": KNOTS, "coefficients": [-0.06, 0.01, 0.05, 0.02, -0.04], "degree": 3, "range": [0.1, 1.2]},
    "sigma_curve": {"knots": KNOTS, "coefficients": [0.07, 0.05, 0.04, 0.04, 0.05], "degree": 3, "range": [0.1, 1.2]},
    "antenna_delays": {
        "1": {"tx": 16436, "rx": 16436, "reply": 16436},
        "2": {"tx": 16450, "rx": 16410, "reply": 16436},
        "3": {"tx": 100, "rx": 300, "reply": 200},
    },
    "provenance": {"writer": "by hand", "warnings": []},
    "errors": {
        "lifted": [0.1, 0.6, 1.2],
        "noise_m": [0.07, 0.05, 0.045],
        "tail_share": [0.2, 0.12, 0.08],
        "least_m": 0.05,
        "detour_m": 0.3,
        "long_share": 0.4,
        "long_factor": 4.0,
        "outlier_share": 0.01,
        "outlier_m": 2.0,
        "location_m": -0.004,
        "scale": 1.1,
        "levels": [[0.025, 0.02], [0.5, 0.5], [0.975, 0.97]],
        "pairs": {"1-2": {"noise": 1.2, "odds": 0.7, "detour": 1.1}, "2-3": {"noise": 0.9, "odds": 1.5, "detour": 1.0}},
    },
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A flight whose pairs have different errors; the worst pair is too short, and there are more long outliers than
    short.
    """
    place = tmp_path_factory.mktemp("numbers")
    rng, n = np.random.default_rng(3), 3000
    pair = np.array([(1, 2), (3, 1), (2, 3)])[np.arange(n) % 3]
    power = rng.uniform(-95, -79.5, (2, n))
    truth = rng.uniform(1, 7, n)
    error = curve(KNOWN["bias_curve"], np.mean(10 ** ((power + 82) / 10), axis=0)) + 0.05 * rng.standard_normal(n)
    error += np.where(rng.random(n) < 0.12, 0.05 + rng.exponential(0.3, n), 0) - 0.5 * (rng.random(n) < 0.01)
    delay = np.array([MISSED_NS.get(tag, 0.0) for tag in range(4)]) * 1e-9
    measured = truth + error - LIGHT / 2 * delay[pair].sum(axis=1)
    exchanges = stamped(10**9 + np.arange(n) * 10_000_000, pair, measured, power)
    tags = [Tag(tag, f"b{tag}", (0.0, 0.0, 0.0)) for tag in (1, 2, 3)]
    Contents(exchanges=replace(exchanges, truth_m=truth), tags=tags).save(place / "f.uwb")
    (place / "c.json").write_text(json.dumps(KNOWN))
    words = ("evaluate", "f.uwb", "-c", "c.json", "--json", "--report", "r.html")
    with pytest.MonkeyPatch.context() as changed:
        changed.setattr(figures, "drawn", pages.outline)  # figures are rendered in test_report.py
        (place / "e.json").write_text(run(place, "calib", *words))
    run(place, "uwblink", "export", "f.uwb", "--to", "csv", "-o", "csv")
    run(place, "calib", "apply", "f.uwb", "-c", "c.json", "--to", "csv", "-o", "applied")
    return place


def run(place, *words):
    return processes.succeed(*words, cwd=place).stdout


@pytest.fixture(scope="module")
def page(folder):
    return Corrected(folder / "csv" / "exchanges.csv", folder / "c.json")


@pytest.fixture(scope="module")
def tables(folder):
    return Tables((folder / "r.html").read_text())


def flat(table):
    """Return the numbers of a table of tables, by their joined keys."""
    inner = {key: flat(value) if isinstance(value, dict) else {"": value} for key, value in table.items()}
    return {f"{key}.{name}": number for key, numbers in inner.items() for name, number in numbers.items()}


def test_evaluations_agree_with_the_definitions(folder, page):
    found = json.loads((folder / "e.json").read_text())
    judged = found["pairs"] | {"all": found["overall"]}
    # Shares are counts over ranges: a range that is equal to a bound may count on either side.
    expected = flat({name: page.of(rows) for name, rows in page.groups().items()})
    assert flat(judged) == pytest.approx(expected, rel=1e-6, abs=1e-6)
    assert 0.02 < found["overall"]["clamped"] < 0.4
    assert found["overall"]["rejected"] < 0.4
    assert min(group["full"]["median_m"] for group in found["pairs"].values()) < -0.03, "the worst pair is short"


def test_the_report_has_the_evaluation_s_numbers(page, tables):
    covered, keys = {}, [(stage, key) for stage in STAGES for key in ("mean_m", "median_m", "robust_std_m")]
    for name, rows in page.groups().items():
        of = page.of(rows)
        _, count, *cells = tables.row(name, "95 % |e|")
        expected = [of[stage][key] for stage, key in keys]
        expected += [of["full"]["abs95_m"], 1 - of["rejected"], of["inside_95"], of["clamped"]]
        assert int(count) == of["raw"]["n"]
        assert [number(cell) for cell in cells] == pytest.approx(100 * np.array(expected), abs=0.051)
        covered[name] = [100 * share for share in of["coverage"].values()]
    lowest = min(covered, key=lambda name: covered[name][-1])
    for row, name in ((f"pair {lowest}, the lowest", lowest), ("all", "all")):
        cells = tables.row(row, "within nominal")
        assert [number(cell) for cell in cells[1:]] == pytest.approx(covered[name], abs=0.51)


def test_the_report_states_its_origin(folder, monkeypatch):
    page = (folder / "r.html").read_text()
    assert "calib evaluate f.uwb -c c.json --json --report r.html" in page
    assert page.count("SHA-256 ") == 2, "of the recording and of the calibration"
    monkeypatch.setattr("calib.report.sections.SECTIONS", {name: SECTIONS[name] for name in ("verdict", "provenance")})
    calib.write_report(folder / "r.pdf", folder / "f.uwb", calib.load_calibration(folder / "c.json"))
    assert (folder / "r.pdf").read_bytes().startswith(b"%PDF")


def found_of(tables, question):
    """Return the text of a criterion, and its decimal numbers."""
    text = tables.row(question, "criterion")[2]
    return text, [float(x) for x in re.findall(r"(?<![\d-])[-+]?\d+\.\d+", text)]


def test_the_verdict_has_the_numbers_of_its_criteria(page, tables):
    raw, full = (100 * np.median(np.abs(error - page.truth)) for error in (page.raw, page.full))
    told, _ = found_of(tables, "Do range errors decrease?")
    change = 100 * (full / raw - 1)
    assert [*map(float, re.findall(r"[-+]?\d+\.?\d*", told)[:3])] == pytest.approx([raw, full, change], abs=0.51)
    assert change < 0
    of_all, groups = page.of(page.groups()["all"]), {name: page.of(rows) for name, rows in page.groups().items()}
    del groups["all"]
    # Minus the part that chance explains: Student's t times the standard error of a median, 1 % shared by all pairs.
    sure = {
        name: abs(of["full"]["median_m"]) / of["full"]["robust_std_m"]
        - 1.2533 * student.isf(0.005 / len(groups), of["raw"]["n"] - 1) / of["raw"]["n"] ** 0.5
        for name, of in groups.items()
    }
    worst = max(groups, key=lambda name: sure[name])
    (told, numbers), stats = found_of(tables, "Are all pairs free of bias?"), groups[worst]["full"]
    assert worst in told
    assert numbers == pytest.approx([100 * stats["median_m"], sure[worst], 100 * stats["robust_std_m"]], abs=0.051)
    assert numbers[0] < 0
    for question, share in (
        ("Are the stated errors of ranges right?", of_all["inside_95"]),
        ("Are the powers of the recordings within the fitted powers?", of_all["clamped"]),
    ):
        assert number(found_of(tables, question)[0]) == pytest.approx(100 * share, abs=0.051)
    told, numbers = found_of(tables, "Are the antenna delays known well enough?")
    assert "tag 2" in told
    assert numbers[0] == pytest.approx(1.96 * 0.03, abs=6e-4)


def test_the_summary_and_the_delays_have_the_numbers(folder, page, tables):
    of = page.of(page.groups()["all"])
    text = re.sub(r"<[^>]*>", "", (folder / "r.html").read_text())
    summary = re.search(r"Over (\d+) ranges.*?a filter", text, re.DOTALL)[0]
    expected = [of[stage][key] for key in ("median_m", "mean_m") for stage in ("raw", "delays", "full")]
    expected += [of[stage][key] for key in ("std_m", "robust_std_m") for stage in ("raw", "full")]
    expected += [1 - of["rejected"], 0.95, of["accepted"]["mean_m"], of["accepted"]["std_m"], of["rejected"]]
    numbers = [float(x) for x in re.findall(r"[-+]?\d+(?:\.\d+)?", summary)]
    assert numbers == pytest.approx([of["raw"]["n"], *(100 * np.array(expected))], abs=0.051)
    for tag, delay in DELAYS_NS.items():
        half = 1.959964 * KNOWN["delays_std_ns"][tag]
        cells = tables.row(tag, "95 % from")[1:4]
        assert [float(cell) for cell in cells] == pytest.approx([delay, delay - half, delay + half], abs=6e-5)


def test_corrected_ranges_agree_with_the_definitions(folder, page):
    table = columns(folder / "applied" / "corrected.csv")
    for name, expected in {
        "raw_m": page.raw, "corrected_m": page.full, "sigma_m": page.sigma, "sigma_total_m": page.total,
        "mean_error_m": page.mean_error, "tail_share": page.tail_share,
    }.items():  # fmt: skip
        np.testing.assert_allclose(table[name], expected, rtol=1e-9, atol=1e-9, err_msg=name)
    np.testing.assert_array_equal(table["clamped"], page.clamped)
    np.testing.assert_array_equal(*(columns(folder / name / "exchanges.csv")["tx1"] for name in ("csv", "applied")))


def test_exports_have_the_numbers(folder):
    text = yaml.safe_load(run(folder, "calib", "export", "c.json", "--to", "ros-yaml"))["uwb_calibration"]
    for tag, delay in DELAYS_NS.items():
        # 44 and 56 % of the delay's ticks are added to the programmed ones.
        ticks, before, row = -delay * 1e-9 / TICK_S, KNOWN["antenna_delays"][tag], text["tags"][tag]
        tx, rx = row["tx_antenna_delay"], row["rx_antenna_delay"]
        assert (row["delay_ns"], tx) == (delay, pytest.approx(before["tx"] + 0.44 * ticks, abs=0.8))
        assert rx == pytest.approx(before["rx"] + 0.56 * ticks, abs=1.01)
        assert tx + rx == pytest.approx(before["tx"] + before["rx"] + ticks, abs=0.501)
    plain = {"alpha_dbm": -82.0, "lift": "mean-of-lifted", "power_at": "exchange"}
    same = plain | {name: KNOWN[name] for name in ("bias_curve", "sigma_curve")}
    assert {name: text[name] for name in same} == same
    rows = list(csv.DictReader(run(folder, "calib", "export", "c.json", "--to", "csv").splitlines()))
    assert {row["tag"]: float(row["delay_ns"]) for row in rows} == DELAYS_NS
    assert {row["tag"]: float(row["delay_std_ns"]) for row in rows} == KNOWN["delays_std_ns"]
    miluv = json.loads(run(folder, "calib", "export", "c.json", "--to", "miluv"))
    assert miluv["delays_ns"] == DELAYS_NS
    for name, key in (("bias_spline_m", "bias_curve"), ("std_spline_m", "sigma_curve")):
        assert miluv[name] == {"knots": KNOTS, "coeffs": KNOWN[key]["coefficients"], "degree": 3}
    assert miluv["tx_rx_split"] == {"tx": 0.44, "rx": 0.56}


def test_the_errors_of_ros_yaml_agree_with_the_model(folder, page):
    errors = yaml.safe_load(run(folder, "calib", "export", "c.json", "--to", "ros-yaml"))["uwb_calibration"]["errors"]
    assert errors["lifted"] == KNOWN["errors"]["lifted"]
    for pair in ("1-2", "2-3", "1-3"):
        table, rows = errors["pairs"].get(pair, errors["pairs"]["other"]), (page.pair == pair) & ~page.clamped
        near = rows & (np.abs(page.lifted - 0.6) < 0.01)
        for name in ("low95", "high95"):
            found = np.interp(page.lifted[rows], errors["lifted"], table[f"{name}_m"])
            np.testing.assert_allclose(found, getattr(page, name)[rows], atol=1e-6)
        found = [table[name][1] for name in ("sigma_total_m", "mean_error_m", "tail_share")]
        expected = [column[near].mean() for column in (page.total, page.mean_error, page.tail_share)]
        assert found == pytest.approx(expected, rel=0.01)


# The verdict on worlds with known quality: evaluated on recordings, or made without known distances.


CONTRADICTED = "Do the ranges agree with the known facts?"
POWERS = "Are the powers of the recordings within the fitted powers?"


@pytest.fixture(scope="module")
def known() -> calib.Calibration:
    return calib.fit(ranges(6000), between_m=0.0).calibration


@pytest.fixture(scope="module")
def unseen():
    return replace(ranges(3000, seed=2), source="another flight")


def told(known, unseen, **changes):
    blocks: Any = verdict(Results(calibration=known, **{"tests": [unseen]} | changes))
    text, table = blocks
    assert all(row[-1] for row in table.rows), "every criterion states what it asks for"
    return text, {row[0]: row[1] for row in table.rows}


def changed(known: calib.Calibration, **parts) -> calib.Calibration:
    return replace(known, provenance=known.provenance | parts)


def test_good_calibrations_are_fit_for_use(known, unseen):
    text, met = told(known, unseen)
    # Nothing was localized, and distances were known.
    assert (text.kind, [*met.values()]) == ("good", 7 * ["✓ yes"])


def test_missing_tests_and_warnings_are_reservations(known, unseen):
    text, met = told(known, unseen, tests=[], training=[unseen])
    assert (text.kind, met["Was it evaluated on other recordings than the fitted ones?"]) == ("doubt", "! in part")
    clock = Finding(fault="clock", evidence="it jumps", remedy="leave it out", p_value=0.0)
    text, met = told(changed(known, warnings=["only 3 s of data"]), unseen, findings=[("a.uwb", clock)])
    unmet = [question for question, how in met.items() if how != "✓ yes"]
    assert (text.kind, "2 warnings, below" in text.text, unmet) == ("doubt", True, ["Are there no warnings?"])


def longer(known, unseen):
    # 0.8 ns on tag 3 alone: half of it is 12 cm in all its pairs.
    mine = (unseen.initiator == 3) | (unseen.target == 3)
    return known, replace(unseen, raw_m=unseen.raw_m + np.where(mine, 0.4e-9 * SPEED_OF_LIGHT, 0.0))


def stronger(known, unseen, share=0.6):
    weak = np.arange(len(unseen)) < share * len(unseen)
    powers = {name: np.where(weak, -70.0, getattr(unseen, name)) for name in ("fpp1_dbm", "fpp2_dbm")}
    return known, replace(unseen, **powers)


@pytest.mark.parametrize(
    ("change", "question", "words"),
    [
        (longer, "Are all pairs free of bias?", "has a remaining bias of +1"),
        # Noise of 15 cm more.
        (
            lambda known, unseen: (
                known,
                replace(unseen, raw_m=unseen.raw_m + np.random.default_rng(3).normal(0, 0.15, len(unseen))),
            ),
            "Are the stated errors of ranges right?",
            "",
        ),
        (
            lambda known, unseen: (changed(known, undetermined=[[1, 2], [3, 7]]), unseen),
            "Are the antenna delays known well enough?",
            "tags 1, 2; 3, 7 are not determined",
        ),
        (stronger, POWERS, ""),
        # A calibration of other boards.
        (
            lambda known, unseen: (
                replace(known, delays_ns={tag: -20 * delay for tag, delay in known.delays_ns.items()}),
                unseen,
            ),
            "Do range errors decrease?",
            "",
        ),
    ],
)
def test_changed_boards_make_a_calibration_unfit(known, unseen, change, question, words):
    text, met = told(*change(known, unseen))
    assert (text.kind, met[question]) == ("bad", "✗ no")

    assert words in text.text
    # A few powers outside of the fitted ones are a reservation.
    assert change != stronger or told(*stronger(known, unseen, 0.12))[1][question] == "! in part"


@pytest.mark.parametrize(("count", "mark"), [(4, "✓ yes"), (100, "✗ no")])
def test_a_few_ranges_of_a_pair_do_not_make_it_unfit(known, unseen, count, mark):
    """Half a metre in four ranges of a pair is not significant; in a hundred it is a fault."""
    mine = (unseen.initiator + unseen.target == 10) & (abs(unseen.initiator - unseen.target) == 4)
    longer = replace(unseen, raw_m=unseen.raw_m + 0.15 * mine)
    text, met = told(known, longer[~mine | (np.cumsum(mine) <= count)])
    assert (met["Are all pairs free of bias?"], text.kind == "bad") == (mark, mark == "✗ no")


@pytest.fixture(scope="module")
def surveyed():
    """A survey of boards on a line with one planted reflection."""
    r = standing_boards(31, boards=4, arrangements=6, pair_error_m=0.01).ranges
    hit = (r.time_ns < 65e9) & (r.initiator + r.target == 7) & (abs(r.initiator - r.target) == 1)
    return calib.survey(replace(r, raw_m=r.raw_m + 0.4 * hit), known="line")


def grades(known: calib.Calibration) -> dict[str, str]:
    """Return the grades of the criteria of surveys, without the general one on delays."""
    found = criteria(Results(calibration=known))
    return {one.question: one.grade for one in found if "antenna delays" not in one.question}


def test_each_criterion_of_a_survey_fails_for_its_fault(surveyed):
    known = surveyed.calibration
    assert set(grades(known).values()) == {"good"}
    geometry = known.provenance["geometry"]
    sick = {
        CONTRADICTED: {"findings": ["A: the boards are not on a line"]},
        "Do the arrangements check each other?": {"geometry": geometry | {"freedom": 2.0}},
        "Are the constant errors of pairs small enough?": {"geometry": geometry | {"pair_error_m": 0.2}},
        "Are few pairs reflected?": {"reflected": [{"chance": 1.0}] * 9},
    }
    for question, parts in sick.items():
        assert {q for q, grade in grades(changed(known, **parts)).items() if grade == "bad"} == {question}
    assert grades(changed(known, second_best=2.0))["Is there no other solution?"] == "doubt"
    unsure = replace(known, uncertainty=replace(known.uncertainty, delays_ns2=((0.04,) * 4,) * 4))
    assert grades(unsure)["Is the common part of all delays known?"] == "bad"


def foundations(known: calib.Calibration) -> list[Any]:
    return SECTIONS["foundations"](Results(calibration=known))


def test_reports_of_surveys_have_positions_and_reflected_pairs(surveyed):
    heading, text, places, picture, *_, table = foundations(surveyed.calibration)
    assert heading == Heading("Known facts")
    assert "36 mean ranges of pairs in 6 arrangements" in text.text
    assert [row[0] for row in places.rows] == ["1", "2", "3", "4", "5", "6"]
    for width, down in ((3.5, 6), (7.16, 2)):
        panels = [axes for axes in picture.draw(width).axes if axes.get_visible()]
        assert (len(panels), len({round(axes.get_subplotspec().rowspan.start) for axes in panels})) == (6, down)
        # Ellipses of four boards each.
        assert all(len(axes.patches) == 4 for axes in panels)
    assert table.rows[0][:2] == ["1", "3-4"]
    assert float(table.rows[0][2]) == pytest.approx(40, abs=6)


def test_reports_without_motion_capture_state_known_facts(known):
    assert (foundations(known), grades(known)) == ([], {})
    geometry = {"moving": ["robot"], "known_s": 10.0, "anchors_given": ["a", "b"], "attitudes": "ahrs"}
    blind = changed(known, truth="ranges", geometry=geometry, distance_std_m=0.03)
    _, text, table = foundations(blind)
    assert "positions known for 10.0 s" in text.text
    assert ["anchors at given positions", "a, b"] in table.rows
    assert list(grades(blind).values()) == ["doubt"]


def test_reports_of_surveys_state_known_facts(surveyed, tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "drawn", pages.outline)  # as above
    write_survey_report(tmp_path / "page.html", surveyed.calibration)
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert [part in text for part in ("Fit for use", "Known facts", '"surveyed"')] == [True, True, False]
    with pytest.raises(UwblinkError, match=r"page\.html"):
        write_survey_report(tmp_path / "page.html", surveyed.calibration)


def test_evaluations_of_surveys_state_known_facts(surveyed):
    flight = calib.load_ranges(calib.sample_flight(600))
    judged = replace(
        surveyed.calibration, delays_ns=dict.fromkeys(flight.tags(), 0.0), delays_std_ns={}, uncertainty=None
    )
    results = Results(calibration=judged, tests=[flight])
    assert CONTRADICTED in [one.question for one in criteria(results)]
    assert Heading("Known facts") in SECTIONS["foundations"](results)
