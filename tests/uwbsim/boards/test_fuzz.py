"""No byte from a client ends the bench or another board: six thousand commands, right, wrong and mangled."""

import random
import struct

from tests.boards import bench_scenario
from uwblink.boards.board import Board
from uwblink.wire import messages as m
from uwbsim.boards.frames import NS_PER_MS
from uwbsim.boards.virtual_board import VirtualPorts

COMMANDS = 6_000
NUMBERS = [*(b"%d" % n for n in (0, 1, 2, 9, 255, 258, -1, 65536, 2**31)), b"9" * 40, b"", b"two", b"1.5", b"\xff"]
FLOATS = (0.0, -0.0, 1.5, 1e10, -1e30, 3.4e38, 1e-40, float("nan"), float("inf"), -float("inf"))
RANDOM_SHARE, MANGLED_SHARE, RANGE_SHARE = 0.1, 0.2, 0.03


def command(rng):
    """A command whose fields are of the right kinds, with values that nobody asked for."""
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


def mangled(rng, data):
    """The same with bytes replaced, left out, or doubled."""
    data = bytearray(data)
    for _ in range(rng.randrange(1, 4)):
        at = rng.randrange(len(data))
        data[at : at + 1] = rng.choice((b"", rng.randbytes(1), data[at : at + 1] * 2, b"|", b"\r", b"C"))
        if not data:
            break
    return bytes(data)


def test_no_byte_ends_the_bench_or_another_board():
    rng = random.Random(20261121)
    ports = VirtualPorts(bench_scenario(), lost_share=0.1)
    bench, victim = ports.bench, ports.bench.boards[1]
    deaths = answers = 0
    for number in range(COMMANDS):
        kind = rng.random()
        data = rng.randbytes(rng.randrange(1, 90)) if kind < RANDOM_SHARE else command(rng)
        victim.write(mangled(rng, data) if kind > 1 - MANGLED_SHARE else data)
        bench.advance(int(bench.env.now) + rng.choice((NS_PER_MS // 10, NS_PER_MS, NS_PER_MS, 2 * NS_PER_MS)))
        if not (victim.alive and victim.powered):
            deaths += 1
            victim.power_cycle()
        if number % 1000 == 999:
            answers += len(ports.transfers)
            ports.transfers.clear()
            assert Board(ports.port(2)).id == 2
            assert all(bench.boards[k].alive for k in (2, 3))
    victim.power_cycle()
    assert Board(ports.port(1)).request(m.GetId()) == m.IdReport(1)
    # Much of this kills a board, as it does a real one, and much is answered: the test reaches both.
    assert deaths > 60
    assert answers > 600
