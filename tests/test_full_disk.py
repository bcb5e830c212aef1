"""A full disk with every command that writes: one line, status 2, and no partial file.

The disk is full in that no file may exceed some length, which the system enforces. A new command or output needs a row
here.
"""

import re
import shutil
from pathlib import Path

import pytest

import calib
import uwblink
import uwbsim
from tests.boards import served
from tests.fuzz.options import commands
from tests.fuzz.seeds import write_seeds
from tests.processes import refuse, run
from tests.shared_data import ROOT
from uwblink.cli.shared import WRITTEN


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    """A folder with inputs of all commands."""
    folder = tmp_path_factory.mktemp("seeds")
    write_seeds(folder)
    string = (ROOT / "scenarios/string/string.toml").read_text().replace("stay_s = 140.0", "stay_s = 10.0")
    uwbsim.simulate(string.replace("duration_s = 1200.0", "duration_s = 160.0")).save(folder / "string.uwb")
    calib.export(calib.load_calibration(folder / "calibration.json"), "miluv", folder / "miluv.json")
    return folder


COMMANDS = (
    # A log that cannot grow, a file that cannot be completed at the end, and one that cannot be created.
    ("uwbsim run {scenario.toml} -o out.uwb", 40_000),
    ("uwbsim run {scenario.toml} -o out.uwb", 300_000),
    ("uwbsim run {scenario.toml} -o out.uwb", 4_000),
    ("uwbsim show {scenario.toml} -o out.png", 1_000),
    ("uwbsim compare {scenario.toml} -o out -n 200 --protocols ss,ds", 1_000),
    ("uwbsim optimum {scenario.toml} -o out --protocols ds", 1_000),
    ("uwbsim scenarios icra2023 -o out", 300),
    ("uwbsim scenarios icra2023 -o out/deep/er", 1_500),
    ("uwbsim twin {flight.uwb} -c {calibration.json} -o out.toml", 1_000),
    ("uwblink import csv {table.csv} -o out.uwb", 20_000),
    ("uwblink import exported {exported} -o out.uwb", 20_000),
    ("uwblink import guess {table.csv} -o out.toml", 100),
    ("uwblink import bag {flight.mcap} -o out.uwb", 20_000),
    ("uwblink replay {boards.uwb} -o out.uwb", 20_000),
    ("uwblink export {flight.uwb} --to csv -o out", 10_000),
    ("uwblink export {flight.uwb} --to parquet -o out", 1_000),
    ("uwblink export {flight.uwb} --to mcap -o out.mcap", 10_000),
    ("uwblink export {flight.uwb} --to rosbag2 -o out", 10_000),
    ("uwblink export {flight.uwb} --to tum -o out", 1_000),
    ("calib fit {flight.uwb} -o out.json", 1_000),
    ("calib add-tag {flight.uwb} -c {others.json} --tag 6 -o out.json", 1_000),
    ("calib survey {string.uwb} --known line -o out.json", 100),
    ("calib plan survey 4 --on line -o out.html", 1_000),
    ("calib import miluv {miluv.json} -o out.json", 100),
    ("calib sample -o out.uwb -n 100", 20_000),
    ("calib apply {flight.uwb} -c {calibration.json} -o out.uwb", 50_000),
    *(
        (f"calib apply {{flight.uwb}} -c {{calibration.json}} --to {form} -o out", 1_000)
        for form in ("csv", "parquet", "mcap", "rosbag2")
    ),
    *(
        (f"calib export {{calibration.json}} --to {form} -o out", 100)
        for form in ("registers", "firmware", "json", "csv", "miluv", "ros-yaml")
    ),
    ("calib export {calibration.json} --to c-header -o out.h", 100),
    ("calib localize {flight.uwb} -c {calibration.json} --tum out", 1_000),
    ("calib compare {calibration.json} {others.json} --figures out", 1_000),
)

SAME = {
    "uwbsim compare --figures": "calib compare --figures",
    "uwbsim sweep --figures": "calib compare --figures",
    # One function writes all figures (uwblink.pages.blocks), and drawing takes seconds.
    "calib localize --figures": "calib compare --figures",
    "calib evaluate --figures": "calib compare --figures",
    "calib evaluate --report": "calib plan survey --output",
    "calib report --output": "calib plan survey --output",
    "calib report --pdf": "calib plan survey --output",
    "calib report --figures": "calib compare --figures",
    "calib survey --report": "calib plan survey --output",
    "calib survey --plot": "uwblink cir --plot",
    "calib plan flight --output": "calib plan survey --output",
    "calib plan survey --figures": "calib compare --figures",
    "calib plan flight --figures": "calib compare --figures",
    # One recorder serves both commands.
    "uwblink record --output": "uwblink stream --output",
    # The same function imports all forms of a source.
    "uwblink import miluv --output": "uwblink import csv --output",
}
"""Outputs written by the same function as another row of the table."""

ELSEWHERE = {
    "uwblink stream --output": "test_full_disk.py",
    "uwbsim sweep --output": "uwbsim/sweep/test_sweep.py",
    "uwblink cir --plot": "test_full_disk.py",
}
"""Outputs with a full disk in other tests: the sweep keeps finished runs, the recorder its recorded rows."""


def is_path(parameter):
    """Return whether an option takes a path, for this and for older versions of typer."""
    if hasattr(parameter, "type_descriptor"):
        return parameter.type_descriptor.annotation is Path
    return parameter.type.name == "path"


def outputs():
    """Return every output of commands, such as `calib fit --output`."""
    parameters = ((name, parameter) for name, command in commands().items() for parameter in command.params)
    return {f"{name} {p.opts[-1]}" for name, p in parameters if p.name in WRITTEN and is_path(p)}


def of_line(line):
    """Return the output that a row of the table writes."""
    words = line.split()
    flag = next(word for word in reversed(words) if word in ("-o", "--tum", "--figures"))
    named = words[: 3 if words[1] in ("import", "plan") else 2]
    return f"{' '.join(named)} {'--output' if flag == '-o' else flag}"


def test_every_output_of_every_command_is_written_onto_a_full_disk():
    tested = {of_line(line) for line, _ in COMMANDS}
    assert set(SAME.values()) <= tested | set(ELSEWHERE)
    assert tested | set(SAME) | set(ELSEWHERE) == outputs()
    for file in ELSEWHERE.values():
        assert re.search("full_disk|most_bytes", (ROOT / "tests" / file).read_text()), file


@pytest.mark.slow
@pytest.mark.parametrize(("line", "most_bytes"), COMMANDS)
def test_a_full_disk_is_one_line_and_leaves_nothing(seeds, tmp_path, line, most_bytes):
    words = [str(seeds / word.strip("{}")) if word.startswith("{") else word for word in line.split()]
    ended = run(*words, cwd=tmp_path, most_bytes=most_bytes)
    said = "".join(text for text in ended.stderr.splitlines(keepends=True) if not text.startswith("warning: "))
    assert ended.returncode == 2, ended
    assert re.fullmatch("error: .*cannot be.*\n", said), ended
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("room", [0, 20_000])
def test_poses_on_a_full_disk_are_refused(seeds, tmp_path, room):
    path = shutil.copyfile(seeds / "live.uwb", tmp_path / "f.uwb")
    source = [word for body in ("ifo001", "ifo002") for word in ("--from", f"{body}={seeds / 'tum' / body}.tum")]
    most_bytes = path.stat().st_size + room if room else 1000
    naming = ["everything before is kept", "keep the two together"] if room else ["cannot be written"]
    refuse("uwblink", "poses", path, *source, cwd=tmp_path, most_bytes=most_bytes, naming=naming)
    # The log of DuckDB of a failed update may remain, too, until the recording is written again.
    names = {each.name for each in tmp_path.iterdir()}
    assert {"f.uwb", *(["f.uwb.wal"] if room else [])} <= names <= {"f.uwb", "f.uwb.wal"}
    after, bodies = uwblink.load(path), {"ifo001", "ifo002"} if room else set()
    assert (set(after.poses.body), len(after.exchanges)) == (bodies, len(uwblink.load(seeds / "live.uwb").exchanges))


@pytest.mark.parametrize(
    ("most_bytes", "said"), [(4_000, "cannot be written ("), (900_000, "cannot be written any more (")]
)
def test_a_stream_for_which_the_disk_has_no_room(tmp_path, most_bytes, said):
    """The disk is full at the start of the recording, or when the whole log is merged into the file."""
    with served() as server:
        words = ["uwblink", "stream", *server.names.values(), "-o", "out.uwb", "--duration", "1.5", "--rate", "100"]
        ended = run(*words, cwd=tmp_path, most_bytes=most_bytes)
    assert (ended.returncode, ended.stderr.count("\n"), said in ended.stderr) == (2, 1, True), ended
    if most_bytes == 4_000:
        assert list(tmp_path.iterdir()) == []
        return
    assert (tmp_path / "out.uwb").stat().st_size == most_bytes
    # Under load there are few, and an answer that came too late is only in the file.
    assert len(uwblink.load(tmp_path / "out.uwb").exchanges) >= len(ended.stdout.splitlines()) > 0


def test_a_plot_of_a_board_for_which_the_disk_has_no_room(tmp_path):
    with served() as server:
        here, there, *_ = server.names
        words = ["uwblink", "cir", server.names[here], there, "--plot", "out.png"]
        told = refuse(*words, cwd=tmp_path, most_bytes=1000)
    assert (told, list(tmp_path.iterdir())) == ("error: out.png: cannot be written (File too large)\n", [])
