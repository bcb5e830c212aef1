"""Statements of docs/security.md on untrusted files and on outputs, each tested by an attack."""

import functools
import json
import operator
import os
import re
import shutil
import struct
from dataclasses import replace

import duckdb
import numpy as np
import pytest

import calib
import uwblink
import uwbsim
from tests.boards import served
from tests.processes import refuse, run, succeed
from tests.registered import registered
from tests.shared_data import ROOT
from uwblink.database import STORAGE_VERSION
from uwblink.exporters import EXPORTERS, Exporter, export_recording

PACKAGES = ("uwblink", "uwbsim", "calib")
SECRET = "what nobody else may read"  # noqa: S105 - of this test
STORAGE_OF_1_5 = 68
"""Version of the storage that DuckDB 1.5 writes, in the header of a file."""


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    """A flight, its scenario, a sweep and its results; and a file that no other file names."""
    folder = tmp_path_factory.mktemp("seeds")
    text = (ROOT / "scenarios" / "noiseless.toml").read_text().replace("duration_s = 60.0", "duration_s = 1.0")
    (folder / "s.toml").write_text(text)
    (folder / "plan.toml").write_text("sweep = { scenario = 's.toml', protocols = ['ds'], ranges = 10 }\n")
    uwbsim.simulate(folder / "s.toml").save(folder / "f.uwb")
    uwbsim.run_sweep(uwbsim.load_design(folder / "plan.toml"), folder / "results", workers=1)
    (folder / "secret.txt").write_text(SECRET)
    return folder


@pytest.fixture
def place(seeds, tmp_path):
    """A separate folder with all of these."""
    folder = tmp_path / "place"
    shutil.copytree(seeds, folder)
    return folder


def refused(*words, naming=(), **how):
    """Run a command that must end with one line, which has given texts and contains no secret."""
    assert SECRET not in refuse(*words, naming=naming, **how)


def names(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


# One module opens DuckDB.


OPENS = re.compile(r"from duckdb\b|(?<![\w.])duckdb\.(?!\w*(?:Exception|Error)\b|DuckDBPyConnection\b|__version__)\w")
"""Uses of duckdb except types, errors and the version."""


def test_one_module_opens_duckdb():
    found = [path for name in PACKAGES for path in (ROOT / name).rglob("*.py") if OPENS.search(path.read_text("utf-8"))]
    assert found == [ROOT / "uwblink" / "database.py"]
    assert all(map(OPENS.search, ("duckdb.connect()", "from duckdb import connect", "x = duckdb.sql")))


# Untrusted sweep folders.


RESUME = ("sweep", "plan.toml", "-o", "results", "--resume", "--workers", "1")


@pytest.mark.parametrize(
    "statements",
    [
        [
            "DROP TABLE results",
            "CREATE VIEW results AS SELECT 0 AS number, 0 AS part, "
            "json_object('status', (SELECT content FROM read_text('{secret}')))::VARCHAR AS document",
        ],
        ["CREATE VIEW other AS SELECT content FROM read_text('{secret}')"],
        ["CREATE MACRO json_object(a) AS 1"],
        ["ALTER TABLE results ALTER number TYPE VARCHAR"],
        ["ALTER TABLE results ADD COLUMN more VARCHAR DEFAULT 'x'"],
        ["INSERT INTO results SELECT 0, 9, '{{\"a\": \"' || repeat('x', 200000) || '\"}}'"],
    ],
)
def test_untrusted_sweep_folders_with_programs_are_refused(place, statements):
    with duckdb.connect(str(place / "results" / "results.duckdb")) as db:
        for statement in statements:
            db.execute(statement.format(secret=place / "secret.txt"))
    results = place / "results" / "results.csv"
    before = results.read_bytes()
    refused("uwbsim", *RESUME, cwd=place, naming=["results.duckdb"])
    assert results.read_bytes() == before


def test_the_store_of_a_sweep_is_no_link_to_another_file(place):
    store = place / "results" / "results.duckdb"
    store.rename(place / "elsewhere.duckdb")
    store.symlink_to(place / "elsewhere.duckdb")
    refused("uwbsim", *RESUME, cwd=place, naming=["results.duckdb"])


# Files that scenarios and sweeps name.

LINKS = {
    "antenna": "radio.antenna={{file={name}}}",
    "slots": "ranging.plan={{file={name}}}",
    "flight": "bodies.0.motion={{model='recorded', file={name}}}",
    "recording": "bodies.0.motion={{model='recorded', file={name}, body='a'}}",
    "temperature": "bodies.0.temperature_c={{model='table', file={name}}}",
    "delay": "tags.0.group_delay={{model='table', file={name}}}",
}


@pytest.fixture
def here(place):
    """The folder of a scenario with files that it may not read."""
    folder = place / "s"
    (folder / "folder").mkdir(parents=True)
    shutil.copy(place / "s.toml", folder)
    os.mkfifo(folder / "pipe")
    (folder / "large").touch()
    os.truncate(folder / "large", 100_000_000)
    (folder / "endless").symlink_to("/dev/zero")
    (folder / "link").symlink_to("../secret.txt")
    return folder


@pytest.mark.parametrize("key", LINKS)
@pytest.mark.parametrize(
    "name", ["../secret.txt", "{place}/secret.txt", "in\0.csv", "pipe", "large", "endless", "link", "folder"]
)
def test_scenarios_cannot_read_unnamed_files(here, place, key, name):
    text = LINKS[key].format(name=json.dumps(name.format(place=place)))
    with pytest.raises(uwbsim.UwbsimError, match=r"\.file: found") as caught:
        uwbsim.load(here / "s.toml", [text])
    assert SECRET not in str(caught.value)


def test_scenarios_read_files_of_an_allowed_folder(here, place):
    (place / "other").mkdir()
    (place / "other" / "slots.csv").write_text("time_s,initiator,target\n0,1,2\n0.1,2,3\n")
    words = ["s/s.toml", "--set", "ranging.plan={file='../other/slots.csv'}"]
    refused("uwbsim", "validate", *words, cwd=place, naming=["ranging.plan.file", "--allow-files"])
    succeed("uwbsim", "validate", *words, "--allow-files", "other", cwd=place)
    change = {"ranging.plan": {"file": "../other/slots.csv"}}
    plan = uwbsim.load(here / "s.toml", change, allow_files=[place / "other"]).ranging.plan
    assert plan.model_dump()["slots"] == ((0.0, 1, 2), (0.1, 2, 3))


def test_sweeps_cannot_read_unnamed_scenarios(place):
    (place / "s").mkdir()
    plan = place / "s" / "plan.toml"
    words = ("uwbsim", "sweep", plan, "-o", place / "out", "--workers", 1)
    for name in ("/dev/zero", str(place / "s.toml"), "../s.toml"):
        plan.write_text(f"sweep = {{ scenario = '{name}', protocols = ['ds'], ranges = 10 }}\n")
        refused(*words, naming=[plan, "sweep.scenario"])
    succeed(*words, "--allow-files", place)


@pytest.mark.parametrize("design", ["grid", "latin-hypercube"])
def test_a_sweep_without_end_is_refused(place, design):
    value = "[1.0, 2.0]" if design == "grid" else "{ low = 1.0, high = 2.0 }"
    keys = "".join(f"'radio.{' ' * k}rx_noise_ps' = {value}\n" for k in range(64))  # 2 to the power of 64 points
    head = f"scenario = 's.toml', protocols = ['ds'], design = '{design}', samples = 1000000"
    (place / "plan.toml").write_text(f"sweep = {{ {head} }}\n[vary]\n{keys}")
    refused("uwbsim", "sweep", "plan.toml", "-o", "out", "--workers", 1, cwd=place, naming=["plan.toml", 10_000_000])
    assert not (place / "out").exists()


# Files beside an untrusted file.


@pytest.mark.parametrize("kind", ["link", "dangling", "pipe"])
@pytest.mark.parametrize("beside", [".wal", ".tmp"])
@pytest.mark.parametrize(
    "words",
    [
        ["uwblink", "show", "f.uwb"],
        ["uwblink", "poses", "f.uwb", "--from", "poses.csv"],
        ["uwblink", "export", "f.uwb", "--to", "csv", "-o", "out"],
    ],
)
def test_files_beside_a_recording_have_no_effect(place, kind, beside, words):
    (place / "poses.csv").write_text("time_s,body,x,y,z,qx,qy,qz,qw\n0,ifo001,0,0,0,0,0,0,1\n1,ifo001,0,0,0,0,0,0,1\n")
    log = place / f"f.uwb{beside}"
    if kind == "pipe":
        os.mkfifo(log)
    else:
        log.symlink_to("secret.txt" if kind == "link" else "new.txt")
    before = names(place)
    refused(*words, cwd=place, naming=[log.name])
    assert ((place / "secret.txt").read_text(), names(place)) == (SECRET, before)


# Texts in untrusted files.

STEERING = "\x1b[31m\x1b]0;title\x07<script>alert(1)</script>/../../../../evil\u202e"
PRINTING = (
    "uwblink show hostile.uwb",
    "uwblink show hostile.uwb --json",
    "uwblink poses hostile.uwb --from poses.csv",
    "uwblink export hostile.uwb --to tum -o out",
    "uwblink stream hostile.uwb --speed inf",
    "calib doctor hostile.uwb",
    "calib fit hostile.uwb -o out.json",
    "calib evaluate hostile.uwb -c c.json",
    "calib localize hostile.uwb -c c.json --seeds 1 --tum out",
    # pages are tested in tests/calib/report
    pytest.param("calib report hostile.uwb -o out.html", marks=pytest.mark.slow),
)


@pytest.fixture(scope="module")
def hostile(tmp_path_factory):
    """A flight with names that would control a terminal, run in a page, or lead to other files; and a calibration."""
    folder = tmp_path_factory.mktemp("hostile") / "deep" / "in" / "here"
    folder.mkdir(parents=True)
    flight = calib.sample_flight(300)
    calib.fit(flight).calibration.save(folder / "c.json")
    poses = replace(flight.poses, body=np.array([STEERING + body for body in flight.poses.body], dtype=object))
    tags = [replace(tag, body=STEERING + tag.body) for tag in flight.tags]
    meta = {"source": STEERING, "name": STEERING, "ports": {"1": STEERING}, "plan": {"protocol": STEERING}}
    uwblink.Contents(exchanges=flight.exchanges, poses=poses, tags=tags, meta=meta).save(folder / "hostile.uwb")
    (folder / "poses.csv").write_text(f'time_s,body,x,y,z,qx,qy,qz,qw\n0,"{STEERING}",0,0,0,0,0,0,1\n')
    return folder


@pytest.mark.parametrize("line", PRINTING)
def test_texts_in_files_control_no_terminal_page_or_path(hostile, line):
    ended = run(*line.split(), cwd=hostile)
    assert ended.returncode in (0, 2), ended
    assert all(c.isprintable() or c == "\n" for c in ended.stdout + ended.stderr), ended
    assert not list(hostile.parents[2].rglob("evil*"))
    assert not any("<script>alert" in page.read_text() for page in hostile.glob("*.html"))
    for path in [*hostile.glob("out*")]:
        shutil.rmtree(path) if path.is_dir() else path.unlink()


# Outputs.

WRITERS = (
    ("uwbsim run s.toml -o out.uwb --force", "out.uwb"),
    ("uwblink export f.uwb --to csv -o out", "out"),
    ("uwbsim show s.toml -o out.png --force", "out.png"),
    ("uwbsim sweep plan.toml -o results --resume --workers 1", "results/results.csv"),
)


@pytest.mark.parametrize(("line", "output"), WRITERS)
def test_outputs_do_not_follow_planted_links(place, line, output):
    secret, path = place / "secret.txt", place / output
    for name in (path.name, f"{path.name}.wal", f".{path.name}.partial", f".{path.name}.{os.getpid()}.partial"):
        link = path.with_name(name)
        link.unlink(missing_ok=True)
        if "--force" in line or name != path.name or output.startswith("results"):
            link.symlink_to(secret)
    succeed(*line.split(), cwd=place)
    assert (secret.read_text(), path.is_symlink(), path.exists()) == (SECRET, False, True)


def test_no_name_of_a_partial_file_can_be_guessed(place):
    secret, names_of = place / "secret.txt", ("out.uwb", "out.json", "out.toml", "out")
    for name in names_of:
        (place / f".{name}.{os.getpid()}.partial").symlink_to(secret)
    uwblink.load(place / "f.uwb").save(place / "out.uwb")
    calib.fit(place / "f.uwb").calibration.save(place / "out.json")
    calib.apply(place / "f.uwb", calib.load_calibration(place / "out.json"), place / "out", to="csv")
    assert secret.read_text() == SECRET
    assert not any((place / name).is_symlink() for name in names_of)


def test_a_name_may_be_as_long_as_the_file_system_takes(tmp_path):
    name = "n" * 240 + ".uwb"
    succeed("calib", "sample", "-o", tmp_path / name, "-n", 30)
    assert names(tmp_path) == [name]


def test_a_live_recording_goes_through_no_planted_link(tmp_path):
    path, secret = tmp_path / "live.uwb", tmp_path / "secret.txt"
    for name, target in (("live.uwb", "new.txt"), ("live.uwb.wal", "secret.txt")):
        (tmp_path / name).symlink_to(target)
    secret.write_text(SECRET)
    with uwblink.Recording.create(path, live=True) as recording:
        recording.append("tags", [uwblink.Tag(1, "a", (0.0, 0.0, 0.0))])
        assert secret.read_text() == SECRET
    assert names(tmp_path) == ["live.uwb", "secret.txt"]
    assert (path.is_symlink(), uwblink.load(path).tags[0].body) == (False, "a")


def test_live_poses_go_through_no_planted_link(tmp_path):
    poses, secret = tmp_path / "poses.csv", tmp_path / "secret.txt"
    poses.symlink_to(secret)
    secret.write_text(SECRET)
    with served() as server:
        server.write_poses(poses)
    assert (secret.read_text(), poses.read_text()[:8]) == (SECRET, "time_ns,")


def test_a_log_left_by_the_file_that_is_replaced_goes_with_it(place):
    with uwblink.Recording.create(place / "old.uwb", live=True) as recording:
        recording.append("tags", [uwblink.Tag(7, "old", (0.0, 0.0, 0.0))])
        for suffix in ("uwb", "uwb.wal"):
            shutil.copy(place / f"old.{suffix}", place / f"f.{suffix}")
    succeed("calib", "sample", "-o", place / "f.uwb", "-n", 100, "--force")
    assert 7 not in {tag.tag for tag in uwblink.load(place / "f.uwb").tags}


def test_an_output_that_cannot_be_written_leaves_the_folder_that_it_would_have_replaced(place):
    def write(recording, folder):
        (folder / "half.txt").write_text("half")
        raise uwblink.errors.RecordingError("no more")

    said = pytest.raises(uwblink.errors.RecordingError, match="no more")
    with registered(EXPORTERS, Exporter("half", write, "half a file")), said:
        export_recording(place / "f.uwb", place / "results", to="half", force=True)
    left = names(place)
    assert ("results/results.csv" in left, [name for name in left if "half" in name or "partial" in name]) == (True, [])


# Versions of DuckDB.


def storage(path):
    """Return the version of the storage of a file, from DuckDB's first header."""
    head = path.read_bytes()[:20]
    assert head[8:12] == b"DUCK"
    return struct.unpack("<Q", head[12:20])[0]


def test_the_lowest_allowed_duckdb_reads_recordings(place):
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert f'"duckdb>={STORAGE_VERSION.removeprefix("v").rpartition(".")[0]}.' in text
    with uwblink.Recording.create(place / "live.uwb", live=True):
        pass
    succeed("calib", "sample", "-o", place / "sample.uwb", "-n", 100)
    made = [*place.glob("*.uwb"), place / "results" / "results.duckdb"]
    assert [storage(path) for path in made] == [STORAGE_OF_1_5] * 4


def test_files_of_a_newer_duckdb_are_named(place):
    path = place / "newer.uwb"
    with duckdb.connect() as db:
        db.execute(f"ATTACH '{path}' AS newer")
        db.execute("CREATE TABLE newer.meta(key VARCHAR)")
    data = bytearray(path.read_bytes())
    data[12:20] = struct.pack("<Q", 5000)
    data[52:60] = b"v9.8.7\0\0"
    # The checksum of a block: each word times an odd number, combined by exclusive or.
    words = struct.unpack("<511Q", data[8:4096])
    data[:8] = struct.pack("<Q", functools.reduce(operator.xor, (w * 0xBF58476D1CE4E5B9 % 2**64 for w in words), 5381))
    path.write_bytes(data)
    refused("uwblink", "show", path, naming=[path, "DuckDB v9.8.7", f"installed DuckDB {duckdb.__version__}"])
