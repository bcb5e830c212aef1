"""Every mistake a user can make at the three commands: one line, the right status, nothing written."""

import gzip
from pathlib import Path

import duckdb
import pytest

from tests import processes

ROOT = Path(__file__).parents[1]
NOISELESS = ROOT / "scenarios" / "noiseless.toml"
HEADER = "time_s,from_id,to_id,tx1,rx1,tx2,rx2"
GOOD = "0.0,1,2,100,200,300,500"


def run(*arguments):
    words = [str(a) for a in arguments]
    return processes.run(*words)


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
    done = run("uwbsim", "run", NOISELESS, "-o", folder / "f.uwb", "--set", "run.duration_s=5")
    assert done.returncode == 0, done.stderr
    done = run("calib", "fit", folder / "f.uwb", "-o", folder / "c.json")
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


def test_scenario_files_that_are_not(tmp_path):
    out = tmp_path / "out.uwb"
    refused(run("uwbsim", "run", tmp_path / "no.toml", "-o", out), 2, "no.toml", "no such")
    refused(run("uwbsim", "run", tmp_path, "-o", out), 2, "directory")
    refused(run("uwbsim", "run", NOISELESS, "-o", out, "--set", "ranging.rate"), 2, "ranging.rate")
    refused(run("uwbsim", "run", NOISELESS, "-o", tmp_path / "no" / "x.uwb"), 2, "does not exist")
    out.write_text("mine")
    refused(run("uwbsim", "run", NOISELESS, "-o", out), 2, "out.uwb", "--force")
    assert out.read_text() == "mine"


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


def test_names_too_long_for_the_system_are_one_line(tmp_path, flight):
    for words in (("uwblink", "show", "a" * 5000), ("calib", "fit", flight / "f.uwb", "-o", "a" * 5000)):
        refused(run(*words), 2, "File name too long")


def test_recordings_that_are_not(tmp_path, flight):
    whole = (flight / "f.uwb").read_bytes()
    (tmp_path / "cut.uwb").write_bytes(whole[: len(whole) // 2])
    with duckdb.connect(str(tmp_path / "other.uwb")) as db:
        db.execute("CREATE TABLE planets (name VARCHAR)")
    before = sorted(p.name for p in tmp_path.iterdir())
    for name, fragment in (("no.uwb", "no such"), ("cut.uwb", "truncated"), ("other.uwb", "not a"), ("", "directory")):
        bad = tmp_path / name
        refused(run("uwblink", "show", bad), 2, name, fragment)
        refused(run("calib", "fit", bad, "-o", tmp_path / "c.json"), 2, name, fragment)
        apply = run("calib", "apply", bad, "-c", flight / "c.json", "-o", tmp_path / "o.uwb")
        refused(apply, 2, name, fragment)
        refused(run("calib", "evaluate", bad, "-c", flight / "c.json"), 2, name, fragment)
    assert sorted(p.name for p in tmp_path.iterdir()) == before


def test_outputs_that_exist_are_kept(tmp_path, flight):
    mine = tmp_path / "mine"
    mine.write_text("mine")
    refused(run("calib", "fit", flight / "f.uwb", "-o", mine), 2, "--force")
    apply = run("calib", "apply", flight / "f.uwb", "-c", flight / "c.json", "-o", mine)
    refused(apply, 2, "--force")
    report = run("calib", "evaluate", flight / "f.uwb", "-c", flight / "c.json", "--report", mine)
    refused(report, 2, "--force")
    assert mine.read_text() == "mine"


@pytest.mark.parametrize(
    ("content", "fragment"),
    [
        ("{", "not JSON"),
        ("[]", "not a calibration"),
        ('{"schema_version": 99}', "99"),
        ('{"schema_version": 1}', "missing"),
        ('{"schema_version": 1, "lift": "up"}', "mean-of-lifted"),
    ],
)
def test_calibrations_that_are_not(tmp_path, flight, content, fragment):
    (tmp_path / "c.json").write_text(content)
    refused(run("calib", "evaluate", flight / "f.uwb", "-c", tmp_path / "c.json"), 2, "c.json", fragment)


def test_options_that_are_not(tmp_path, flight):
    for option, value in (("--loss", "tukey"), ("--scale", "-1"), ("--lift", "up")):
        done = run("calib", "fit", flight / "f.uwb", "-o", tmp_path / "c.json", option, value)
        refused(done, 2, option, value)


def test_pairs_that_cannot_determine_delays_are_status_1(tmp_path):
    done = run(
        "uwbsim", "run", NOISELESS, "-o", tmp_path / "f.uwb", "--set", "run.duration_s=5",
        "--set", "ranging.pairs=[[1, 3], [1, 5]]",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    refused(run("calib", "fit", tmp_path / "f.uwb", "-o", tmp_path / "c.json"), 1, "1, 3, 5")
    assert not (tmp_path / "c.json").exists()


def test_a_table_without_truth_is_status_1(tmp_path):
    (tmp_path / "t.csv").write_text(HEADER + "\n" + GOOD + "\n")
    assert run("uwblink", "import", "csv", tmp_path / "t.csv", "-o", tmp_path / "o.uwb").returncode == 0
    refused(run("calib", "fit", tmp_path / "o.uwb", "-o", tmp_path / "c.json"), 1, "no true distance")


def altered(source, target, change):
    """Copy a recording with its exchanges or poses changed."""
    from uwblink.recording.file import Recording

    with Recording.open(source) as opened:
        exchanges, poses, tags, meta = opened.exchanges(), opened.poses(), opened.tags(), opened.meta()
    exchanges, poses = change(exchanges, poses)
    with Recording.create(target, meta=meta, force=True) as written:
        written.append_tags(tags)
        written.append_poses(poses)
        written.append_exchanges(exchanges)
    return target


def test_poses_that_do_not_cover_the_flight(tmp_path, flight):
    from dataclasses import replace

    late = altered(
        flight / "f.uwb", tmp_path / "late.uwb", lambda e, p: (e, replace(p, time_ns=p.time_ns + 100_000_000_000))
    )
    done = run("calib", "fit", late, "-o", tmp_path / "c.json")
    refused(done, 1, "late.uwb", "poses cover 0.0 to 5.1 s", "exchanges -100.0 to -95.0 s", "--offset")

    def half(e, p):
        keep = p.time_ns < p.time_ns.min() + 3_000_000_000
        return e, replace(p, **{n: getattr(p, n)[keep] for n in ("time_ns", "body", "position_m", "quaternion")})

    cut = altered(flight / "f.uwb", tmp_path / "cut.uwb", half)
    done = run("calib", "fit", cut, "-o", tmp_path / "c.json")
    assert done.returncode == 0
    assert "40 % of the exchanges were left out: no true distance" in done.stderr


@pytest.mark.parametrize(
    ("powers", "fragment"),
    [((float("nan"),) * 2, "no power"), ((0.0, 3.0), "no power")],
)
def test_powers_that_say_nothing(tmp_path, flight, powers, fragment):
    from dataclasses import replace

    def change(e, p):
        return replace(e, fpp1_dbm=e.fpp1_dbm * 0 + powers[0], fpp2_dbm=e.fpp2_dbm * 0 + powers[1]), p

    bad = altered(flight / "f.uwb", tmp_path / "bad.uwb", change)
    refused(run("calib", "fit", bad, "-o", tmp_path / "c.json"), 1, "bad.uwb", fragment)
    assert not (tmp_path / "c.json").exists()


def test_stamps_that_leave_nothing(tmp_path, flight):
    from dataclasses import replace

    bad = altered(flight / "f.uwb", tmp_path / "bad.uwb", lambda e, p: (replace(e, rx2=e.rx2 + 2**30 & 2**32 - 1), p))
    refused(run("calib", "fit", bad, "-o", tmp_path / "c.json"), 1, "bad.uwb", "none of its", "impossible stamps")


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


def test_reports_that_cannot_be_written(tmp_path, flight):
    (tmp_path / "mine").write_text("mine")
    base = ["calib", "report", flight / "f.uwb", "-o", tmp_path / "r.html"]
    refused(run(*base, "--pdf", tmp_path / "mine"), 2, "mine", "--force")
    refused(run(*base, "--figures", tmp_path / "mine"), 2, "mine", "is a file")
    refused(run(*base, "--figures", tmp_path / "no" / "figures"), 2, "no", "does not exist")
    refused(run(*base, "--loss", "mixture", "--sequential"), 2, "--sequential")
    refused(run("calib", "report", tmp_path / "no.uwb", "-o", tmp_path / "r.html"), 2, "no.uwb", "no such")
    assert (tmp_path / "mine").read_text() == "mine"
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


def test_calibrations_of_other_tags_and_versions(tmp_path, flight):
    import json

    document = json.loads((flight / "c.json").read_text())
    del document["delays_ns"]["3"]
    (tmp_path / "c.json").write_text(json.dumps(document))
    refused(run("calib", "evaluate", flight / "f.uwb", "-c", tmp_path / "c.json"), 2, "no delay for tag 3")
    (tmp_path / "c.json").write_text(json.dumps(document | {"schema_version": 7}))
    refused(
        run("calib", "evaluate", flight / "f.uwb", "-c", tmp_path / "c.json"),
        2,
        "schema version 7",
        "reads 1, 2, 3 and 4",
    )
    huge = document | {"delays_ns": document["delays_ns"] | {"3": 10**400}}
    (tmp_path / "c.json").write_text(json.dumps(huge))
    refused(run("calib", "evaluate", flight / "f.uwb", "-c", tmp_path / "c.json"), 2, "delays_ns: 3", "nanoseconds")
    huge = document | {"delays_ns": document["delays_ns"] | {"9" * 5000: 0.1}}
    (tmp_path / "c.json").write_text(json.dumps(huge))
    refused(run("calib", "evaluate", flight / "f.uwb", "-c", tmp_path / "c.json"), 2, "delays_ns", "tag ids as keys")
    document["uncertainty"]["bias_m2"] = [[1.0]]
    (tmp_path / "c.json").write_text(json.dumps(document))
    refused(run("calib", "evaluate", flight / "f.uwb", "-c", tmp_path / "c.json"), 2, "uncertainty", "bias_m2", "rows")
