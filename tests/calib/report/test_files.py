"""Reports, plans and figures as files: from Python and from commands, with registered sections, and as PDF."""

import io
import json
import re
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from pypdf import PdfReader

import calib
from calib.report import Heading, Picture, Table, Text, check_places
from calib.report.figures import arrangement
from calib.report.sections import SECTIONS
from tests import pages
from tests.processes import refuse, succeed
from uwblink import Recording, UwblinkError
from uwblink.pages import figures
from uwblink.pages.blocks import Document, to_html, write_document
from uwblink.pages.pdf import to_pdf

FORMS = {f"{width}.{kind}" for width in ("column", "page") for kind in ("pdf", "svg")}
FONTS = {"/Type0", "/CIDFontType2", "/TrueType"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two flights and a calibration of each."""
    folder = tmp_path_factory.mktemp("reports")
    for name, seed in (("a", 1), ("b", 2)):
        flight = calib.sample_flight(seed=seed)
        replace(flight, meta={}).save(folder / f"{name}.uwb")
        calib.fit(flight, loss="huber").calibration.save(folder / f"{name}.json")
    return folder


@pytest.fixture
def sections(monkeypatch):
    """The sections without figures, whose drawing takes seconds."""
    few = {name: SECTIONS[name] for name in ("verdict", "warnings", "recordings", "determined", "provenance")}
    monkeypatch.setattr("calib.report.sections.SECTIONS", few)
    return few


@pytest.mark.slow
def test_a_campaign_is_what_the_command_makes(folder, tmp_path, monkeypatch, sections):
    # Figures are rendered in test_report.py.
    monkeypatch.setattr(figures, "drawn", pages.outline)
    sections |= {"delays": SECTIONS["delays"]}
    opened, whole = [], Recording.open

    def noted(path, **kwargs):
        opened.append(path.name)
        return whole(path, **kwargs)

    monkeypatch.setattr(Recording, "open", noted)
    told: list[str | float] = []
    campaign = calib.run_campaign(folder / "a.uwb", folder / "b.uwb", loss="huber", progress=told.append)
    assert opened == ["a.uwb", "b.uwb"], "each is opened once, and looked at whole whenever it is opened"
    assert (told[::2], len(campaign.tracks)) == (["loading", "fitting", "examining", "localizing"], 3)
    assert repr(campaign).splitlines()[-1] == "judged on b.uwb"
    campaign = replace(campaign, origin=replace(campaign.origin, files={}))
    campaign.write(tmp_path / "python.html", progress=told.append)
    # The time left follows from the finished share of fit and drawing together.
    shares = [one for one in told if not isinstance(one, str)]
    assert (shares, shares[0], sum(share >= 0.65 for share in shares)) == (sorted(set(shares)), 0.0, 1)
    assert [one for one in told if isinstance(one, str)][4:] == ["drawing delays", "writing the page"]
    words = "calib report a.uwb --tests b.uwb -o command.html --loss huber --json --figures drawn"
    assert json.loads(succeed(*words.split(), cwd=folder).stdout) == json.loads(json.dumps(campaign.to_dict()))
    assert {path.name for path in (folder / "drawn").iterdir()} == {f"delays-{form}" for form in FORMS}

    made = [(tmp_path / "python.html").read_text(), (folder / "command.html").read_text()]
    # Time, command and files differ.
    texts = [re.sub(r"<p class='note'>Made.*?</p>|[0-9a-f]{12}|in memory", "", page) for page in made]
    assert len({text[: text.index(">Provenance</h2>")] for text in texts}) == 1


@pytest.fixture(scope="module")
def campaign(folder):
    return calib.run_campaign(calib.load_ranges(folder / "a.uwb"), loss="l2")


def test_ranges_are_fitted_and_evaluated(campaign, tmp_path):
    assert (campaign.findings, campaign.tracks) == ([], [])
    assert (len(campaign.training[0]), campaign.evaluation.overall.full.n) == (900, 270)
    mine = tmp_path / "mine.pdf"
    mine.write_text("mine")
    for outputs, error in (({"pdf": mine}, FileExistsError), ({"figures": mine}, UwblinkError)):
        with pytest.raises(error, match=r"mine\.pdf"):
            campaign.write(tmp_path / "r.html", **outputs)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.pdf"]


def test_recordings_of_one_name_have_the_digests_of_both_files(campaign, tmp_path):
    files = {"first/a.uwb": "1" * 64, "second/a.uwb": "2" * 64}
    replace(campaign, origin=replace(campaign.origin, files=files)).write(tmp_path / "r.html")
    assert f"{'1' * 12} or {'2' * 12}" in (tmp_path / "r.html").read_text()


@pytest.mark.usefixtures("sections")
def test_without_tests_errors_are_those_of_held_out_ranges(campaign, folder, tmp_path):
    """The fourth, seventh and last tenth of the time evaluate a fit to the others; delays are those of a fit to all."""
    whole = calib.load_ranges(folder / "a.uwb")
    tenth = 10 * (whole.time_ns - whole.time_ns[0]) // (whole.time_ns[-1] - whole.time_ns[0])
    held = np.isin(tenth, [3, 6, 9, 10])
    part = calib.fit(whole[~held], loss="l2").calibration
    errors = part.apply(whole[held]).corrected_m - whole.truth_m[held]
    assert campaign.evaluation.overall.full.median_m == pytest.approx(np.median(errors), abs=1e-12)
    assert campaign.calibration.delays_ns == calib.fit(whole, loss="l2").calibration.delays_ns != part.delays_ns
    campaign.write(tmp_path / "r.html")
    words = f"Over {held.sum()} ranges that were held out", "30 % of the same recordings", "Settings: loss = l2"
    assert [one for one in words if one not in (tmp_path / "r.html").read_text()] == []


def test_too_few_ranges_are_evaluated_on_themselves(folder):
    """Pair 1-3 has ranges only in the last tenth, which would be held out."""
    whole = calib.load_ranges(folder / "a.uwb")
    late = np.arange(len(whole)) >= 0.9 * len(whole)
    few = whole[late | (whole.initiator + whole.target == 3)]
    campaign = calib.run_campaign(few, loss="l2")
    assert (campaign.part, campaign.evaluation.overall.full.n) == (None, len(few))
    with pytest.raises(calib.UnanswerableError):
        calib.run_campaign(few, loss="l2", hold_out=0.3)


@pytest.mark.slow
@pytest.mark.usefixtures("sections")
def test_undetermined_delays_are_one_warning():
    """One tag ranges with all others."""
    flights = [calib.sample_flight(seed=seed) for seed in (1, 2)]
    one, other = (replace(some, exchanges=some.exchanges[some.exchanges.initiator == 1]) for some in flights)
    assert [found.fault for found in calib.examine(other)] == ["too few pairs"]
    campaign = calib.run_campaign(one, tests=other, loss="huber")
    assert (campaign.findings, "are determined" in "".join(campaign.fit.warnings)) == ([], True)


def weather(campaign):
    return [Heading("Weather"), Text(f"Dry over {len(campaign.judged)} ranges; <wet> tomorrow.")]


def fonts_of(resources):
    """Return the kinds of all fonts in some resources, forms included."""
    fonts = [font.get_object() for font in (resources.get("/Font") or {}).values()]
    inner = [one.get_object() for font in fonts for one in font.get("/DescendantFonts", [])]
    objects = [one.get_object() for one in (resources.get("/XObject") or {}).values()]
    forms = [one["/Resources"].get_object() for one in objects if "/Resources" in one]
    return {font["/Subtype"] for font in fonts + inner}.union(*map(fonts_of, forms))


def test_registered_sections_are_in_the_report(campaign, tmp_path, sections):
    sections |= {"delays": SECTIONS["delays"]}
    calib.register_report_section("weather", weather, before="determined")
    campaign.write(tmp_path / "r.html", tmp_path / "r.pdf")
    page, printed = (tmp_path / "r.html").read_text(), PdfReader(tmp_path / "r.pdf")
    titles = re.findall("<h2 id='s[0-9]+'>(.*?)</h2>", page)
    assert titles[titles.index("Weather") + 1] == "Are the delays determined?"
    assert "Dry over 270 ranges; &lt;wet&gt; tomorrow." in page
    outline: list[Any] = printed.outline
    begin = {item["/Title"]: printed.get_destination_page_number(item) for item in outline}
    assert list(begin) == titles
    sizes: set[float] = set()

    def seen(text, cm, tm, font, size):
        if text.strip():
            sizes.add(size * abs(tm[3] or tm[1]) * abs(cm[3] or cm[1]))

    texts = [one.extract_text(visitor_text=seen) for one in printed.pages]
    assert min(sizes) >= 7.99, "no text is smaller than 8 pt"
    assert all(name in texts[place] for name, place in begin.items())
    assert all(f"{number} / {len(texts)}" in text for number, text in enumerate(texts, 1))
    assert any("antenna delay (ns)" in text for text in texts), "the words inside a figure are words"
    numbered = [int(number) for number in re.findall(r"Figure (\d+)\.", "\n".join(texts))]
    assert numbered == list(range(1, len(numbered) + 1))
    # Outlines that printers accept: type 42; publishers refuse type 3.
    assert set[str]().union(*(fonts_of(one["/Resources"]) for one in printed.pages)) <= FONTS


@pytest.mark.slow
@pytest.mark.usefixtures("sections")
def test_the_command_writes_a_pdf(folder, tmp_path):
    succeed("calib", "report", folder / "a.uwb", "--loss", "huber", "-o", "r.html", "--pdf", "r.pdf", cwd=tmp_path)
    assert "Provenance" in "".join(page.extract_text() for page in PdfReader(tmp_path / "r.pdf").pages)


@pytest.mark.parametrize(
    ("name", "section", "before", "parameter"),
    [
        ("determined", weather, "provenance", "name"),
        ("weather", weather, "nowhere", "before"),
        ("weather", "text", "provenance", "section"),
    ],
)
def test_wrong_sections_are_refused(name, section, before, parameter, sections):
    with pytest.raises(calib.BadInputError, match=f"^`{parameter}`"):
        calib.register_report_section(name, section, before=before)
    assert "weather" not in sections


@pytest.mark.parametrize("blocks", [None, ["text"], "text"])
def test_a_section_that_returns_no_blocks_is_named(campaign, tmp_path, blocks, sections):
    calib.register_report_section("weather", lambda campaign: blocks)
    with pytest.raises(calib.BadInputError, match="weather"):
        campaign.write(tmp_path / "r.html")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "names"),
    [
        (["localize", "a.uwb", "-c", "b.json", "--seeds", "1"], {"rmse", "track-a-robot1", "track-a-robot3"}),
        (["compare", "a.json", "b.json"], {"differences", "curves"}),
        (["evaluate", "a.uwb", "-c", "b.json"], {"delays"}),
    ],
)
def test_commands_draw_results_and_replace_no_files(folder, tmp_path, words, names, sections, monkeypatch):
    # Figures of a report are rendered in test_report.py.
    monkeypatch.setattr(figures, "drawn", pages.outline)
    sections |= {"delays": SECTIONS["delays"]}
    command = ("calib", *words, "--figures", tmp_path / "out")
    succeed(*command, cwd=folder)
    assert {f"{name}-{form}" for name in names for form in FORMS} <= {
        path.name for path in (tmp_path / "out").iterdir()
    }
    refuse(*command, cwd=folder, naming=["out already contains figures"])


def test_reports_do_not_replace_files(folder, tmp_path):
    for named, *more in (
        ("same.pdf", "-o", "same.pdf", "--pdf", "same.pdf"),
        ("report.txt: found .txt, expected .html or .htm or .pdf", "-o", "report.txt"),
    ):
        refuse("calib", "report", "a.uwb", *more, "--loss", "huber", cwd=folder, naming=[named])
        assert not (folder / more[1]).exists()
    with pytest.raises(calib.BadInputError, match=r"a\.pdf"):
        check_places(tmp_path / "a.pdf", tmp_path / "a.pdf", None, force=True)
    pictures = [Picture("same", lambda width: figures.sheet(width)[0], text) for text in ("one", "two")]
    write_document(Document("", [*pictures]), None, figures=tmp_path / "f")
    expected = {f"{name}-{form}" for name in ("same", "same-2") for form in FORMS}
    assert {path.name for path in (tmp_path / "f").iterdir()} == expected


def words_of(svg):
    return re.findall(r"<text[^>]*>([^<]*)</text>", svg)


@pytest.mark.slow
def test_plans_have_a_figure_of_each_arrangement(tmp_path):
    words = ("calib", "plan", "survey", "7,12,3", "--on", "line", "--arrangements", 2, "--taped", 1, "-o", "plan.html")
    succeed(*words, "--figures", "f", cwd=tmp_path)
    page, files = (tmp_path / "plan.html").read_text(), {path.name for path in (tmp_path / "f").iterdir()}
    assert files == {f"{name}-{form}" for name in ("arrangement-A", "arrangement-B", "more") for form in FORMS}
    drawn = [words_of((tmp_path / "f" / f"arrangement-{name}-page.svg").read_text()) for name in "AB"]
    # Once on the line, once below their bars.
    assert all(words.count(tag) == 2 for words in drawn for tag in ("7", "12", "3"))
    assert sum("distance to tape" in words for words in drawn) == 1
    assert "open" in drawn[0]
    assert {"Step 2: arrangement B", "before it"} <= set(drawn[1])
    assert "Step 2: arrangement B" in page
    assert "calib survey A.uwb B.uwb --known known.toml" in page
    refuse(*words, cwd=tmp_path, naming=["plan.html"])
    assert (tmp_path / "plan.html").read_text() == page


def test_plans_in_space_are_drawn_with_heights():
    plan = calib.plan(5, on="space", arrangements=1)
    words = words_of(figures.picture(partial(arrangement, plan=plan, number=0), "svg").decode())
    assert "height (m)" in words
    assert words.count("5") >= 3


@pytest.mark.slow
def test_planned_flights_have_figures_of_path_intervals_and_gains(tmp_path):
    words = "plan flight 2 --duration 8 --rate 40 --anchor-tags 11,12,13,14 --anchors sought --poses-until 4"
    succeed("calib", *words.split(), "-o", "plan.html", cwd=tmp_path)
    text = (tmp_path / "plan.html").read_text(encoding="utf-8")
    assert {"anchor12", "stays open", "+ measured positions of the anchors"} <= set(words_of(text))


def paper(*blocks):
    read = PdfReader(io.BytesIO(to_pdf(Document("A report", list(blocks)), {})))
    return [page.extract_text() for page in read.pages]


def test_lines_of_a_remedy_stay_lines():
    remedy = Text("The ranges give\n[[tags]]\nid = 2", "warning")
    assert "The ranges give<br/>[[tags]]<br/>id = 2" in to_html(Document("", [remedy]))
    assert "The ranges give\n[[tags]]\nid = 2" in paper(remedy)[0]


def table(rows, above=()):
    return Table(["pair", "mean"], [[f"row-{k}", "1.0"] for k in range(rows)], list(above), total=True)


# Numbers of lines for which the table ends shortly below the page, begins shortly above its end, or fits.
# Numbers of lines for which the table ends shortly below the page, begins shortly above its end, or fits.
@pytest.mark.parametrize(("filled", "told"), [(18, []), (24, [Text("What the table shows.")]), (44, [])])
def test_pdf_tables_are_on_one_page_with_their_heading(filled, told):
    lines = [Text(f"A line of text, the {k}th.") for k in range(filled)]
    text = paper(*lines, Heading("Before"), *told, table(16, [("", 1), ("raw", 1)]))
    (page,) = [one for one in text if re.search(r"row-(0|15)\b", one)]  # all rows stand on one page
    assert sum(one.count("Before") for one in text) == 1
    assert told or "Before" in page


def test_long_and_wide_pdf_tables_are_divided():
    first, *others = paper(Text("A line of text."), Heading("Before"), table(120))
    assert re.search(r"row-0\b", first)
    assert len(others) == 2
    assert all("pair" in page for page in others), "headings come again"
    heads, cells = ([f"{kind}-{k}" for k in range(20)] for kind in ("column", "cell"))
    (text,) = paper(Table(["pair", *heads], [["1-2", *cells]]))
    found = re.findall(r"(?:column|cell)-\d+", text)
    assert found.count("column-19") == 1
    assert set(found) >= set(cells)
    assert text.count("1-2") >= 2, "each part has the first column"
