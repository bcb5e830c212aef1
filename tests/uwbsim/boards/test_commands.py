"""Input and actions of boards: numbers of C, NaN and infinities, and registered commands."""

import math
import random
import struct
from contextlib import closing
from itertools import pairwise

import numpy as np
import pytest

import uwbsim
from tests.boards import bench_scenario, served
from tests.fuzz.mutations import flip
from tests.processes import wait_until
from uwblink.boards.board import Board
from uwblink.errors import PortLostError, PortMissingError, RefusedError
from uwblink.importers.poses import read_poses
from uwblink.wire import messages as m
from uwblink.wire.fields import INT, PRINTED, TEXT
from uwbsim.boards.commands import EXECUTORS, atoi, printed_float, read_commands, register_command
from uwbsim.boards.frames import NS_PER_MS
from uwbsim.boards.server import LivePoses, Server, stays_s
from uwbsim.world.world import World


@m.message(b"C10")
class GetVoltage(m.Message):
    """C10: ask for a supply voltage, times a factor."""

    factor: int = m.wire(INT)
    name: str = m.wire(TEXT)


@m.message(b"R10")
class Voltage(m.Message):
    """R10: the answer."""

    board: int = m.wire(INT)
    volts: float = m.wire(PRINTED)
    name: str = m.wire(TEXT)


@pytest.fixture
def voltage():
    """Register the new messages, and remove them afterwards."""
    m.register_message(GetVoltage)
    m.register_message(Voltage)
    yield
    del m.COMMANDS[b"C10"], m.REPORTS[b"R10"]
    EXECUTORS.pop(b"C10", None)


@pytest.fixture
def ports():
    return uwbsim.VirtualPorts(bench_scenario())


def test_a_new_command_is_one_message_class_and_one_executor(voltage, ports):
    register_command(GetVoltage, lambda board, factor, name: Voltage(board.id, 3.25 * factor, name.decode()))
    assert Board(ports.port(2)).request(GetVoltage(2, "core")) == Voltage(2, 6.5, "core")
    assert Board(ports.port(1)).request(m.GetId()) == m.IdReport(1)
    assert ports.transfers.maxlen == 20_000, "what boards sent long ago is not kept"


def test_slow_and_failing_executors_are_allowed(voltage):
    def slowly(board, factor, name):
        tries.append(int(board.bench.env.now))
        yield board.bench.env.timeout(3 * NS_PER_MS)
        if len(tries) <= factor:
            return False
        yield from board.answer(Voltage(board.id, 1.0, name.decode()))
        return True

    register_command(GetVoltage, slowly)
    board = Board(uwbsim.VirtualPorts(bench_scenario()).port(1))
    tries: list[int] = []
    assert board.request(GetVoltage(2, "slow")) == Voltage(1, 1.0, "slow")
    # Tried at the polls of the USB buffer, one each millisecond.
    assert [(b - a) / NS_PER_MS for a, b in pairwise(tries)] == [4.0, 4.0]
    tries.clear()
    assert board.request(GetVoltage(5, "last")) == Voltage(1, 1.0, "last")


def test_commands_and_fields_that_boards_cannot_read_are_refused(monkeypatch):
    with pytest.raises(uwbsim.UwbsimError, match="GetVoltage: not a registered command of uwblink"):
        register_command(GetVoltage, lambda board: m.IdleSet())
    monkeypatch.setitem(m.COMMANDS, b"R10", Voltage)
    with pytest.raises(
        uwbsim.UwbsimError, match=r"Voltage\.volts: boards cannot read printed number from the host; they read"
    ):
        register_command(Voltage, lambda board: m.IdleSet())


@pytest.mark.parametrize(
    ("text", "number"),
    [
        (b"12", 12),
        (b" -7x", -7),
        (b"+0003", 3),
        (b"maybe", 0),
        (b"", 0),
        (b"2147483648", 2**31 - 1),
        (b"-99999999999999999999", -(2**31)),
        (b"9" * 6000, 2**31 - 1),
        (b"0" * 6000 + b"5", 5),
    ],
)
def test_numbers_are_read_as_c_reads_them(text, number):
    assert atoi(text) == number


@pytest.mark.parametrize(
    ("data", "kinds", "alive"),
    [
        (b"C01\0\r", [m.GetId], True),
        (b"C05|2\0|0|0|0\r", [m.RangeCommand], True),
        (b"C03|1|a\0b|1|\0\0\0\0|\x02\0\0\0\r", [m.DoTests], True),
        (b"C01\n", [], False),
        (b"C05|2|0|0|0\n", [], False),
        (b"C-1\r", [], False),
        (b"C03|1|" + b"a" * 196 + b"|1|\0\0\0\0|" + b"\x2a\0" + b"x" * 42 + b"\r", [m.DoTests], True),
    ],
)
def test_differences_from_the_firmware_are_those_on_the_page(data, kinds, alive):
    """docs/boards.md lists them; the last has 255 bytes."""
    reading = read_commands(data)
    assert ([command.kind for command in reading.commands], reading.alive) == (kinds, alive)


@pytest.mark.parametrize("text", ["a\0b", "a|b", "a\rb"])
def test_the_driver_writes_no_text_that_boards_read_otherwise(text, ports):
    with pytest.raises(RefusedError, match="text"):
        Board(ports.port(1)).request(m.DoTests(1, text, True, 1.0, b"\0\r|"))
    assert not ports.transfers
    answer = Board(ports.port(1)).request(m.DoTests(1, "a\nb", True, 1.0, b"\0\r|"))
    assert isinstance(answer, m.TestsDone)
    assert answer.text == "a\nb"


def test_the_last_command_of_a_buffer_keeps_its_values():
    reading = read_commands(b"C01\rC05|258|1|2|0|more\rjunk")
    assert [c.kind for c in reading.commands] == [m.GetId, m.RangeCommand]
    assert reading.commands[1].values == (258, True, True, False)
    assert (reading.rest, reading.alive) == (b"junk", True)


@pytest.mark.parametrize(
    ("value", "printed"),
    [
        (float("nan"), b"0.0000"),
        (float("inf"), b"2147483647.0000"),
        (-float("inf"), b"-2147483648.0000"),
        (3e38, b"2147483647.0000"),
        (1e10, b"2147483647.0000"),
        (1.25, b"1.2500"),
        (-0.00001, b"-0.0000"),
    ],
)
def test_nan_and_infinity_are_printed_like_the_processor(value, printed):
    assert printed_float(value) == printed


# No byte of a client stops the bench or another board: six thousand commands, correct, wrong and damaged.


COMMANDS = 6_000
NUMBERS = [*(b"%d" % n for n in (0, 1, 2, 9, 255, 258, -1, 65536, 2**31)), b"9" * 40, b"", b"two", b"1.5", b"\xff"]
FLOATS = (0.0, -0.0, 1.5, 1e10, -1e30, 3.4e38, 1e-40, float("nan"), float("inf"), -float("inf"))
RANDOM_SHARE, MANGLED_SHARE, RANGE_SHARE = 0.1, 0.2, 0.03


def command(rng):
    """Return a command whose fields have the right types and random values."""
    numbers = [rng.choice(NUMBERS) for _ in range(4)]
    data = rng.randbytes(rng.choice((0, 1, 5, 40, 92, 93, 200)))
    counted = struct.pack("<H", len(data) if rng.random() < 0.9 else rng.randrange(65_536)) + data
    tests = (numbers[0], rng.randbytes(rng.randrange(8)), numbers[1], struct.pack("<f", rng.choice(FLOATS)), counted)
    fields = {0: (), 1: (), 2: (), 3: tests, 4: numbers[:1], 6: (counted,), 7: (), 8: numbers[:1], 9: ()}
    key = rng.choice([*fields, rng.randrange(10, 100)])
    parts = fields.get(key, numbers[:1])
    if rng.random() < RANGE_SHARE:
        key, parts = 5, numbers
    if rng.random() < 0.1:
        parts = parts[: rng.randrange(len(parts) + 1)]
    return b"C%02d" % key + b"".join(b"|" + part for part in parts) + b"\r"


def test_no_byte_ends_the_bench_or_another_board():
    rng = random.Random(20261121)
    ports = uwbsim.VirtualPorts(bench_scenario(), lost_share=0.1)
    bench, victim = ports.bench, ports.bench.boards[1]
    deaths = answers = 0
    for number in range(COMMANDS):
        kind = rng.random()
        data = rng.randbytes(rng.randrange(1, 90)) if kind < RANDOM_SHARE else command(rng)
        victim.write((flip(data, rng) if kind > 1 - MANGLED_SHARE else None) or data)
        bench.advance(int(bench.env.now) + rng.choice((NS_PER_MS // 10, NS_PER_MS, NS_PER_MS, 2 * NS_PER_MS)))
        if not (victim.alive and victim.usb.open):
            deaths += 1
            victim.power_cycle()
        if number % 1000 == 999:
            answers += len(ports.transfers)
            ports.transfers.clear()
            assert Board(ports.port(2)).id == 2
            assert all(bench.boards[k].alive for k in (2, 3))
    victim.power_cycle()
    assert Board(ports.port(1)).request(m.GetId()) == m.IdReport(1)
    # Many of these stop a board, as they stop a real one, and many are answered: the test covers both.
    assert deaths > 60
    assert answers > 600


# Poses in the time of the boards, while they are served.


EPOCH_NS = 1_700_000_000_000_000_000


def flight(**mocap):
    """Boards, one of which flies."""
    box = {"box_min_m": [-2.0, -2.0, 0.5], "box_max_m": [2.0, 2.0, 2.0]}
    tables = bench_scenario().model_dump(mode="json") | {"mocap": {"rate_hz": 120.0, **mocap}}
    return uwbsim.load(tables, {"bodies.0.motion": {"model": "random-flight", "speed_mps": 1.0} | box})


def written(world, path, steps):
    poses = LivePoses(world, path, EPOCH_NS)
    for step in steps:
        poses.write_until(round(step * 1e9))
    poses.close()
    return read_poses(path, None)


def test_the_file_holds_every_pose_up_to_now_and_none_after(tmp_path):
    poses = LivePoses(World(flight(latency_ms=20.0)), tmp_path / "p.csv", EPOCH_NS)
    for now_s in (0.5, 0.5, 0.7031, 7.0):
        poses.write_until(round(now_s * 1e9))
        found = read_poses(tmp_path / "p.csv", None)
        late = (found.time_ns - EPOCH_NS) * 1e-9
        # Three bodies; a pose of time t is written at t + 20 ms.
        assert len(found) == 3 * (int((now_s - 0.02) * 120) + 1)
        assert now_s - 1 / 120 < late.max() <= now_s
    poses.close()


@pytest.mark.slow
def test_poses_are_those_of_the_world_and_do_not_depend_on_the_pieces(tmp_path):
    world = World(flight(position_noise_m=0.001, attitude_noise_rad=0.01, gaps_per_min=20.0))
    one = written(world, tmp_path / "one.csv", [30.0])
    many = written(world, tmp_path / "many.csv", np.arange(0.1, 30.01, 0.1))
    np.testing.assert_array_equal(one.time_ns, many.time_ns)
    mine = one.body == "b1"
    true = world.trajectories["b1"].position_m((one.time_ns[mine] - EPOCH_NS) * 1e-9)
    assert (one.position_m[mine] - true).std() == pytest.approx(0.001, rel=0.05)
    # 20 gaps per minute of half a second each: a seventh of the time is without poses.
    assert 0.6 < (np.count_nonzero(mine) / (30 * 120)) < 0.95
    assert np.diff(one.time_ns[mine]).max() == pytest.approx(0.5e9, rel=0.1)


def test_served_poses_go_on_after_the_scenario_s_duration(tmp_path):
    # Few enough for a loaded machine at twenty times the time of the boards.
    short = uwbsim.load(flight(rate_hz=20.0).model_dump(mode="json"), {"run.duration_s": 1.0})
    with served(short, speed=20.0) as server:
        server.write_poses(tmp_path / "p.csv")

        def served_s():
            # The file may grow between two readings, so only its complete lines count.
            complete = (tmp_path / "p.csv").read_text().rpartition("\n")[0].splitlines()
            return (int(complete[-1].partition(",")[0]) - server.epoch_ns) * 1e-9 if len(complete) > 1 else 0.0

        wait_until(lambda: served_s() > 5.0)


def test_a_step_ends_though_poses_take_longer_to_write_than_they_last(tmp_path):
    # A tenth of a second of the boards is 5 us of real time: the next poses are due before these are written.
    with closing(Server(flight(rate_hz=0.2), speed=2e4)) as server:
        server.write_poses(tmp_path / "p.csv")
        for _ in range(3):
            server.step()
    assert len((tmp_path / "p.csv").read_text().splitlines()) > 1


def test_poses_that_cannot_be_written_end_and_the_serving_goes_on(tmp_path):
    told: list[str] = []
    with served(flight(), tell=told.append) as server:
        server.write_poses(tmp_path / "p.csv")
        # The first file is closed after the end of serving, which may be writing to it now.
        first, server._poses._file = server._poses._file, open("/dev/full", "w", encoding="utf-8")  # noqa: SIM115 - closed by the server
        for _ in range(100):
            with Board.open(server.names[2]) as board:
                assert board.id == 2
            if told:
                break
    first.close()
    assert told == ["the poses end here: No space left on device"]


# Intervals in which carried boards stand still, as printed by a server.


def scenario(stays=((0.2, 0.1),), places=3):
    bodies = [
        {"name": f"b{k}", "motion": {"model": "carried", "stay_s": stay, "carry_s": carry, "places_m": [[k, p, 1.0]
         for p in range(places)]}}
        for k, (stay, carry) in enumerate(stays)
    ]  # fmt: skip
    bodies += [{"name": f"w{k}", "motion": {"model": "static", "position_m": [9.0, k, 1.0]}} for k in (0, 1)]
    tags = [{"id": k + 1, "body": body["name"]} for k, body in enumerate(bodies)]
    return uwbsim.load({"run": {"duration_s": 9.0}, "ranging": {"rate_hz": 20.0}, "bodies": bodies, "tags": tags})


def test_boards_stand_still_while_no_body_is_carried():
    found = stays_s(scenario(((10.0, 2.0), (5.0, 4.0)), places=2))
    assert (found, stays_s(scenario(()))) == ([(0.0, 5.0), (9.0, 10.0), (12.0, math.inf)], [])
    assert stays_s(scenario(((10.0, 2.0),), places=1)) == [(0.0, math.inf)]


def test_a_server_prints_when_boards_stand_still():
    told: list[str] = []
    with closing(uwbsim.Server(scenario())) as server:
        server.announce(told.append)
        server.run(lambda: len(told) == 3, 20.0)
    assert told == [
        "    0 s  place 1 of 3: boards stand until 0.2 s",
        "  0.3 s  place 2 of 3: boards stand until 0.5 s",
        "  0.6 s  place 3 of 3: boards stay there",
    ]


def test_an_unplugged_board_is_gone_until_it_is_plugged_in_again():
    ports = uwbsim.VirtualPorts("noiseless")
    tag, name = next(iter(ports.names.items()))
    port, board = ports.port(tag), ports.bench.boards[tag]
    port.write(b"C01\r")
    board.power_off()
    uses = (lambda: port.read(0.1), lambda: port.write(b"C01\r"), lambda: ports.open(name))
    for use, lost in zip(uses, (PortLostError, PortLostError, PortMissingError), strict=True):
        with pytest.raises(lost):
            use()
    assert ports.moved(name, None) is None
    board.power_cycle()
    assert (ports.open(name), ports.moved(name, None)) == (port, name)
    port.write(b"C01\r")
    assert port.read(0.1) == b"R01|%d\r\n" % tag
