"""Every block of code on every page of the documentation works, or states why it is not run."""

import json
import shutil

import matplotlib as mpl
import pytest
from matplotlib import pyplot

from tests import pages
from uwblink.pages import figures

mpl.use("Agg")


@pytest.fixture(scope="session")
def recordings(tmp_path_factory):
    """A folder as assumed by the pages: the repository's files, two flights and a calibration."""
    folder = tmp_path_factory.mktemp("pages")
    for name in ("scenarios", "docs"):
        (folder / name).symlink_to(pages.ROOT / name)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for line in (
            "uwbsim run scenarios/icra2023/train.toml -o train.uwb --set run.duration_s=12",
            "uwbsim run scenarios/icra2023/test1.toml -o test.uwb --set run.duration_s=8",
            "calib fit train.uwb -o calibration.json",
        ):
            pages.command(line)
    return folder


RUN = [page for page in pages.pages() if any(not block.mark for block in pages.blocks(page))]


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN, ids=lambda page: str(page.relative_to(pages.DOCS)))
def test_the_blocks_of_a_page_work(page, recordings, tmp_path, monkeypatch):
    for name in ("scenarios", "docs"):
        (tmp_path / name).symlink_to(pages.ROOT / name)
    for name in ("train.uwb", "test.uwb", "calibration.json"):
        shutil.copyfile(recordings / name, tmp_path / name)
    if page.parent == pages.DOCS:
        shutil.copyfile(recordings / "test.uwb", tmp_path / "flight.uwb")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(figures, "drawn", pages.outline)
    runner = pages.Runner()
    for block in pages.blocks(page):
        if block.mark:
            continue
        try:
            runner.run(block)
        except Exception as error:
            raise AssertionError(f"{page.name}, line {block.line}: {error}") from error


@pytest.mark.slow
@pytest.mark.parametrize("notebook", sorted(pages.DOCS.glob("notebooks/*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_runs_and_its_file_holds_no_outputs(notebook, monkeypatch):
    monkeypatch.chdir(notebook.parent)
    runner = pages.Runner()
    cells = [cell for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
    for cell in cells:
        runner.run(pages.Block("python", "", "".join(cell["source"]), 1, "", ""))
    assert [cell["outputs"] for cell in cells] == [[]] * len(cells), "the site's build runs it"
    pyplot.close("all")


def test_blocks_that_are_not_run_say_why():
    for page in pages.pages():
        for block in pages.blocks(page):
            if block.mark == "not run":
                assert len(block.reason) > 12, f"{page.name}, line {block.line}"
            elif block.mark == "run by":
                assert (pages.ROOT / block.reason).exists(), f"{page.name}, line {block.line}: {block.reason}"


def test_a_page_with_other_words_than_printed_is_found():
    pages.compare("tag 1  delay -0.43 ns\ntag 2  delay 0.1 ns\n", "tag 1 delay -0.41 ns\n")
    pages.compare("a 1\nb 2\nc 3\n", "a 9\n...\nc 9\n")
    with pytest.raises(AssertionError, match="the page shows"):
        pages.compare("tag 1  delay -0.43 ns\n", "tag 1 antenna -0.43 ns\n")


def test_every_page_is_in_the_table_of_contents():
    listed = (pages.DOCS / "index.md").read_text(encoding="utf-8")
    missing = [str(p.relative_to(pages.DOCS).with_suffix("")) for p in pages.pages() if p.name != "index.md"]
    assert [name for name in missing if f"\n{name}\n" not in listed] == []
