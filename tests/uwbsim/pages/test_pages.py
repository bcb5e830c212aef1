"""Scenes, comparisons and sweeps as pages: their content, and their layout in a window."""

import csv
import json
import re
from itertools import pairwise

import numpy as np
import pytest

import uwbsim
from tests import pages, processes
from tests.browser import lies_well
from uwblink import PROTOCOLS
from uwblink.pages import figures
from uwblink.ticks import METRES_PER_TICK
from uwbsim.pages import write_sweep_page
from uwbsim.pages.figures import error_over, histograms, result_over_keys, room, timing
from uwbsim.protocols.comparison import ErrorCurve

BENCH = "two_boards_on_a_bench/bench"


@pytest.mark.parametrize("width", [3.5, 7.16])
def test_a_room_is_to_scale_within_its_walls(width):
    scenario = uwbsim.load("office/office")
    with figures.style():
        figure = room(width, scenario)
        figure.draw_without_rendering()
    low, high = np.array(scenario.room.min_m), np.array(scenario.room.max_m)
    scales = []
    for axes, (x, y) in zip(figure.axes, ((0, 1), (0, 2)), strict=True):
        assert axes.get_tightbbox().y0 > 0, "its label lies in the picture"
        box = axes.get_window_extent()
        scales += [box.width / np.ptp(axes.get_xlim()), box.height / np.ptp(axes.get_ylim())]
        for limits, k in ((axes.get_xlim(), x), (axes.get_ylim(), y)):
            assert limits[0] <= low[k]
            assert limits[1] >= high[k]
            assert np.ptp(limits) < 1.4 * (high - low)[k] + 0.8, "no more than the room"
    assert scales[:2] == pytest.approx([scales[0]] * 2, rel=1e-3), "a metre is as long along both axes"


@pytest.mark.parametrize("width", [3.5, 7.16])
@pytest.mark.parametrize("name", ["ss", "ds", "ds-alt", "ds-sym"])
def test_words_of_a_timing_diagram_do_not_cover_each_other(width, name):
    with figures.style():
        figure = timing(width, uwbsim.load(BENCH), name)
        figure.draw_without_rendering()
        boxes = [(t.get_text(), t.get_window_extent()) for t in figure.axes[0].texts if t.get_text()]
        edges = figure.bbox
    for k, (text, box) in enumerate(boxes):
        assert edges.x0 <= box.x0, text
        assert box.x1 <= edges.x1, text
        for other, its in boxes[k + 1 :]:
            assert not box.overlaps(its), (text, other)


@pytest.mark.parametrize("name", ["ss", "ds", "ds-alt", "ds-sym"])
def test_a_timing_diagram_has_every_interval_with_its_length(name):
    scenario = uwbsim.load(BENCH)
    drawn = figures.picture(lambda width: timing(width, scenario, name), "svg").decode()
    shown = re.findall(r"<text[^>]*>([^<]*)</text>", drawn)
    three = len(PROTOCOLS[name].messages) == 3
    named = {word[:4] for word in shown if word.startswith("dt")}
    assert named == ({"dt41", "dt32", "dt53", "dt64"} if three else {"dt41", "dt32"})
    lengths = {float(one) for word in shown for one in re.findall(r"^dt\d\d = ([\d.]+) µs", word)}
    reply_us = scenario.ranging.response_delay_uus * 1.0256410
    assert any(abs(length - reply_us) < 1 for length in lengths)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scene, and a comparison that replaces an older one, as written by commands."""
    folder = tmp_path_factory.mktemp("pages")
    processes.succeed("uwbsim", "show", "nlos_office/office", "-o", folder / "scene.html")
    (folder / "out").mkdir()
    (folder / "out" / "compare.csv").write_text("old")
    done = processes.succeed("uwbsim", "compare", BENCH, "-o", folder / "out", "-n", 300, "--force", "--json")
    (folder / "told.json").write_text(done.stdout)
    return folder


@pytest.mark.parametrize("width", [pytest.param(1280, marks=pytest.mark.slow), 390])
@pytest.mark.parametrize("name", ["scene", "out/compare"])
def test_pages_of_simulations_fit_into_windows(width, name, folder, tmp_path):
    page = (folder / f"{name}.html").read_text()
    lies_well(page, width, tmp_path)
    # Boards on a bench have one distance and one power, so no figure is drawn over these.
    assert (page.count("<figure>"), page.count("src='http")) == (5 if name == "scene" else 3, 0)
    assert ("log axis" in page) == ("logarithmic beyond" in page) == (name == "out/compare")


def test_comparisons_have_tables_and_json_and_replace_no_files(folder):
    said = json.loads((folder / "told.json").read_text())["protocols"]
    assert [row["protocol"] for row in said] == list(PROTOCOLS)
    assert {p.name for p in (folder / "out").iterdir()} == {"compare.html", "compare.csv", "compare.parquet"}
    with (folder / "out" / "compare.csv").open(newline="") as stream:
        assert [float(row["std_m"]) for row in csv.DictReader(stream)] == [row["std_m"] for row in said]
    processes.refuse("uwbsim", "compare", BENCH, "-o", folder / "out", "-n", 10, naming=["--force"])


def test_figures_for_papers_have_their_own_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "drawn", pages.outline)
    words = ["uwbsim", "compare", BENCH, "-n", 10, "--figures", tmp_path / "paper", "-o"]
    processes.succeed(*words, tmp_path / "out")
    names = ("errors", "over-relative-skew-of-the-clocks", "over-delay-of-the-scheduled-message")
    files = {f"{name}-{form}" for name in names for form in ("page.svg", "page.pdf", "column.svg", "column.pdf")}
    assert {path.name for path in (tmp_path / "paper").iterdir()} == files
    processes.refuse(*words, tmp_path / "new", naming=["paper", "--force"])
    assert not (tmp_path / "new").exists()


def test_protocols_far_apart_are_drawn_about_their_medians_and_whole_half_ticks_as_one_hill():
    half = METRES_PER_TICK / 2
    ticks = np.rint(np.random.default_rng(1).normal(0.0, 8.0, 20_000))
    shown = histograms(7.16, {"ss": 2.8 + half * ticks, "ds": 0.05 + half * (ticks + 0.3)}).axes[0]
    heights = shown.patches[0].get_data().values  # type: ignore[attr-defined]
    # A normal density of 8 half ticks changes by at most 8 % of its maximum over one; a double bin by all of it.
    assert np.abs(np.diff(heights)).max() < 0.2 * heights.max()
    # A much wider protocol fills the outermost bins, which do not flatten the others.
    drawn = histograms(7.16, {"ss": np.random.default_rng(2).normal(0.0, 2.0, 20_000), "ds": half * ticks}).axes[0]
    assert drawn.get_ylim()[1] < 8
    # 48.5 % of errors with 2 m are more than 7 cm on either side.
    assert {text.get_text() for text in drawn.texts} <= {"48 %", "49 %"}
    assert len(drawn.texts) == 2
    texts = [text.get_text() for text in shown.figure.legends[0].get_texts()]
    assert (texts, shown.get_xlabel()) == (
        ["ss, median +280.0 cm", "ds, median +5.1 cm"], "range error less its median (cm)"
    )  # fmt: skip
    assert histograms(7.16, {"ss": half * ticks, "ds": half * (ticks + 3)}).axes[0].get_xlabel() == "range error (cm)"


def judged(flight):
    """A quantity that increases with the varied key, and one that is constant."""
    return {"spread_m": float(np.std(flight.exchanges.range_m - flight.truth_m)), "same": 1.0, "word": "none"}


@pytest.mark.parametrize(
    ("kind", "more", "caption"),
    [
        ("'calibrate'", "", "Figure 1. spread (cm)."),
        pytest.param(
            "'calibrate'", "'radio.tx_noise_ps' = [0.0, 90.0]", "Figure 1. spread (cm).", marks=pytest.mark.slow
        ),
        ("'compare', ranges = 50", "", "Figure 3. bias (cm): mean error of raw ranges."),
    ],
)
def test_sweeps_draw_their_results_with_labels(tmp_path, kind, more, caption):
    head = f"sweep = {{ scenario = '{BENCH}', kind = {kind}, protocols = ['ds'], seeds = 3 }}"
    (tmp_path / "plan.toml").write_text(f"{head}\n[vary]\n'radio.rx_noise_ps' = [50.0, 100.0, 200.0]\n{more}\n")
    design = uwbsim.load_design(tmp_path / "plan.toml")
    uwbsim.run_sweep(design, tmp_path / "out", workers=1, evaluate=judged if "calibrate" in kind else None)
    page = write_sweep_page(design, tmp_path / "out").read_text()
    captions = re.findall("<figcaption>(.*?)</figcaption>", page)
    assert caption in captions
    assert len(captions) == (1 if "calibrate" in kind else 3)
    assert ("rx noise (ps)" in page, "3 seeds each" in page) == (True, True)
    assert ("Not drawn: median_m, low_m, high_m" in page) == ("compare" in kind)


def test_bands_over_seeds_reach_from_the_least_to_the_largest():
    result = np.array([1.0, 2.0, 9.0, 4.0, 5.0, 6.0])
    figure = result_over_keys(7.16, {"key": [1.0] * 3 + [2.0] * 3}, ["ds"] * 6, result, "figure")
    band = figure.axes[0].collections[0].get_paths()[0].vertices
    assert {(x, y) for x, y in band.tolist()} >= {(1.0, 1.0), (1.0, 9.0), (2.0, 4.0), (2.0, 6.0)}
    assert figure.axes[0].lines[0].get_ydata().tolist() == [2.0, 5.0]


def test_two_keys_make_a_map_of_medians_over_seeds():
    keys: dict[str, list[object]] = {"a": [1.0, 1.0, 2.0, 2.0] * 2, "b": [10.0, 20.0] * 4}
    result = np.array([1.0, 2.0, 300.0, 4.0, 3.0, 4.0, 500.0, 2020.0])
    (axes,) = result_over_keys(7.16, keys, ["ds"] * 8, result, "figure").axes
    assert axes.collections[0].get_array().tolist() == [[2.0, 400.0], [3.0, 1012.0]]
    numbers = {text.get_position(): text.get_text() for text in axes.texts}
    assert numbers == {(0, 0): "2.00", (1, 0): "400", (0, 1): "3.00", (1, 1): "1012"}


def test_words_and_many_keys_are_drawn_key_by_key():
    keys: dict[str, list[object]] = {"a": [1.0, 2.0] * 4, "b": ["x", "y", "y", "x"] * 2, "c": list(range(8))}
    figure = result_over_keys(3.5, keys, ["ds", "ss"] * 4, np.arange(8.0), "figure")
    assert (len(figure.axes), [t.get_text() for t in figure.axes[1].get_xticklabels()]) == (3, ["x", "y"])


@pytest.mark.parametrize("x", [np.linspace(-90.1, -69.7, 12), np.linspace(-20.0, 20.0, 12)])
def test_numbers_along_an_axis_do_not_cover_each_other(x):
    flat = np.ones(12)
    curve = ErrorCurve(x=x, bias_m=flat, std_m=flat, predicted_bias_m=flat, predicted_std_m=flat)
    with figures.style():
        figure = error_over(7.16, {"ss": curve}, "first-path power (dBm)")
        figure.draw_without_rendering()
        boxes = [[t.get_window_extent() for t in axes.get_xticklabels()] for axes in figure.axes]
    for one in boxes:
        assert len(one) >= 4
        assert all(left.x1 + 2 < right.x0 for left, right in pairwise(one))


def test_warnings_are_below_the_table_of_pairs():
    warned = [line.startswith("warning:") for line in str(uwbsim.preview("nlos_office/office")).splitlines()]
    assert any(warned)
    assert warned == sorted(warned)
