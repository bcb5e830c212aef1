"""Mistakes that a user can make at the three commands: one line, the right status, nothing written."""

import gzip
import json
from dataclasses import replace
from pathlib import Path

import duckdb
import pytest

from tests import processes
from uwblink.recording.file import Recording

ROOT = Path(__file__).parents[1]
NOISELESS = ROOT / "scenarios" / "noiseless.toml"
HEADER = "time_s,from_id,to_id,tx1,rx1,tx2,rx2"
GOOD = "0.0,1,2,100,200,300,500"
DELETE = object()


def run(*arguments):
    return processes.run(*(str(a) for a in arguments))


def refused(done, status, *fragments):
    assert done.returncode == status, done.stdout + done.stderr
    assert done.stdout == ""
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1, done.stderr
    for fragment in fragments:
        assert fragment in done.stderr


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flight")
    for words in (
        ("uwbsim", "run", NOISELESS, "-o", folder / "f.uwb", "--set", "run.duration_s=5"),
        ("calib", "fit", folder / "f.uwb", "-o", folder / "c.json"),
    ):
        done = run(*words)
        assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.parametrize(
    ("old", "new", "fragments"),
    [
        ("rate_hz = 160.0", "rate_hz = -1.0", ["ranging.rate_hz", "-1.0", "greater than 0"]),
        ("rate_hz = 160.0", "rate_hz = 9000.0", ["ranging.rate_hz", "at most"]),
        ("rate_hz = 160.0", "rate_hertz = 1.0", ["ranging.rate_hertz", "unknown key", "rate_hz"]),
        ("rate_hz = 160.0", "rate_hz = inf", ["ranging.rate_hz", "inf"]),
        ("duration_s = 60.0", "duration_s = 0", ["run.duration_s", "greater than 0"]),
        ("id = 2\n", "id = 1\n", ["tags[1].id", "second 1"]),
        ('id = 2\nbody = "ifo001"', 'id = 2\nbody = "ifo9"', ["tags[1].body", "ifo9", "ifo001"]),
        ('protocol = "ds"', 'protocol = "tdoa"', ["ranging.protocol", "tdoa", "ds-alt"]),
        ('antenna = "dipole"', 'antenna = "yagi"', ["radio.antenna", "yagi", "isotropic"]),
        ("[run]", "[scenario", ["not valid TOML", "line"]),
    ],
)
def test_scenarios_that_cannot_be(tmp_path, old, new, fragments):
    text = NOISELESS.read_text()
    assert old in text
    bad = tmp_path / "bad.toml"
    bad.write_text(text.replace(old, new, 1))
    refused(run("uwbsim", "run", bad, "-o", tmp_path / "out.uwb"), 2, "bad.toml", *fragments)
    assert [p.name for p in tmp_path.iterdir()] == ["bad.toml"]


@pytest.mark.parametrize(
    ("content", "fragments"),
    [
        ("", ["empty"]),
        (HEADER + "\n", ["no rows"]),
        (HEADER.replace(",tx2", "") + "\n0,1,2,1,2,3\n", ["'tx2'", "missing", "--map"]),
        (HEADER + "\n" + GOOD + "\n0.1,1,2,100,abc,300,500\n", ["row 3", "'rx1'", "'abc'"]),
        (HEADER + "\n0.1,1,2,100,nan,300,500\n", ["row 2", "'rx1'", "'nan'"]),
        (HEADER + "\n0.1,1,2,100,,300,500\n", ["row 2", "'rx1'"]),
        (HEADER + "\n0.1,1,2,100,4294967296,300,500\n", ["row 2", "'rx1'", "4294967295"]),
        (HEADER + "\n0.1,1,2,100,1.5,300,500\n", ["row 2", "'rx1'", "whole number"]),
        (HEADER + "\n0.1,1,1,100,200,300,500\n", ["row 2", "'to_id'", "from_id"]),
        (HEADER + "\n0.1,1,2,100,200,300\n", ["row 2", "'rx2'", "''"]),
        (HEADER + ",tx1\n" + GOOD + ",1\n", ["two columns", "tx1"]),
    ],
)
def test_tables_that_cannot_be(tmp_path, content, fragments):
    table = tmp_path / "t.csv"
    table.write_text(content)
    refused(run("uwblink", "import", "csv", table, "-o", tmp_path / "o.uwb"), 2, "t.csv", *fragments)
    assert [p.name for p in tmp_path.iterdir()] == ["t.csv"]


def test_a_broken_gzip_is_refused_and_not_read_for_ever(tmp_path):
    whole = gzip.compress((HEADER + "\n" + (GOOD + "\n") * 5000).encode(), mtime=0)
    (tmp_path / "t.csv.gz").write_bytes(whole[:40] + whole[60:80] * 100 + whole[40:])
    refused(run("uwblink", "import", "csv", tmp_path / "t.csv.gz", "-o", tmp_path / "o.uwb"), 2, "t.csv.gz", "gzip")


@pytest.mark.parametrize(
    ("line", "status", "fragments"),
    [
        ("uwbsim run {here}/no.toml -o {here}/o.uwb", 2, ["no.toml", "no such"]),
        ("uwbsim run {here} -o {here}/o.uwb", 2, ["directory"]),
        ("uwbsim run {noiseless} -o {here}/o.uwb --set ranging.rate", 2, ["ranging.rate"]),
        ("uwbsim run {noiseless} -o {here}/no/x.uwb", 2, ["does not exist"]),
        ("uwbsim run {noiseless} -o {here}/mine", 2, ["mine", "--force"]),
        ("uwblink show {long}", 2, ["File name too long"]),
        ("calib fit {f} -o {long}", 2, ["File name too long"]),
        ("calib fit {f} -o {here}/mine", 2, ["mine", "--force"]),
        ("calib fit {f} -o {here}/c.json --loss tukey", 2, ["--loss", "tukey"]),
        ("calib fit {f} -o {here}/c.json --scale -1", 2, ["--scale", "-1"]),
        ("calib fit {f} -o {here}/c.json --lift up", 2, ["--lift", "up"]),
        ("calib fit {f} -o {here}/c.json --fix 1", 2, ["--fix", "'1'", "TAG=NS"]),
        ("calib apply {f} -c {c} -o {here}/mine", 2, ["mine", "--force"]),
        ("calib evaluate {f} -c {c} --report {here}/mine", 2, ["mine", "--force"]),
        ("calib report {f} -o {here}/r.html --pdf {here}/mine", 2, ["mine", "--force"]),
        ("calib report {f} -o {here}/r.html --figures {here}/mine", 2, ["mine", "is a file"]),
        ("calib report {f} -o {here}/r.html --figures {here}/no/figures", 2, ["no", "does not exist"]),
        ("calib report {f} -o {here}/r.html --loss mixture --sequential", 2, ["--sequential"]),
        ("calib report {here}/no.uwb -o {here}/r.html", 2, ["no.uwb", "no such"]),
    ],
)
def test_words_that_cannot_be_are_named_and_nothing_is_written(tmp_path, flight, line, status, fragments):
    (tmp_path / "mine").write_text("mine")
    names = {
        "f": flight / "f.uwb",
        "c": flight / "c.json",
        "here": tmp_path,
        "noiseless": NOISELESS,
        "long": "a" * 5000,
    }
    refused(run(*line.format(**names).split()), status, *fragments)
    assert (tmp_path / "mine").read_text() == "mine"
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


def test_recordings_that_are_not(tmp_path, flight):
    whole = (flight / "f.uwb").read_bytes()
    (tmp_path / "cut.uwb").write_bytes(whole[: len(whole) // 2])
    with duckdb.connect(str(tmp_path / "other.uwb")) as db:
        db.execute("CREATE TABLE planets (name VARCHAR)")
    before = sorted(p.name for p in tmp_path.iterdir())
    for name, fragment in (("no.uwb", "no such"), ("cut.uwb", "truncated"), ("other.uwb", "not a"), ("", "directory")):
        for words in (
            ("uwblink", "show", tmp_path / name),
            ("calib", "fit", tmp_path / name, "-o", tmp_path / "c.json"),
            ("calib", "apply", tmp_path / name, "-c", flight / "c.json", "-o", tmp_path / "o.uwb"),
            ("calib", "evaluate", tmp_path / name, "-c", flight / "c.json"),
        ):
            refused(run(*words), 2, name, fragment)
    assert sorted(p.name for p in tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("change", "fragments"),
    [
        ("{", ["not JSON"]),
        ("[]", ["not a calibration"]),
        ('{"schema_version": 99}', ["99"]),
        ('{"schema_version": 1}', ["missing"]),
        ('{"schema_version": 1, "lift": "up"}', ["mean-of-lifted"]),
        ({"delays_ns.3": DELETE}, ["no delay for tag 3"]),
        ({"schema_version": 7}, ["schema version 7", "reads 1, 2, 3 and 4"]),
        ({"delays_ns.3": 10**400}, ["delays_ns: 3", "nanoseconds"]),
        ({f"delays_ns.{'9' * 5000}": 0.1}, ["delays_ns", "tag ids as keys"]),
        ({"uncertainty.bias_m2": [[1.0]]}, ["uncertainty", "bias_m2", "rows"]),
    ],
)
def test_calibrations_that_cannot_be(tmp_path, flight, change, fragments):
    text = change
    if isinstance(change, dict):
        document = json.loads((flight / "c.json").read_text())
        (key, value) = next(iter(change.items()))
        table, _, name = key.rpartition(".")
        place = document[table] if table else document
        place[name] = value
        if value is DELETE:
            del place[name]
        text = json.dumps(document)
    (tmp_path / "c.json").write_text(text)
    refused(run("calib", "evaluate", flight / "f.uwb", "-c", tmp_path / "c.json"), 2, *fragments)


def test_pairs_that_cannot_determine_delays_are_status_1(tmp_path):
    words = ("--set", "run.duration_s=5", "--set", "ranging.pairs=[[1, 3], [1, 5]]")
    assert run("uwbsim", "run", NOISELESS, "-o", tmp_path / "f.uwb", *words).returncode == 0
    refused(run("calib", "fit", tmp_path / "f.uwb", "-o", tmp_path / "c.json"), 1, "1, 3, 5")
    assert not (tmp_path / "c.json").exists()


def test_a_table_without_truth_is_status_1(tmp_path):
    (tmp_path / "t.csv").write_text(HEADER + "\n" + GOOD + "\n")
    assert run("uwblink", "import", "csv", tmp_path / "t.csv", "-o", tmp_path / "o.uwb").returncode == 0
    refused(run("calib", "fit", tmp_path / "o.uwb", "-o", tmp_path / "c.json"), 1, "no true distance")


def altered(source, target, change):
    """Copy a recording with its exchanges and poses changed."""
    with Recording.open(source) as opened:
        exchanges, poses, tags, meta = opened.exchanges(), opened.poses(), opened.tags(), opened.meta()
    exchanges, poses = change(exchanges, poses)
    with Recording.create(target, meta=meta) as written:
        written.append_tags(tags)
        written.append_poses(poses)
        written.append_exchanges(exchanges)
    return target


def powers(first, second):
    return lambda e, p: (replace(e, fpp1_dbm=e.fpp1_dbm * 0 + first, fpp2_dbm=e.fpp2_dbm * 0 + second), p)


@pytest.mark.parametrize(
    ("change", "fragments"),
    [
        (powers(float("nan"), float("nan")), ["no power"]),
        (powers(0.0, 3.0), ["no power", "+3 dBm"]),
        (lambda e, p: (replace(e, rx2=e.rx2 + 2**30 & 2**32 - 1), p), ["none of its", "impossible stamps"]),
        (
            lambda e, p: (e, replace(p, time_ns=p.time_ns + 100_000_000_000)),
            ["poses cover 0.0 to 5.1 s", "exchanges -100.0 to -95.0 s", "--offset"],
        ),
    ],
)
def test_recordings_that_leave_nothing_to_fit_are_status_1(tmp_path, flight, change, fragments):
    bad = altered(flight / "f.uwb", tmp_path / "bad.uwb", change)
    refused(run("calib", "fit", bad, "-o", tmp_path / "c.json"), 1, "bad.uwb", *fragments)
    assert not (tmp_path / "c.json").exists()


def test_poses_of_a_part_of_the_flight_are_enough_for_a_warning(tmp_path, flight):
    cut = altered(flight / "f.uwb", tmp_path / "cut.uwb", lambda e, p: (e, p[p.time_ns < p.time_ns.min() + 3 * 10**9]))
    done = run("calib", "fit", cut, "-o", tmp_path / "c.json")
    assert done.returncode == 0
    assert "40 % of the exchanges were left out: no true distance" in done.stderr


@pytest.mark.parametrize(
    ("text", "fragments"),
    [
        ("groups", ["not valid TOML"]),
        ("x = 1", ["expected one table [groups]"]),
        ("[groups]\na = 1", ["a:", "list of tag ids"]),
        ("[groups]\na = [1, 2]\nb = [2]", ["tag 2", "'a'", "'b'"]),
        ("[groups]\na = [1, 2]", ["tag 3", "in no group"]),
    ],
)
def test_designs_that_cannot_be(tmp_path, flight, text, fragments):
    (tmp_path / "d.toml").write_text(text)
    done = run("calib", "fit", flight / "f.uwb", "-o", tmp_path / "c.json", "--group", tmp_path / "d.toml")
    refused(done, 2, "--group", *fragments)
