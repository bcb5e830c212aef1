"""A campaign from Python: what the command makes, and sections of one's own."""

import json
import re
from dataclasses import replace

import pytest

import calib
from calib.data.samples import sample_flight
from calib.report import Heading, Text
from calib.report.sections import SECTIONS
from tests import processes
from uwblink.recording.file import Recording


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("campaign")
    for name, seed in (("train", 1), ("test", 2)):
        flight = sample_flight(seed=seed)
        with Recording.create(folder / f"{name}.uwb", meta={"planted": flight.planted}) as recording:
            recording.append_tags(flight.tags)
            recording.append_poses(flight.poses)
            recording.append_exchanges(flight.exchanges)
    return folder


@pytest.fixture
def opened(monkeypatch):
    """The names of recordings, as they are opened."""
    names, whole = [], Recording.open

    def noted(path, **kwargs):
        names.append(path.name)
        return whole(path, **kwargs)

    monkeypatch.setattr(Recording, "open", noted)
    return names


def test_it_is_what_the_command_makes(recordings, tmp_path, opened):
    told: list[str] = []
    campaign = calib.run_campaign(recordings / "train.uwb", recordings / "test.uwb", loss="huber", progress=told.append)
    assert opened == ["train.uwb", "test.uwb"], "each is opened once, and looked at whole whenever it is opened"
    campaign = replace(campaign, origin=replace(campaign.origin, files={}))
    campaign.write(tmp_path / "python.html")
    words = ["report", "train.uwb", "--tests", "test.uwb", "-o", "command.html", "--loss", "huber", "--json"]
    done = processes.run("calib", *words, cwd=recordings)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == json.loads(json.dumps(campaign.to_dict()))
    pages = [(tmp_path / "python.html").read_text(), (recordings / "command.html").read_text()]
    # When, by which command, and from which files is not the same.
    texts = [re.sub(r"<p class='note'>Made.*?</p>|[0-9a-f]{12}|in memory", "", page) for page in pages]
    assert len({text[: text.index(">Provenance</h2>")] for text in texts}) == 1
    assert told == ["loading", "fitting", "examining", "localizing"]
    assert len(campaign.refits) == 7
    assert len(campaign.tracks) == 3
    assert repr(campaign).splitlines()[-1] == "judged on test.uwb"


def test_ranges_alone_are_fitted_and_judged(recordings):
    campaign = calib.run_campaign(calib.load_ranges(recordings / "train.uwb"), loss="l2")
    assert campaign.findings == []
    assert campaign.tracks == []
    assert campaign.judged is not None
    assert campaign.evaluation.overall.full.n == 900


def test_a_mistake_is_found_before_anything_is_written(recordings, tmp_path):
    (tmp_path / "mine.html").write_text("mine")
    campaign = calib.run_campaign(calib.load_ranges(recordings / "train.uwb"), loss="l2")
    with pytest.raises(FileExistsError):
        campaign.write(tmp_path / "r.html", tmp_path / "mine.html")
    with pytest.raises(calib.BadInputError, match="`figures`"):
        campaign.write(tmp_path / "r.html", figures=tmp_path / "mine.html")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.html"]


def weather(campaign):
    return [Heading("Weather"), Text(f"Dry over {len(campaign.judged)} ranges; <wet> tomorrow.")]


@pytest.fixture
def own_section():
    before = dict(SECTIONS)
    calib.register_report_section("weather", weather, before="outliers")
    yield
    SECTIONS.clear()
    SECTIONS.update(before)


def test_a_section_of_ones_own_is_in_the_report(recordings, tmp_path, own_section):
    ranges = calib.load_ranges(recordings / "train.uwb")
    calib.run_campaign(ranges, loss="l2").write(tmp_path / "r.html", tmp_path / "r.pdf")
    page = (tmp_path / "r.html").read_text()
    titles = re.findall("<h2 id='s[0-9]+'>(.*?)</h2>", page)
    assert titles[titles.index("Weather") + 1] == "Outliers"
    assert "Dry over 900 ranges; &lt;wet&gt; tomorrow." in page
    assert (tmp_path / "r.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(
    ("name", "section", "before", "parameter"),
    [
        ("outliers", weather, "provenance", "name"),
        ("weather", weather, "nowhere", "before"),
        ("weather", "text", "provenance", "section"),
    ],
)
def test_a_section_that_cannot_be_one_is_refused(name, section, before, parameter):
    with pytest.raises(calib.BadInputError) as caught:
        calib.register_report_section(name, section, before=before)
    assert caught.value.parameter == parameter
    assert "weather" not in SECTIONS


@pytest.mark.parametrize("blocks", [None, ["text"], "text"])
def test_a_section_that_returns_no_blocks_is_named(recordings, tmp_path, blocks):
    before = dict(SECTIONS)
    calib.register_report_section("weather", lambda campaign: blocks)
    try:
        campaign = calib.run_campaign(calib.load_ranges(recordings / "train.uwb"), loss="l2")
        with pytest.raises(calib.BadInputError, match="report section 'weather'"):
            campaign.write(tmp_path / "r.html")
    finally:
        SECTIONS.clear()
        SECTIONS.update(before)
    assert list(tmp_path.iterdir()) == []
