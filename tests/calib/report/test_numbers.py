"""Numbers of evaluations, reports and exports, parsed out of them, beside a computation of their own."""

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml
from scipy.stats import t as student

import calib
from calib.data.samples import stamped
from calib.report.sections import SECTIONS
from tests import processes
from tests.calib.report.page_of_numpy import LIGHT, TICK_S, Tables, columns, corrected, curve, number
from uwblink import Contents, Tag

DELAYS_NS = {"1": 0.31, "2": -0.24, "3": 0.12}
MISSED_NS = {1: 0.31, 2: -0.24, 3: 0.42}
"""What tags really have: the calibration's, but for tag 3, whose ranges it leaves too short."""

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
    """A flight whose pairs err differently, the worst one short, with more long outliers than short ones."""
    place = tmp_path_factory.mktemp("numbers")
    rng, n = np.random.default_rng(3), 3000
    pair = np.array([(1, 2), (3, 1), (2, 3)])[np.arange(n) % 3]
    power = rng.uniform(-95, -79.5, (2, n))
    truth = rng.uniform(1, 7, n)
    lifted = np.mean(10 ** ((power + 82) / 10), axis=0)
    error = curve(KNOWN["bias_curve"], lifted) + 0.05 * rng.standard_normal(n)
    error += np.where(rng.random(n) < 0.12, 0.05 + rng.exponential(0.3, n), 0) - 0.5 * (rng.random(n) < 0.01)
    delay = np.array([MISSED_NS.get(tag, 0.0) for tag in range(4)]) * 1e-9
    measured = truth + error - LIGHT / 2 * delay[pair].sum(axis=1)
    exchanges = stamped(10**9 + np.arange(n) * 10_000_000, pair, measured, power)
    tags = [Tag(tag, f"b{tag}", (0.0, 0.0, 0.0)) for tag in (1, 2, 3)]
    Contents(exchanges=replace(exchanges, truth_m=truth), tags=tags).save(place / "f.uwb")
    (place / "c.json").write_text(json.dumps(KNOWN))
    words = ("evaluate", "f.uwb", "-c", "c.json", "--json", "--report", "r.html")
    (place / "e.json").write_text(run(place, "calib", *words))
    run(place, "uwblink", "export", "f.uwb", "--to", "csv", "-o", "csv")
    run(place, "calib", "apply", "f.uwb", "-c", "c.json", "--to", "csv", "-o", "applied")
    return place


def run(place, *words):
    done = processes.succeed(*words, cwd=place)
    return done.stdout


@pytest.fixture(scope="module")
def page(folder):
    return corrected(folder / "csv" / "exchanges.csv", folder / "c.json")


@pytest.fixture(scope="module")
def tables(folder):
    return Tables((folder / "r.html").read_text())


def same(found, expected, where=""):
    if isinstance(expected, dict):
        assert set(found) == set(expected), where
        for key in expected:
            same(found[key], expected[key], f"{where}.{key}")
    else:
        # Shares are counts over ranges: one that lies on a bound to the last digit may count on either side.
        assert found == pytest.approx(expected, rel=1e-6, abs=1e-6), where


def test_an_evaluation_is_what_the_definitions_say(folder, page):
    found = json.loads((folder / "e.json").read_text())
    groups = page.groups()
    assert set(found["pairs"]) == set(groups) - {"all"}
    for name, rows in groups.items():
        same(found["overall"] if name == "all" else found["pairs"][name], page.of(rows), name)
    overall = found["overall"]
    assert 0.02 < overall["clamped"] < 0.4
    assert overall["rejected"] < 0.4
    assert min(group["full"]["median_m"] for group in found["pairs"].values()) < -0.03, "the worst pair is short"


def test_the_report_has_the_evaluation_s_numbers(page, tables):
    for name, rows in page.groups().items():
        of = page.of(rows)
        cells = tables.row(name, "95 % |e|")
        expected = [
            100 * of[stage][key]
            for stage in ("raw", "delays", "full")
            for key in ("mean_m", "median_m", "robust_std_m")
        ]
        expected += [
            100 * of["full"]["abs95_m"],
            100 * (1 - of["rejected"]),
            100 * of["inside_95"],
            100 * of["clamped"],
        ]
        assert int(cells[1]) == of["raw"]["n"]
        assert [number(cell) for cell in cells[2:]] == pytest.approx(expected, abs=0.051)
        cells = tables.row(name, "99 %")
        assert [number(cell) for cell in cells[1:]] == pytest.approx(
            [100 * s for s in of["coverage"].values()], abs=0.51
        )


def test_the_report_says_where_it_comes_from(folder, monkeypatch):
    page = (folder / "r.html").read_text()
    assert "calib evaluate f.uwb -c c.json --json --report r.html" in page
    assert page.count("SHA-256 ") == 2, "of the recording and of the calibration"
    few = {name: SECTIONS[name] for name in ("verdict", "provenance")}
    monkeypatch.setattr("calib.report.sections.SECTIONS", few)
    calib.write_report(folder / "r.pdf", folder / "f.uwb", calib.load_calibration(folder / "c.json"))
    assert (folder / "r.pdf").read_bytes().startswith(b"%PDF")


def found_of(tables, question):
    return tables.row(question, "criterion")[2]


def test_the_verdict_has_the_numbers_that_it_rests_on(page, tables):
    raw, full = (100 * np.median(np.abs(error - page.truth)) for error in (page.raw, page.full))
    before, after, change = map(
        float, re.findall(r"[-+]?\d+\.?\d*", found_of(tables, "Does it make ranges better?"))[:3]
    )
    assert [before, after, change] == pytest.approx([raw, full, 100 * (full / raw - 1)], abs=0.51)
    assert change < 0
    groups = {name: page.of(rows)["full"] for name, rows in page.groups().items() if name != "all"}
    # Less what chance explains: Student's t times the standard error of a median, 1 % shared by all pairs.
    sure = {
        name: abs(of["median_m"]) / of["robust_std_m"] - 1.2533 * student.isf(0.005 / len(groups), n - 1) / n**0.5
        for name, of in groups.items()
        for n in (np.count_nonzero(page.groups()[name]),)
    }
    worst = max(groups, key=lambda name: sure[name])
    told = found_of(tables, "Is no pair left with a bias?")
    assert worst in told
    stats = groups[worst]
    numbers = [float(x) for x in re.findall(r"(?<![\d-])[-+]?\d+\.\d+", told)]
    expected = [100 * stats["median_m"], sure[worst], 100 * stats["robust_std_m"]]
    assert numbers == pytest.approx(expected, abs=0.051)
    assert numbers[0] < 0
    of = page.of(page.groups()["all"])
    for question, share in (("how far ranges can be off", of["inside_95"]), ("at such powers", of["clamped"])):
        row = next(row for row in tables.having("criterion") if question in row[0])
        assert number(row[2]) == pytest.approx(100 * share, abs=0.051)
    row = next(row for row in tables.having("criterion") if "delays known" in row[0])
    assert "tag 2" in row[2]
    assert float(re.search(r"\d\.\d+", row[2])[0]) == pytest.approx(1.96 * 0.03, abs=6e-4)


def test_the_summary_and_the_delays_have_the_numbers(folder, page, tables):
    of = page.of(page.groups()["all"])
    text = re.sub(r"<[^>]*>", "", (folder / "r.html").read_text())
    summary = re.search(r"Over (\d+) ranges.*?a filter", text, re.DOTALL)[0]
    numbers = [float(x) for x in re.findall(r"[-+]?\d+(?:\.\d+)?", summary)]
    expected = [
        of["raw"]["n"],
        *(100 * of[stage][key] for key in ("median_m", "mean_m") for stage in ("raw", "delays", "full")),
    ]
    expected += [100 * of[stage]["std_m"] for stage in ("raw", "full")]
    expected += [100 * of[stage]["robust_std_m"] for stage in ("raw", "full")]
    expected += [100 * (1 - of["rejected"]), 95, 100 * of["accepted"]["mean_m"], 100 * of["accepted"]["std_m"]]
    assert numbers == pytest.approx([*expected, 100 * of["rejected"]], abs=0.051)
    for tag, delay in DELAYS_NS.items():
        cells = tables.row(tag, "95 % from")
        half = 1.959964 * KNOWN["delays_std_ns"][tag]
        assert [float(cell) for cell in cells[1:4]] == pytest.approx([delay, delay - half, delay + half], abs=6e-5)


def test_applied_ranges_are_what_the_definitions_say(folder, page):
    with (folder / "applied" / "corrected.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for name, expected in {
        "raw_m": page.raw, "corrected_m": page.full, "sigma_m": page.sigma, "sigma_total_m": page.total,
        "mean_error_m": page.mean_error, "tail_share": page.tail_share,
    }.items():  # fmt: skip
        np.testing.assert_allclose([float(row[name]) for row in rows], expected, rtol=1e-9, atol=1e-9, err_msg=name)
    assert [row["clamped"] == "true" for row in rows] == page.clamped.tolist()
    stamps = [columns(folder / name / "exchanges.csv")["tx1"].tolist() for name in ("csv", "applied")]
    assert stamps[0] == stamps[1]


def to_program():
    """Both registers by tag: 44 and 56 % of the delay's ticks on top of what was programmed."""
    found = {}
    for tag, delay in DELAYS_NS.items():
        ticks, before = -delay * 1e-9 / TICK_S, KNOWN["antenna_delays"][tag]
        found[tag] = before["tx"] + 0.44 * ticks, before["rx"] + 0.56 * ticks, sum((before["tx"], before["rx"], ticks))
    return found


def test_exports_have_the_numbers(folder):
    text = yaml.safe_load(run(folder, "calib", "export", "c.json", "--to", "ros-yaml"))["uwb_calibration"]
    for tag, (tx, rx, both) in to_program().items():
        row = text["tags"][tag]
        assert row["delay_ns"] == DELAYS_NS[tag]
        assert row["tx_antenna_delay"] == pytest.approx(tx, abs=0.8)
        assert row["rx_antenna_delay"] == pytest.approx(rx, abs=1.01)
        assert row["tx_antenna_delay"] + row["rx_antenna_delay"] == pytest.approx(both, abs=0.501)
    for name in ("bias_curve", "sigma_curve"):
        assert text[name] == KNOWN[name]
    assert (text["alpha_dbm"], text["lift"], text["power_at"]) == (-82.0, "mean-of-lifted", "exchange")
    rows = list(csv.DictReader(run(folder, "calib", "export", "c.json", "--to", "csv").splitlines()))
    assert {row["tag"]: float(row["delay_ns"]) for row in rows} == DELAYS_NS
    assert {row["tag"]: float(row["delay_std_ns"]) for row in rows} == KNOWN["delays_std_ns"]
    miluv = json.loads(run(folder, "calib", "export", "c.json", "--to", "miluv"))
    assert miluv["delays_ns"] == DELAYS_NS
    for name, key in (("bias_spline_m", "bias_curve"), ("std_spline_m", "sigma_curve")):
        assert miluv[name] == {"knots": KNOTS, "coeffs": KNOWN[key]["coefficients"], "degree": 3}
    assert miluv["tx_rx_split"] == {"tx": 0.44, "rx": 0.56}


def test_the_errors_of_ros_yaml_are_what_the_model_says(folder, page):
    errors = yaml.safe_load(run(folder, "calib", "export", "c.json", "--to", "ros-yaml"))["uwb_calibration"]["errors"]
    assert errors["lifted"] == KNOWN["errors"]["lifted"]
    inside = ~page.clamped
    for pair in ("1-2", "2-3", "1-3"):
        table = errors["pairs"][pair if pair in errors["pairs"] else "other"]
        rows = (page.pair == pair) & inside
        for name, expected in (("low95_m", page.low95), ("high95_m", page.high95)):
            found = np.interp(page.lifted[rows], errors["lifted"], table[name])
            np.testing.assert_allclose(found, expected[rows], atol=1e-6)
        near = rows & (np.abs(page.lifted - 0.6) < 0.01)
        assert near.any()
        for name, expected in (
            ("sigma_total_m", page.total), ("mean_error_m", page.mean_error), ("tail_share", page.tail_share)
        ):  # fmt: skip
            assert table[name][1] == pytest.approx(expected[near].mean(), rel=0.01)
    assert calib.load_calibration(folder / "c.json").errors is not None
