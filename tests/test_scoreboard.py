"""Values of the scoreboard are those of the files that its commands write, computed here by NumPy alone."""

import re

import numpy as np
import pytest

from benchmarks import scoreboard
from tests import processes
from tests.shared_data import shared
from uwblink import load

pytestmark = pytest.mark.slow

CM = 100


def table(page):
    """Return the rows of the first table, by ranges and calibration."""
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines() if line.startswith("| ")]
    return {(row[0], row[1]): row[2:] for row in rows[1:]}


def number(cell):
    return float(cell.split()[0])


def spread(errors):
    return 1.4826 * np.median(np.abs(errors - np.median(errors)))


def corrected(work, recording, calibration):
    """Return raw and corrected errors in metres (n,) of a recording, and their sigma, as written by `calib apply`."""
    processes.succeed("calib", "apply", recording, "-c", calibration, "-o", "applied", "--to", "csv", cwd=work)
    files = (work / "applied" / f"{name}.csv" for name in ("exchanges", "corrected"))
    exchanges, applied = (np.genfromtxt(file, delimiter=",", names=True) for file in files)
    return applied["raw_m"] - exchanges["truth_m"], applied["corrected_m"] - exchanges["truth_m"], applied["sigma_m"]


PAPER = ["icra2023_bias_fpp.csv", "icra2023_published_fits.json"]


def holds(row, errors):
    """Return whether a row has median and robust deviation of errors in metres, to the millimetre that it shows."""
    assert (int(row[0]), number(row[1])) == (len(errors), pytest.approx(CM * np.median(errors), abs=0.0501))
    assert number(row[2]) == pytest.approx(CM * spread(errors), abs=0.0501)


def forked(line, *, cwd, **_):
    return processes.run(*line[line.index("-m") + 1 :], cwd=cwd)


@pytest.fixture
def written(tmp_path, monkeypatch, request):
    """The page of a folder with the files of one data set, its rows, and the folder with the files of its commands."""
    monkeypatch.setattr("benchmarks.scoreboard.subprocess.run", forked)
    data, work = tmp_path / "data", tmp_path / "work"
    for folder in (data, work):
        folder.mkdir()
    for name in request.param:
        (data / name).symlink_to(shared(name))
    assert scoreboard.main([str(data), "--page", str(tmp_path / "page.md"), "--work", str(work)]) == 1
    page = (tmp_path / "page.md").read_text()
    return page, table(page), *work.iterdir()


@pytest.mark.parametrize("written", [PAPER], indirect=True)
def test_rows_are_what_calib_apply_gives_and_data_sets_that_are_absent_are_named(written):
    page, rows, work = written
    raw, ours, _ = corrected(work, "half2.uwb", "half1.json")
    # The samples are biases, so the files have every second one unchanged.
    bias = np.loadtxt(shared(PAPER[0]), delimiter=",", skiprows=1)[1::2, 1]
    assert np.sort(raw) == pytest.approx(np.sort(bias), abs=1e-6)
    holds(rows["half2", "none"], raw)
    holds(rows["half2", "ours, by half1"], ours)
    assert 93 < number(rows["half2", "ours, by half1"][3]) < 97
    assert [name for name, said in rows if said == "not in the folder"] == [
        one.name for one in scoreboard.DATA_SETS if one.archive not in PAPER
    ]
    assert "error: samples.csv: no column" in page
    # Recipes of all data sets are shown, also of missing ones.
    assert page.count("```sh") == len(scoreboard.DATA_SETS)


@pytest.mark.parametrize(
    "written", [["miluv_cirObstacles_3_random_0.tar.xz", "miluv_published_calibration.json"]], indirect=True
)
def test_a_flight_is_judged_with_the_published_calibration_and_on_what_was_held_out(written):
    _, rows, work = written
    flight = "cirObstacles_3_random_0"
    raw, published, sigma = corrected(work, f"{flight}.uwb", "published.json")
    holds(rows[flight, "none"], raw)
    holds(rows[flight, "authors'"], published)
    inside = 100 * np.mean(np.abs(published) <= 1.96 * sigma)
    assert number(rows[flight, "authors'"][3]) == pytest.approx(inside, abs=0.06)
    assert 0.25 < int(rows[f"{flight}, held out", "ours, by the rest"][0]) / len(raw) < 0.35
    assert all(re.fullmatch(r"\d\.\d\d", rows[flight, name][4]) for name in ("none", "authors'"))


@pytest.mark.parametrize("written", [["swarm_broadcast_logs.tar.xz"]], indirect=True)
def test_boards_at_unknown_positions_are_evaluated_within_pairs(written):
    page, rows, work = written
    rows = {name: row for (name, _), row in rows.items() if "held out" in name}
    assert sorted(rows) == ["110-1, held out", "70-1, held out", "90-1, held out"]
    for name, row in rows.items():
        e = load(work / f"{name.split(',')[0]}.uwb").exchanges
        link = e.initiator.astype(int) * 1000 + e.target
        errors = np.concatenate([e.range_m[link == k] - np.median(e.range_m[link == k]) for k in np.unique(link)])
        # Half of the ranges, corrected with constants of the other half.
        assert int(row[0]) == pytest.approx(len(e) / 2, rel=0.03)
        assert abs(number(row[1])) < 1.0
        assert number(row[2]) == pytest.approx(CM * spread(errors), rel=0.15)
        assert 92 < number(row[3]) < 99
    assert page.count("% of the ranges lie outside three sigmas of this fit") == 3


def test_a_folder_without_any_data_set_is_one_line(tmp_path, capsys):
    assert scoreboard.main([str(tmp_path), "--page", str(tmp_path / "page.md")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "page.md").exists()
