"""Mistakes at the commands for boards: one line, status 2, nothing written."""

from pathlib import Path

import pytest

from tests import processes
from tests.boards import served

ROOT = Path(__file__).parents[1]
BENCH = ROOT / "scenarios" / "two_boards_on_a_bench" / "bench.toml"


def run(*arguments):
    words = [str(a) for a in arguments]
    return processes.run(*words, timeout=180)


def refused(done, *fragments):
    assert done.returncode == 2, done.stdout + done.stderr
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1, done.stderr
    for fragment in fragments:
        assert fragment in done.stderr


@pytest.fixture(scope="module")
def ports():
    with served() as server:
        yield server.names


@pytest.mark.parametrize(
    "words",
    [
        ["info"],
        ["twr", 2],
        ["test"],
        ["set-delay", 1500],
        ["passive", "on"],
        ["send", "x"],
        ["cir", 2],
        ["record", "-o", "x.uwb", "--pairs", "all"],
    ],
)
def test_no_such_port(tmp_path, words):
    command, *rest = (str(tmp_path / w) if w == "x.uwb" else w for w in words)
    refused(run("uwblink", command, "/dev/nothing", *rest), "/dev/nothing", "no such port")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("line", "fragments"),
    [
        ("twr {one} 1", ["own id"]),
        ("twr {one} 9", ["COMMANDED TASK FAILED AFTER 5 ATTEMPTS"]),
        ("twr {one} 2 --protocol tdoa", ["tdoa", "ds and ss"]),
        ("set-delay {one} 279", ["279", "280 to 6500"]),
        ("set-delay {one} 100000", ["100000", "280 to 6500"]),
        ("passive {one} maybe", ["maybe", "on or off"]),
        ("send {one} " + "x" * 58, ["58 bytes", "at most 57", "one USB packet"]),
        ("cir {one} 2 --plot {here}/c.xyz", [".xyz", ".png"]),
        ("record {one} {two} -o {out} --plan {here}/plan.toml", ["names 9", "1, 2"]),
        ("record {one} {two} -o {out}", ["--plan", "--pairs"]),
        ("record {one} {two} -o {out} --pairs some", ["some"]),
        ("record {one} {two} -o {out} --plan {here}/no.toml", ["no.toml"]),
        ("record {one} -o {out} --pairs all", ["no two boards"]),
        ("record {one} {two} -o {out} --pairs all -c {here}/no.json", ["--live"]),
        ("record {one} {two} -o {out} --pairs all --live --calibration {here}/no.json", ["no.json"]),
    ],
)
def test_what_a_board_or_a_recorder_cannot_do(ports, tmp_path, line, fragments):
    (tmp_path / "plan.toml").write_text("pairs = [[1, 9]]")
    names = {"one": ports[1], "two": ports[2], "here": tmp_path, "out": tmp_path / "f.uwb"}
    refused(run("uwblink", *line.format(**names).split()), *fragments)
    assert [p.name for p in tmp_path.iterdir()] == ["plan.toml"]


def test_a_port_that_is_not_a_board(ports, tmp_path):
    from uwblink.boards.ports import Terminal

    silent = Terminal()
    refused(run("uwblink", "info", silent.name), "b'C07\\r'", "heard nothing", "is this a ranging board")
    done = run("uwblink", "ports", "--probe", ports[1], silent.name)
    assert done.returncode == 0
    assert "board 1" in done.stdout
    assert "no answer" in done.stdout
    silent.unplug()


def test_replays_of_what_has_no_bytes(tmp_path):
    flight = tmp_path / "f.uwb"
    assert run("uwbsim", "run", BENCH, "-o", flight, "--set", "run.duration_s=1").returncode == 0
    refused(run("uwblink", "replay", flight), "no bytes from boards")
    refused(run("uwblink", "replay", flight, "--serve"), "no bytes from boards")
    refused(run("uwblink", "replay", tmp_path / "no.uwb"), "no such")


@pytest.mark.parametrize(
    ("text", "fragments"),
    [
        ("[[faults]]\nkind = 'flood'", ["faults", "flood"]),
        ("[[faults]]\nkind = 'hang'\ntag = 99\nat_s = 1", ["faults[0].tag", "99", "10, 20"]),
        ("[[faults]]\nkind = 'lose-frames'\nshare = 2", ["share"]),
        ("faults = [", ["not valid TOML"]),
    ],
)
def test_faults_that_cannot_be(tmp_path, text, fragments):
    (tmp_path / "f.toml").write_text(text)
    refused(run("uwbsim", "serve", BENCH, "--faults", tmp_path / "f.toml", "--duration", 1), "f.toml", *fragments)


def test_links_that_cannot_be(tmp_path):
    (tmp_path / "file").write_text("")
    refused(run("uwbsim", "serve", BENCH, "--link-dir", tmp_path / "file", "--duration", 1), "tag10")
    (tmp_path / "p.csv").write_text("mine")
    refused(run("uwbsim", "serve", BENCH, "--poses", tmp_path / "p.csv", "--duration", 1), "--force")
    assert (tmp_path / "p.csv").read_text() == "mine"


def test_a_server_says_how_to_record_what_it_serves(tmp_path):
    said = run("uwbsim", "serve", BENCH, "--link-dir", tmp_path / "ports", "--duration", 0.1)
    assert said.stdout.startswith("tag  10  ")
    assert f"uwblink record {tmp_path / 'ports'}/* --pairs all -o flight.uwb" in said.stderr


def test_a_second_server_does_not_take_the_links_of_the_first(tmp_path):
    from uwblink.boards.ports import Terminal
    from uwblink.errors import PortError

    first = Terminal(tmp_path / "tag1")
    with pytest.raises(PortError, match="in use by another server"):
        Terminal(tmp_path / "tag1")
    first.unplug()
    (tmp_path / "tag1").symlink_to(tmp_path / "gone")
    Terminal(tmp_path / "tag1").unplug()


def test_a_replay_is_served_as_it_was(tmp_path, ports):
    flight = tmp_path / "f.uwb"
    done = run("uwblink", "record", ports[1], ports[2], "-o", flight, "--pairs", "all", "--duration", 0.5)
    assert done.returncode == 0, done.stderr
    done = run("uwblink", "replay", flight, "--serve", "--speed", 10, "--link-dir", tmp_path / "again")
    assert done.returncode == 0, done.stderr
    assert "pieces played" in done.stdout
    done = run("uwblink", "replay", flight, "-o", tmp_path / "again.uwb", "--json")
    assert '"skipped_bytes": 0' in done.stdout
    assert (tmp_path / "again.uwb").exists()
