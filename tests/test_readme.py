"""The commands and the script of the README, and the commands for boards, run as written."""

import json
import os
import re
import signal
import subprocess
import sys
import tomllib
from contextlib import contextmanager

import numpy as np
import pytest

from tests import pages, processes

README = (pages.ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = pages.blocks(pages.ROOT / "README.md")
BOARDS = {block.label: [*pages.lines(block.code)] for block in pages.blocks(pages.DOCS / "boards.md")}
SCRIPT = (pages.DOCS / "examples" / "first_calibration.py").read_text(encoding="utf-8")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working folder as assumed by the README."""
    for name in ("scenarios", "docs"):
        (tmp_path / name).symlink_to(pages.ROOT / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.usefixtures("folder")
def test_the_commands_and_the_lines_of_python_of_the_readme_print_what_it_says():
    runner, numbers = pages.Runner(), re.compile(r"[+-]?\d+\.\d+")
    assert [block.language for block in BLOCKS] == ["sh", "text", "python", "text"]
    for block in BLOCKS:
        runner.run(block)
        if block.language == "text":
            (said,) = (line for line in block.code.splitlines() if line != pages.LEFT)
            (printed,) = (line for line in runner.printed.splitlines() if pages.masked(line) == pages.masked(said))
            for one, other in zip(numbers.findall(printed), numbers.findall(said), strict=True):
                digit = 10.0 ** -len(one.partition(".")[2])  # versions of libraries change last digits of results
                assert float(one) == pytest.approx(float(other), abs=1.5 * digit), (printed, said)


def test_figures_of_real_flights_are_those_of_their_page():
    page = (pages.DOCS / "real-data.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines() if line.startswith("| ")]
    found = {(row[0], row[1]): [float(cell or "nan") for cell in row[2:]] for row in rows if row[0] in ("s2", "half2")}
    text = README.replace("−", "-")
    raw, ours, authors = found["s2", "none"], found["s2", "ours, by s1"], found["s2", "authors'"]
    for pattern, expected in (
        (
            r"changes from (\S+) to (\S+) cm, (\d+) % of the ranges .* error falls from (\S+) to (\S+) m",
            [raw[1], ours[1], round(ours[3]), raw[4], ours[4]],
        ),
        (
            r"STAR-loc, other flight: .*\| (\S+) cm, (\S+) cm, (\S+) % .* (\S+) cm, (\S+) cm, (\S+) % \|",
            [*ours[1:4], *authors[1:4]],
        ),
        (
            r"paper's samples, other half: .*\| (\S+) cm, (\S+) % \| (\S+) cm, (\S+) % \|",
            [*found["half2", "ours, by half1"][2:4], *found["half2", "authors'"][2:4]],
        ),
    ):
        (numbers,) = re.findall(pattern, text)
        assert [*map(float, numbers)] == expected


@pytest.mark.slow
def test_the_script_that_the_readme_names_simulates_fits_corrects_and_judges(folder):
    assert len(SCRIPT.splitlines()) <= 25
    runner = pages.Runner()
    runner.run(pages.Block("python", "", SCRIPT, 1, "", ""))
    assert (folder / "bias.png").stat().st_size > 5000
    assert (folder / "first.json").exists()
    range_m, sigma_m = map(float, re.search(r"3.21 m corrected: (\S+) m, .* (\S+) m", runner.printed).groups())
    first_m = float(re.search(r"^\[ *(\S+) +\S+ +\S+ *\]$", runner.printed, flags=re.MULTILINE)[1])
    # The first of the array has the same range, and both powers where the single one has its first: some millimetres
    # apart.
    assert abs(first_m - range_m) < 0.03
    assert 0.03 < sigma_m < 0.15
    raw, full = (
        tuple(map(float, re.search(rf"{name} +mean (\S+) cm.*deviation (\S+) cm", runner.printed).groups()))
        for name in ("raw", "corrected")
    )
    # As in the flights of the paper: reflections keep the mean above zero, and the spread decreases to that of the
    # noise.
    assert abs(full[0]) < 0.6 * abs(raw[0])
    assert full[1] < 0.9 * raw[1]


@contextmanager
def serving(folder, label, *files):
    """Run a server of the page in a folder until the block ends; `files` exist when it starts."""
    (serve,) = BOARDS[label]
    words = serve.split()
    server = subprocess.Popen([processes.BIN / words[0], *words[1:]], cwd=folder, stdout=subprocess.DEVNULL)
    try:
        processes.wait_until(lambda: all((folder / name).exists() for name in files), server)
        yield
    finally:
        server.send_signal(signal.SIGINT)
        assert server.wait(30) == 0


@pytest.mark.slow
def test_the_commands_for_boards_work_on_served_ones(folder):
    (script,) = (b.code for b in pages.blocks(pages.DOCS / "boards.md") if "ports/tag10" in b.code and not b.label)
    with serving(folder, "serve", "poses.csv", "ports/tag20"):
        assert len(BOARDS["boards"]) >= 8
        for command in BOARDS["boards"]:
            processes.succeed(*command.split(), cwd=folder)
        done = subprocess.run([sys.executable, "-c", script], cwd=folder, capture_output=True, text=True)
        assert 2 < float(done.stdout) < 4
    assert not os.path.lexists(folder / "ports" / "tag10")
    assert (folder / "cir.png").stat().st_size > 1000


@pytest.mark.slow
def test_served_drones_can_be_calibrated(folder):
    with serving(folder, "serve-drones", "motion.csv", "drones/tag6"):
        for command in BOARDS["drones"]:
            processes.succeed(*command.split(), cwd=folder)
    fitted = json.loads((folder / "drones.json").read_text())["delays_ns"]
    tags = tomllib.loads((folder / "scenarios/icra2023/train.toml").read_text())["tags"]
    apart = np.array([fitted[str(tag["id"])] - tag["delay_ns"] for tag in tags])
    # A common shift of all delays is the constant of the curve; differences are known to 0.15 ns from 20 s.
    assert np.abs(apart - apart.mean()).max() < 0.15


def test_make_knows_the_targets_that_the_readme_names_and_its_links_lead_somewhere():
    named = set(re.findall(r"\bmake ([a-z-]+)\b", README)) - {"alone"}
    assert {"demo", "test", "setup"} <= named
    done = subprocess.run(["make", "-n", *sorted(named)], cwd=pages.ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    links = re.findall(r"\]\((?!http)([^)#]+)\)", README)
    assert links
    assert [link for link in links if not (pages.ROOT / link).exists()] == []
