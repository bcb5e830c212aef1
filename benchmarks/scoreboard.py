"""Write docs/real-data.md: public data sets, calibrated and evaluated with the commands of docs/importing.md.

`python -m benchmarks.scoreboard FOLDER` uses the archives in the folder that `DATA_SETS` names. The commands of a data
set are shown on the page and run, with A and B replaced by the names of two flights, in both orders. Rows of the table
are from `calib evaluate`, `calib localize` and `calib fit --hold-out`; calibrations of the authors that are columns or
curves of a data set are applied here. Exit status: 0 every data set was run, 1 some are not in the folder, 2 none is.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import itertools
import json
import re
import shlex
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation
from scipy.stats import median_abs_deviation

Floats = NDArray[np.float64]
ROOT: Final = Path(__file__).parents[1]
PAGE: Final = ROOT / "docs" / "real-data.md"
POSE: Final = ("x", "y", "z", "rot_x", "rot_y", "rot_z", "w")
EVERY: Final = 50
"""Number of rows of a flight per row in the recording with few ranges: about 150 ranges, ten per pair."""

HEAD: Final = """\
# Real data

Public flights, calibrated and evaluated by the commands below (`make scoreboard DATA=folder`). Our calibrations are evaluated on ranges that were not fitted. Errors are ranges minus true distances; "in 95 %" are ranges within their stated 95 % interval. Localization is the position RMSE of `calib localize`: robust filter; for authors' calibrations a filter with each range's variance, for raw ranges with a fixed one.

| ranges | calibration | count | median (cm) | robust deviation (cm) | in 95 % (%) | localization (m) |
|---|---|---|---|---|---|---|
"""


@dataclass(frozen=True, slots=True)
class DataSet:
    """Public recordings: their source, the archive in the folder, and the commands that evaluate them.

    `prepare` fills a folder with the files that the commands read and returns the names of the flights. `authors`
    returns the errors in metres (n,) of a flight with the calibration of the authors, and their standard deviations
    (n,). Errors of raw ranges are not stated if true distances are `made_up`.
    """

    name: str
    origin: str
    archive: str
    prepare: Callable[[Path, Path], list[str]]
    commands: str
    calibrations: dict[str, str] = field(default_factory=dict)
    authors: Callable[[Path, str], tuple[Floats, Floats]] | None = None
    made_up: bool = False


@dataclass(slots=True)
class Row:
    """One line of the table, in metres and shares of 1; None for values that do not exist."""

    ranges: str
    calibration: str
    count: int
    median_m: float
    robust_std_m: float
    inside_95: float | None = None
    rmse_m: float | None = None

    def __str__(self) -> str:
        """Return the line in Markdown."""
        share = "" if self.inside_95 is None else f"{100 * self.inside_95:.1f}"
        rmse = "" if self.rmse_m is None else f"{self.rmse_m:.2f}"
        spread = f"{100 * self.median_m:+.1f} | {100 * self.robust_std_m:.1f}"
        return f"| {self.ranges} | {self.calibration} | {self.count} | {spread} | {share} | {rmse} |"


@dataclass(slots=True)
class Lab:
    """A folder in which each command is run once, with its results and notes: findings, warnings and errors."""

    folder: Path
    answers: dict[str, Any] = field(default_factory=dict)
    notes: dict[str, list[str]] = field(default_factory=dict)

    def run(self, command: str) -> Any:
        """Run a command and return its JSON, or None if it prints none or fails."""
        if command not in self.answers:
            words = shlex.split(command)
            prints_json = words[1] in ("evaluate", "localize", "doctor") or "--hold-out" in words
            line = [sys.executable, "-m", *words, *(["--json"] if prints_json else [])]
            done = subprocess.run(line, cwd=self.folder, capture_output=True, text=True, check=False)
            self.answers[command] = answer = json.loads(done.stdout) if prints_json and not done.returncode else None
            self.keep(words, answer, done.stderr)
        return self.answers[command]

    def keep(self, words: list[str], answer: Any, printed: str) -> None:
        """Store first clauses of findings, warnings and errors; those on a calibration are stored when it is fitted."""
        notes = []
        if words[1] == "doctor" and answer:
            notes = [f"{one['fault']} ({first_clause(one['evidence'])})" for one in answer["findings"]]
        if words[1] not in ("evaluate", "localize"):
            notes += [
                first_clause(line).removeprefix("warning: ")
                for line in printed.splitlines()
                if line.startswith(("warning: ", "error: "))
            ]
        if notes:
            self.notes[" ".join(words)] = notes


def first_clause(text: str) -> str:
    """Return a text up to a colon or semicolon after the first 31 characters, which name the object and the fault."""
    found = re.match(r".{31,}?(?<!\.uwb)(?=[:;] |$)", text)
    return found[0] if found else text


def unpack(archive: Path, folder: Path) -> list[Path]:
    """Unpack an archive and return its files."""
    with tarfile.open(archive) as tar:
        tar.extractall(folder, filter="data")
    return sorted(path for path in folder.rglob("*") if path.is_file())


def table(path: Path) -> dict[str, list[str]]:
    """Return the columns of a CSV file with a header."""
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    return dict(zip(header, map(list, zip(*rows, strict=True)), strict=True))


def numbers(columns: dict[str, list[str]], *names: str) -> Floats:
    """Return columns as numbers (n, names)."""
    return np.array([columns[name] for name in names], dtype=float).T


def prepare_starloc(archive: Path, folder: Path) -> list[str]:
    """Write the ranges of each flight, every fiftieth of them, poses of the rig, and positions of tags and anchors."""
    files = {path.name: path for path in unpack(archive, folder)}
    flights = sorted((folder / "data").glob("*/uwb.csv"))
    lever_arms, radios, columns = {}, {}, {}
    for number, path in enumerate(flights, 1):
        lines = path.read_text(encoding="utf-8").splitlines()
        shutil.copy(path, folder / f"s{number}.csv")
        (folder / f"s{number}-few.csv").write_text("\n".join(lines[:1] + lines[1::EVERY]) + "\n", encoding="utf-8")
        columns = table(path)
        poses = zip(columns["time_s"], *(columns[k] for k in POSE), strict=True)
        rows = [f"{t},rig,{','.join(pose)}" for t, *pose in poses]
        text = "\n".join(["time_s,body,x,y,z,qx,qy,qz,qw", *rows])
        (folder / f"s{number}-rig.csv").write_text(text + "\n", encoding="utf-8")
    antenna, initiator = numbers(columns, "tag_pos_x", "tag_pos_y", "tag_pos_z"), numbers(columns, "from_id")[:, 0]
    turned = Rotation.from_quat(numbers(columns, "rot_x", "rot_y", "rot_z", "w"))
    arms = turned.inv().apply(antenna - numbers(columns, "x", "y", "z"))
    for tag in np.unique(initiator):
        lever_arms[int(tag)] = np.median(arms[initiator == tag], axis=0)
    # Markers have their own numbers: a radio is at the marker that explains its true distances.
    markers = numbers(table(files["uwb_markers_v1.csv"]), "x", "y", "z")
    off = np.linalg.norm(antenna[:, None] - markers, axis=2) - numbers(columns, "gt_range")
    target = numbers(columns, "to_id")[:, 0]
    for radio in np.unique(target):
        radios[int(radio)] = markers[np.argmin(np.mean(np.abs(off[target == radio]), axis=0))]
    places = [f'[[tags]]\nid = {k}\nbody = "rig"\nlever_arm_m = {arm.tolist()}\n' for k, arm in lever_arms.items()]
    places += [f"[[anchors]]\nid = {k}\nposition_m = {place.tolist()}\n" for k, place in radios.items()]
    (folder / "rig.toml").write_text("".join(places), encoding="utf-8")
    return [f"s{number}" for number in range(1, len(flights) + 1)]


def starloc_authors(folder: Path, flight: str) -> tuple[Floats, Floats]:
    """Return the errors of the column `range_calib`, and the column `std`."""
    columns = table(folder / f"{flight}.csv")
    calibrated, true, deviation = numbers(columns, "range_calib", "gt_range", "std").T
    return calibrated - true, deviation


def prepare_miluv(archive: Path, folder: Path) -> list[str]:
    """Unpack all flights in the archive, and copy the published calibration."""
    for each in sorted(archive.parent.glob("miluv_*.tar.xz")):
        unpack(each, folder)
    published = archive.parent / "miluv_published_calibration.json"
    if published.exists():
        shutil.copy(published, folder / "uwb_calib.json")
    return sorted(path.name for path in folder.iterdir() if path.is_dir())


def prepare_paper(archive: Path, folder: Path) -> list[str]:
    """Write every second sample as a table of ranges of 10 m, and the other samples as another table."""
    samples = np.loadtxt(archive, delimiter=",", skiprows=1)
    for number in (0, 1):
        lifted, bias = samples[number::2].T
        power = -82 + 10 * np.log10(lifted)
        rows = (f"1,2,{p:.9g},{p:.9g},{10 + b:.9g},10" for p, b in zip(power, bias, strict=True))
        text = "\n".join(["from_id,to_id,fpp1,fpp2,range_m,gt_range_m", *rows])
        (folder / f"half{number + 1}.csv").write_text(text + "\n", encoding="utf-8")
    shutil.copy(archive, folder / "samples.csv")
    shutil.copy(archive.parent / "icra2023_published_fits.json", folder)
    return ["half2"]


def paper_authors(folder: Path, _: str) -> tuple[Floats, Floats]:
    """Return the errors of samples with the published bias curve, and the published standard deviations."""
    lifted, bias = np.loadtxt(folder / "samples.csv", delimiter=",", skiprows=1)[1::2].T
    published = json.loads((folder / "icra2023_published_fits.json").read_text(encoding="utf-8"))["2022-08_paper"]
    found = []
    for name in ("bias_spline_m", "std_spline_m"):
        curve = published[name]
        spline: Any = BSpline(np.array(curve["knots"]), np.array(curve["coeffs"]), curve["degree"])
        found.append(spline(np.clip(lifted, curve["knots"][0], curve["knots"][-1])))
    return bias - found[0], found[1]


def prepare_hanyang(archive: Path, folder: Path) -> list[str]:
    """Copy the table and its column map."""
    (folder / "outdoor.csv").write_bytes(gzip.decompress(archive.read_bytes()))
    shutil.copy(ROOT / "docs" / "maps" / "hanyang.toml", folder)
    return ["outdoor"]


def prepare_swarm(archive: Path, folder: Path) -> list[str]:
    """Copy the logs, and write invented positions of seven boards, on a grid of a metre; the true ones are unknown."""
    for path in unpack(archive, folder):
        shutil.copy(path, folder)
    places = (f"[[anchors]]\nid = {k + 1}\nposition_m = [{k % 2}, {k // 2}, 1.0]\n" for k in range(7))
    (folder / "grid.toml").write_text("".join(places), encoding="utf-8")
    return sorted(path.stem for path in folder.glob("*.log"))


DATA_SETS: Final = (
    DataSet(
        "STAR-loc",
        "utiasASRL/starloc at d1367dc, `data/loop-2d-fast_s1|s2/uwb.csv` and `mocap/uwb_markers_v1.csv`: two tags on a "
        "rig, eight anchors. A-few.csv is every 50th row of A.csv, A-rig.csv its poses of the rig, rig.toml has lever "
        "arms and anchors: numbers of markers and radios differ; each radio gets the marker that fits `gt_range`. "
        "Authors': `range_calib` and `std`.",
        "starloc_loop-2d-fast.tar.xz",
        prepare_starloc,
        """\
uwblink import guess A.csv -o A.toml
uwblink import csv A.csv --map A.toml -o A.uwb
uwblink import csv A-few.csv --map A.toml -o A-few.uwb
uwblink poses A.uwb --from A-rig.csv --tags rig.toml
calib doctor A.uwb
calib fit A.uwb -o A.json
calib fit A.uwb -o A-same.json --between 0
calib fit A.uwb -o A-turned.json --pattern shared
calib fit A-few.uwb -o A-few.json
calib evaluate B.uwb -c A.json
calib localize B.uwb -c A.json
calib evaluate B.uwb -c A-same.json
calib evaluate B.uwb -c A-turned.json
calib evaluate B.uwb -c A-few.json
calib localize B.uwb -c A-few.json
""",
        {
            "A.json": "ours, by A",
            "A-same.json": "with `--between 0`",
            "A-turned.json": "with a pattern",
            "A-few.json": "every 50th range of A",
        },
        starloc_authors,
    ),
    DataSet(
        "MILUV",
        "decargroup/miluv: a flight's folder with `timeshift.yaml`, `tags.yaml`, `anchors.yaml`; uwb_calib.json is "
        "`config/uwb/uwb_calib.pickle` at 7d81efd as JSON. With one flight, B is the part of it that is held out.",
        "miluv_cirObstacles_3_random_0.tar.xz",
        prepare_miluv,
        """\
uwblink import miluv A -o A.uwb
calib import miluv uwb_calib.json -o published.json
calib doctor A.uwb
calib fit A.uwb -o A.json --hold-out 0.3
calib fit A.uwb -o A-heard.json --hold-out 0.3 --use receptions
calib fit A.uwb -o A-turned.json --hold-out 0.3 --pattern shared
calib evaluate A.uwb -c published.json
calib localize A.uwb -c published.json
calib evaluate B.uwb -c A.json
calib localize B.uwb -c A.json
""",
        {"published.json": "authors'", "A.json": "ours, by A"},
    ),
    DataSet(
        "samples of the paper",
        "decargroup/uwb_calibration: `lifted_fpp` and `bias_m` behind the paper's curve, delays corrected; no time, no "
        "pair. half1.csv and half2.csv contain every second sample as a range of 10 m, so only errors differ. Authors': splines of "
        "`calib_results_new.pickle` at 3e09741.",
        "icra2023_bias_fpp.csv",
        prepare_paper,
        """\
uwblink import guess samples.csv -o samples.toml
uwblink import csv half1.csv -o half1.uwb
uwblink import csv half2.csv -o half2.uwb
calib doctor half1.uwb
calib fit half1.uwb -o half1.json --constants pair --between 0
calib evaluate half2.uwb -c half1.json
""",
        {"half1.json": "ours, by half1"},
        paper_authors,
    ),
    DataSet(
        "Hanyang",
        "cucudasluv/UWB-dataset at 09d5196, `Static_measurements`, joined into one table: single-sided, one pair.",
        "hanyang_sstwr.csv.gz",
        prepare_hanyang,
        """\
uwblink import csv A.csv --map hanyang.toml -o A.uwb
calib doctor A.uwb
calib fit A.uwb -o A.json --hold-out 0.3
""",
    ),
    DataSet(
        "swarm broadcasts",
        "prathje/uwb-swarm-ranging at 0d023d2, `scripts/out`: boards that broadcast, at unknown places. grid.toml has "
        "invented places: a fit of delays is refused. They cancel if each pair has a constant.",
        "swarm_broadcast_logs.tar.xz",
        prepare_swarm,
        """\
uwblink import guess A.log -o A.toml
uwblink import csv A.log --map A.toml -o A.uwb
uwblink poses A.uwb --tags grid.toml
calib fit A.uwb -o A-tags.json --delays-only
calib fit A.uwb -o A.json --constants pair --delays-only --between 0 --hold-out 0.5
""",
        made_up=True,
    ),
)


def with_names(text: str, one: str, other: str) -> str:
    """Replace A and B by the names of flights."""
    return re.sub(r"\b[AB]\b", lambda found: {"A": one, "B": other}[found[0]], text)


def expanded(commands: str, flights: list[str]) -> list[str]:
    """Return the commands with one flight, for every flight, then those with two flights, in both orders."""
    single = [line for line in commands.splitlines() if not re.search(r"\bB\b", line)]
    both = [line for line in commands.splitlines() if line not in single]
    found = [with_names(line, flight, "") for flight in flights for line in single]
    return found + [with_names(line, *two) for two in itertools.permutations(flights, 2) for line in both]


def figures(lab: Lab, data: DataSet, flights: list[str]) -> list[Row]:
    """Run the commands of a data set and return the results by flight."""
    pairs = [*itertools.permutations(flights, 2)] or [(flights[0], "")]
    labels = {
        with_names(file, *two): with_names(name, *two) for two in pairs for file, name in data.calibrations.items()
    }
    rows: dict[str, dict[str, Row]] = {}
    for command in expanded(data.commands, flights):
        answer, words = lab.run(command), command.split()
        if answer is None or words[1] == "doctor":
            continue
        flight, file = words[2].removesuffix(".uwb"), words[4]
        if words[1] == "fit":
            name, how = f"{flight}, held out", [key for word, key in FITS.items() if word in command]
            title = ", ".join(["ours, by the rest", *how]) + pattern_size(lab.folder / file)
            found = held_out(name, answer["provenance"]["held_out"], title)
            there = rows.setdefault(name, {} if data.made_up else {"none": found["none"]})
            there[file] = found["ours"]
        elif words[1] == "localize":
            rmse = answer["summary"]["rmse_m"]
            # Calibrations without an error model have no robust filter.
            rows[flight]["none"].rmse_m, rows[flight][file].rmse_m = rmse["raw"], rmse.get("robust", rmse["variance"])
        else:
            overall = answer["overall"]
            there = rows.setdefault(flight, before(flight, overall["raw"], lab, data))
            # A calibration without reflections states intervals by its sigma alone.
            inside = overall["coverage"]["95"] if overall["inside_95"] is None else overall["inside_95"]
            there[file] = row_of(flight, labels[file] + pattern_size(lab.folder / file), overall["full"], inside)
    return [row for there in rows.values() for row in there.values()]


def pattern_size(calibration: Path) -> str:
    """Return the size of the pattern over direction of a calibration, "" without one."""
    found = json.loads(calibration.read_text(encoding="utf-8")).get("patterns", [])
    return "".join(f" of {100 * one['rms_m']:.1f} cm" for one in found)


def row_of(flight: str, calibration: str, found: dict[str, Any], inside: float | None = None) -> Row:
    """Return the row of a stage of `calib evaluate`."""
    return Row(flight, calibration, found["n"], found["median_m"], found["robust_std_m"], inside)


def before(flight: str, raw: dict[str, Any], lab: Lab, data: DataSet) -> dict[str, Row]:
    """Return the rows of a flight for raw ranges and for the calibration of the authors, if the data set contains it."""
    rows = {"none": row_of(flight, "none", raw)}
    if data.authors:
        error, deviation = data.authors(lab.folder, flight)
        spread = (float(np.median(error)), float(median_abs_deviation(error, scale="normal")))
        rows["authors"] = Row(
            flight, "authors'", len(error), *spread, float(np.mean(np.abs(error) <= 1.96 * deviation))
        )
    return rows


FITS: Final = {"--use receptions": "with receptions", "--constants pair": "by pair", "--pattern": "with a pattern"}
"""Name of a fit in the table, by the options of its command."""


def held_out(name: str, held: dict[str, Any], calibration: str) -> dict[str, Row]:
    """Return the rows of ranges that a fit held out."""
    corrected = (held["median_m"], held["robust_std_m"], held["inside_95"])
    return {
        "none": Row(name, "none", held["ranges"], held["raw_median_m"], held["raw_robust_std_m"]),
        "ours": Row(name, calibration, held["ranges"], *corrected),
    }


def notes_by_command(notes: dict[str, list[str]], flights: list[str]) -> list[str]:
    """Return a line per command with notes that no earlier command had.

    Notes that differ only in the name of the flight are equal, and warnings also if only numbers differ.
    """
    seen: set[str] = set()
    lines = []
    for command, own in notes.items():
        sizes = [r"[0-9.]+ (%|cm|ps)"] * (not any(note.startswith("error: ") for note in own))
        alike = [re.sub("|".join([*sizes, *flights]), "", note) for note in own]
        new = [note for note, key in zip(own, alike, strict=True) if key not in seen]
        seen.update(alike)
        lines += [f"- `{re.sub(' -o [^ ]+', '', command)}`: {'; '.join(new)}"] if new else []
    return lines


def judge(data: DataSet, archives: Path, work: Path) -> tuple[list[str], list[str]]:
    """Return the lines of a data set in the table, and the notes of its commands."""
    lab = Lab(work / data.name)
    lab.folder.mkdir()
    flights = data.prepare(archives / data.archive, lab.folder)
    lines = [str(row) for row in figures(lab, data, flights)]
    return lines, notes_by_command(lab.notes, flights)


def write(folder: Path, page: Path, work: Path) -> int:
    """Write the page, with the files of the commands in an empty folder `work`; return the exit status."""
    there = {data.name for data in DATA_SETS if (folder / data.archive).exists()}
    if not there:
        print(f"error: {folder}: none of {', '.join(data.archive for data in DATA_SETS)}", file=sys.stderr)
        return 2
    rows, recipes = "", "\n## Recipes\n\nA and B are flights; every command is also run with A and B exchanged.\n"
    messages = "\n## What was refused, and warnings\n\nFindings, warnings and errors: the first clause of each, once.\n"
    for data in DATA_SETS:
        recipes += (
            f"\n**{data.name}** {data.origin}\n\n<!-- not run: it needs the data -->\n```sh\n{data.commands}```\n"
        )
        if data.name not in there:
            rows += f"| {data.name} | not in the folder | | | | | |\n"
            continue
        print(data.name, flush=True)
        lines, notes = judge(data, folder, work)
        none = "refused" if "fit" in data.commands else "no true distances"
        rows += "".join(f"{line}\n" for line in [f"| **{data.name}** | {'' if lines else none} | | | | | |", *lines])
        messages += f"\n**{data.name}**\n\n" + "".join(f"{note}\n" for note in notes or ["- nothing"])
    page.write_text(HEAD + rows + messages + recipes, encoding="utf-8")
    print(page)
    return 0 if len(there) == len(DATA_SETS) else 1


def main(arguments: list[str] | None = None) -> int:
    """Write the page from the data in a folder; return the exit status."""
    options = argparse.ArgumentParser(prog="benchmarks.scoreboard", description="Write docs/real-data.md.")
    options.add_argument("folder", type=Path, help="folder with the archives of the data sets")
    options.add_argument("--page", type=Path, default=PAGE, help="page to write")
    options.add_argument("--work", type=Path, help="empty folder in which the commands' files stay")
    found = options.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name:
        return write(found.folder.resolve(), found.page, found.work or Path(name))


if __name__ == "__main__":
    sys.exit(main())
