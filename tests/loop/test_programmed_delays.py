"""Boards are recorded, calibrated, programmed, and recorded again: programmed delays are known and counted once."""

import json
import math
import tomllib
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

import calib
import uwblink
import uwbsim
from tests.processes import refuse, run, succeed
from uwblink.importers import add_poses
from uwblink.recording import load_antenna_delays
from uwbsim.scenario import with_antenna_delays

LIGHT, TICK_S = 299_702_547.0, 1 / (128 * 499.2e6)
DELAYS_NS = {1: -0.363812, 2: -0.00724, 3: 0.238, 4: -0.361457}
PLACES_M = {1: (0.0, 0.0, 1.0), 2: (4.0, 0.0, 1.6), 3: (0.5, 3.5, 0.7), 4: (4.2, 3.1, 2.2)}


def scenario(delays_ns, noise_ps=30.0, protocol="ds"):
    """Return boards that stand still, with equal clock rates."""
    bodies = "".join(
        f"[[bodies]]\nname = 'b{tag}'\nmotion = {{ model = 'static', position_m = {list(PLACES_M[tag])} }}\n"
        f"[[tags]]\nid = {tag}\nbody = 'b{tag}'\ndelay_ns = {delay}\n"
        for tag, delay in delays_ns.items()
    )
    return uwbsim.load(
        f"[run]\nduration_s = 4.0\n[ranging]\nrate_hz = 200.0\nprotocol = '{protocol}'\n"
        f"[radio]\nrx_noise_ps = {noise_ps}\n{bodies}"
    )


def programmed(world, path):
    return world if path is None else world.model_copy(update={"tags": with_antenna_delays(world.tags, path)})


def record(world, path, delays=None, protocol="ss", said=True, duration_s=2.0):
    """Record virtual boards with programmed antenna delays of a file, and their poses."""
    ports = uwbsim.VirtualPorts(programmed(world, delays))
    told = load_antenna_delays(delays) if delays and said else {}
    tags = tuple(uwblink.Tag(tag, f"b{tag}", (0.0, 0.0, 0.0)) for tag in PLACES_M)
    plan = uwblink.RangingPlan(rate_hz=200.0, protocol=protocol, tags=tags, antenna_delays=told)
    uwblink.record(ports.names.values(), path, plan, duration_s=duration_s, using=ports)
    # Boards stand still: one pose each is enough.
    rows = [f"0,b{tag},{x},{y},{z},0,0,0,1" for tag, (x, y, z) in PLACES_M.items()]
    path.with_suffix(".csv").write_text("\n".join(["time_ns,body,x,y,z,qx,qy,qz,qw", *rows]))
    add_poses(path, path.with_suffix(".csv"))
    return path


def totals(path):
    """Return the sum of the programmed delays by tag, read without code of the packages."""
    tags = tomllib.loads(path.read_text())["antenna_delays"]["tags"]
    return {int(tag): one["tx"] + one["rx"] for tag, one in tags.items()}


def errors_cm(path):
    """Return the mean error of each pair's printed ranges, from the positions of the boards."""
    x = uwblink.load(path).exchanges
    return {
        (a, b): 100 * (x.range_m[(x.initiator == a) & (x.target == b)].mean() - math.dist(PLACES_M[a], PLACES_M[b]))
        for a, b in combinations(PLACES_M, 2)
    }


@pytest.fixture(scope="module")
def loop(tmp_path_factory):
    """Recorded as delivered, fitted, exported, programmed, recorded and fitted again."""
    folder = tmp_path_factory.mktemp("loop")
    world = scenario(DELAYS_NS)
    for name, delays in (("first", None), ("second", folder / "first.toml")):
        recording, fitted = record(world, folder / f"{name}.uwb", delays), folder / f"{name}.json"
        succeed("calib", "fit", recording, "-o", fitted, "--delays-only")
        succeed("calib", "export", fitted, "--to", "firmware", "-o", folder / f"{name}.toml")
    succeed("calib", "export", folder / "first.json", "--to", "registers", "-o", folder / "registers.toml")
    return folder


def test_programmed_delays_are_found_again(loop):
    once, again = totals(loop / "first.toml"), totals(loop / "second.toml")
    for tag, delay in DELAYS_NS.items():
        assert once[tag] - 2 * 16436 == pytest.approx(-delay * 1e-9 / TICK_S, abs=1.5)
        assert again[tag] == pytest.approx(once[tag], abs=1)
    delays = json.loads((loop / "second.json").read_text())["delays_ns"]
    assert max(map(abs, delays.values())) < 1.5 * TICK_S * 1e9
    by_base = succeed(
        "calib", "export", loop / "second.json", "--to", "firmware", "--antenna-delays", loop / "second.uwb"
    )
    assert by_base.stdout == (loop / "second.toml").read_text()


@pytest.mark.slow
def test_registers_do_not_change_the_constant_of_delayed_replies(loop):
    """The target's own stamp has a constant of the firmware's build, which causes errors of single-sided ranges."""
    record(scenario(DELAYS_NS), loop / "registers.uwb", loop / "registers.toml")
    before, alone, with_constant = (errors_cm(loop / f"{name}.uwb") for name in ("first", "registers", "second"))
    assert max(map(abs, before.values())) > 5
    assert max(map(abs, alone.values())) > 2
    assert max(map(abs, with_constant.values())) < 0.6
    rows = tomllib.loads((loop / "registers.toml").read_text())["antenna_delays"]["tags"]
    for (_, target), error in alone.items():
        left = 100 * LIGHT / 2 * TICK_S * (rows[str(target)]["tx"] - 16436)
        assert error - with_constant[_, target] == pytest.approx(left, abs=0.15)
    assert {row["reply"] for row in rows.values()} == {16436}
    done = succeed("calib", "fit", loop / "registers.uwb", "-o", loop / "registers.json", "--delays-only")
    assert "delayed replies" in done.stderr


@pytest.mark.parametrize(
    ("through", "protocol"),
    [
        ("boards", "ds"),
        ("simulation", "ss"),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in (("boards", "ss"), ("simulation", "ds"))),
    ],
)
def test_stamps_are_those_of_the_firmware(tmp_path, protocol, through):
    """Registers change the stamps of the chip, the constant those of delayed replies; by ticks, without noise."""
    rows = {1: (16446, 16449, 16436), 2: (16430, 16400, 16441), 3: (16436, 16436, 16436), 4: (17000, 15880, 17000)}
    text = "".join(f"[antenna_delays.tags.{t}]\ntx = {a}\nrx = {b}\nreply = {c}\n" for t, (a, b, c) in rows.items())
    (tmp_path / "d.toml").write_text(text)
    world = scenario(dict.fromkeys(rows, 0.0), noise_ps=0.0, protocol=protocol)
    if through == "boards":
        record(world, tmp_path / "f.uwb", tmp_path / "d.toml", protocol, duration_s=1.0)
    else:
        uwbsim.simulate(programmed(world, tmp_path / "d.toml")).save(tmp_path / "f.uwb")
    recording = uwblink.load(tmp_path / "f.uwb")
    by_tag = recording.meta["configured_antenna_delay_ticks_by_tag"]
    assert {int(t): (r["tx"], r["rx"], r.get("reply", r["tx"])) for t, r in by_tag.items()} == {
        tag: row for tag, row in rows.items() if through == "boards" or tag != 3
    }
    found = recording.exchanges
    tx, rx, reply = (np.array([0, *column]) for column in zip(*rows.values(), strict=True))
    i, j = found.initiator, found.target
    assert np.all((found.tx1 - tx[i]) % 512 == 0)
    assert np.all((found.tx2 - (tx if protocol == "ds" else reply)[j]) % 512 == 0)
    programmed_ticks = tx + rx - 2 * 16436
    longer = -(programmed_ticks[i] + programmed_ticks[j]) / 2
    if protocol == "ds":
        assert np.all((found.tx3 - reply[j]) % 512 == 0)
        wrapped = [(later - earlier) % 2**32 for later, earlier in ((found.tx2, found.rx1), (found.tx3, found.tx2))]
        longer = longer + (reply - tx)[j] * wrapped[0] / wrapped[1] / 2
    else:
        longer = longer - (reply - tx)[j] / 2
    places = np.array([(0.0, 0.0, 0.0), *PLACES_M.values()])
    true = np.linalg.norm(places[i] - places[j], axis=1)
    left_m = calib.Ranges.from_exchanges(found).raw_m - true - longer * TICK_S * LIGHT
    for a, b in combinations(rows, 2):
        # Stamps are whole ticks of 4.7 mm; boards that stand still repeat the same rounding.
        assert abs(left_m[(i == a) & (j == b)].mean()) < 2.4e-3


def test_recordings_require_the_programmed_delays(loop, tmp_path):
    world = scenario(DELAYS_NS)
    with pytest.raises(uwblink.errors.PlanError, match=r"board 1.*16436"):
        record(world, tmp_path / "f.uwb", loop / "first.toml", said=False)
    assert not list(tmp_path.glob("f.uwb*"))
    (tmp_path / "some.toml").write_text("\n".join((loop / "first.toml").read_text().split("\n\n")[:2]))
    with pytest.raises(uwblink.errors.PlanError, match="board 3, 4"):
        record(world, tmp_path / "f.uwb", tmp_path / "some.toml")
    (tmp_path / "unclear.toml").write_text("[antenna_delays]\ntx = 16446\nrx = 16449\n")
    with pytest.raises(uwblink.errors.PlanError, match=r"unclear\.toml: antenna_delays\.reply"):
        load_antenna_delays(tmp_path / "unclear.toml")


@pytest.mark.slow
def test_calibrations_with_other_programmed_delays_have_warnings(loop, tmp_path):
    second, first = loop / "second.uwb", loop / "first.json"
    for words in (
        ("calib", "evaluate", second, "-c", first),
        ("calib", "apply", second, "-c", first, "-o", tmp_path / "c.uwb"),
        ("uwblink", "stream", second, "-c", first, "--speed", "inf"),
    ):
        done = succeed(*words)
        assert "warning: " in done.stderr
        assert "tag 1: 16436/16436 then" in done.stderr
        own = [loop / "second.json" if w == first else w for w in words]
        assert "tag 1" not in run(*own, "--force").stderr
    assert "tag 1: 16436/16436 then" in run("calib", "localize", second, "-c", first).stderr
    refuse("calib", "export", first, "--to", "registers", "--antenna-delays", second, naming=["--antenna-delays"])
    with pytest.raises(calib.BadInputError, match=r"second\.uwb: tag 1"):
        calib.load_ranges([loop / "first.uwb", second])


def test_unknown_programmed_delays_give_no_registers(tmp_path):
    known = calib.fit(replace(calib.load_ranges(calib.sample_flight()), antenna_delays={})).calibration
    known.save(tmp_path / "c.json")
    refuse("calib", "export", tmp_path / "c.json", "--to", "registers", naming=["--antenna-delays"])
    (tmp_path / "d.toml").write_text("[antenna_delays]\ntx = 100\nrx = 200\nreply = 300\n")
    words = ("--to", "firmware", "--antenna-delays", tmp_path / "d.toml", "-o", tmp_path / "o.toml")
    succeed("calib", "export", tmp_path / "c.json", *words)
    expected = {tag: 300 + round(-delay * 1e-9 / TICK_S) for tag, delay in known.delays_ns.items()}
    assert totals(tmp_path / "o.toml") == expected
    rows = tomllib.loads((tmp_path / "o.toml").read_text())["antenna_delays"]["tags"]
    assert all(row["reply"] == row["tx"] for row in rows.values())


def test_simulated_flights_with_programmed_delays_have_the_planted_ones(loop, tmp_path):
    words = ("uwbsim", "run", "noiseless", "--set", "run.duration_s=10")
    succeed(*words, "-o", tmp_path / "a.uwb")
    rows = {tag: (16440 + tag, 16450 - 2 * tag) for tag in range(1, 7)}
    text = "".join(f"[antenna_delays.tags.{t}]\ntx = {a}\nrx = {b}\nreply = {a}\n" for t, (a, b) in rows.items())
    (tmp_path / "d.toml").write_text(text)
    succeed(*words, "-o", tmp_path / "b.uwb", "--antenna-delays", tmp_path / "d.toml")
    flights = [uwblink.load(tmp_path / f"{name}.uwb") for name in "ab"]
    planted = np.array([[flight.meta["planted"]["delays_ns"][str(tag)] for tag in rows] for flight in flights])
    fitted = [calib.fit(flight).calibration.delays_ns for flight in flights]
    assert np.ptp([[one[tag] for tag in rows] for one in fitted] - planted, axis=1).max() < 0.03
    assert planted[1] - planted[0] == pytest.approx([(a + b - 2 * 16436) * TICK_S * 1e9 for a, b in rows.values()])
