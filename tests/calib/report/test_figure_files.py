"""Figures of commands without a report, PDF where the name says so, and nothing that takes another's place."""

import shutil

import pytest

import calib
from calib.data.samples import sample_flight
from calib.report import Picture, check_places
from tests import processes
from uwblink.pages.blocks import Document, write_document
from uwblink.pages.figures import sheet
from uwblink.recording.file import Recording


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("figures")
    flight = sample_flight(seed=1)
    with Recording.create(folder / "a.uwb", meta={"planted": flight.planted}) as recording:
        recording.append_tags(flight.tags)
        recording.append_poses(flight.poses)
        recording.append_exchanges(flight.exchanges)
    for name, seed in (("a", 1), ("b", 2)):
        calib.fit(sample_flight(seed=seed), loss="huber").calibration.save(folder / f"{name}.json")
    return folder


def run(folder, *words, status=0):
    done = processes.run("calib", *words, cwd=folder)
    assert done.returncode == status, done.stderr
    return done


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (["evaluate", "a.uwb", "-c", "b.json"], {"delays", "errors", "bias", "sigma", "residuals", "over-time-1"}),
        (["localize", "a.uwb", "-c", "b.json", "--seeds", "1"], {"rmse", "track-a-robot1", "track-a-robot3"}),
        (["compare", "a.json", "b.json"], {"differences", "curves"}),
    ],
)
def test_commands_draw_what_they_find(folder, words, names):
    shutil.rmtree(folder / "out", ignore_errors=True)
    run(folder, *words, "--figures", "out")
    written = {path.name for path in (folder / "out").iterdir()}
    assert {
        f"{name}-{width}.{kind}" for name in names for width in ("column", "page") for kind in ("pdf", "svg")
    } <= written
    again = run(folder, *words, "--figures", "out", status=2)
    assert "out holds figures already" in again.stderr
    assert "--force" in again.stderr
    assert len(again.stderr.splitlines()) == 1


def test_a_name_that_ends_in_pdf_is_a_pdf(folder):
    run(folder, "evaluate", "a.uwb", "-c", "b.json", "--report", "r.pdf")
    assert (folder / "r.pdf").read_bytes().startswith(b"%PDF")
    done = run(folder, "report", "a.uwb", "-o", "same.pdf", "--pdf", "same.pdf", "--loss", "huber", status=2)
    assert "same.pdf" in done.stderr
    assert "another name" in done.stderr
    assert not (folder / "same.pdf").exists()


def test_the_report_says_its_command_and_its_files(folder):
    run(folder, "evaluate", "a.uwb", "-c", "b.json", "--report", "r.html")
    page = (folder / "r.html").read_text()
    assert "calib evaluate a.uwb -c b.json --report r.html" in page
    assert page.count("SHA-256 ") == 2, "of the recording and of the calibration"


def test_figures_of_one_name_do_not_take_each_others_files(tmp_path):
    def draw(width_in):
        return sheet(width_in)[0]

    pictures = [Picture("same", draw, text) for text in ("one", "two")]
    write_document(Document("", [*pictures]), None, figures=tmp_path / "f")
    assert {path.name.rpartition("-")[0] for path in (tmp_path / "f").iterdir()} == {"same", "same-2"}


def test_a_place_is_checked_before_anything_is_computed(tmp_path):
    with pytest.raises(calib.BadInputError, match="another name"):
        check_places(tmp_path / "a.pdf", tmp_path / "a.pdf", None, force=True)
