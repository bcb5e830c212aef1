"""The captured transcripts played as command scripts: virtual boards answer in the firmware's shapes and order."""

import ast
import re
from collections import Counter
from pathlib import Path

import pytest

from tests.boards import bench_scenario
from uwbsim.boards.virtual_board import VirtualPorts

FILE = Path(__file__).parents[1] / "golden" / "board_transcripts.txt"
LINE = re.compile(r"^ +([\d.]+) ms +board (\d+) +(<-host|->host) +(b\".*\")$")
MS = 1_000_000


def scripts():
    """Pieces of the transcript that start with fresh boards: lists of (ms, board, direction, bytes)."""
    pieces: list[list[tuple[float, int, str, bytes]]] = []
    current: list[tuple[float, int, str, bytes]] = []
    for text in FILE.read_text().splitlines():
        if text.startswith(("====", "--")):
            pieces.append(current)
            current = []
        elif match := LINE.match(text):
            current.append((float(match[1]), int(match[2]), match[3], ast.literal_eval(match[4])))
    pieces.append(current)
    return [piece for piece in pieces if any(line[2] == "<-host" for line in piece)]


def shape(data):
    """What must agree: the text, or the key, ids, number of fields, and which of them are literally zero."""
    if not re.match(rb"[RS]\d\d\|", data) or data[:3] in (b"R01", b"R03", b"R07", b"S06"):
        return data
    parts = data.rstrip(b"\r\n").split(b"|")
    ids = {b"R05": 2, b"S05": 2, b"S01": 3}[parts[0]]
    kinds = tuple(p if p in (b"0", b"0.0000") else b"." if b"." in p else b"n" for p in parts[ids:])
    return (*parts[:ids], kinds)


@pytest.mark.parametrize("script", scripts(), ids=lambda s: repr(next(x[3] for x in s if x[2] == "<-host"))[:30])
def test_answers_have_the_firmware_s_shapes_order_and_timing(script):
    ports = VirtualPorts(bench_scenario(rx_noise_ps=100.0))
    bench = ports.bench
    captured: dict[int, list[tuple[float, bytes]]] = {k: [] for k in sorted({line[1] for line in script} | {1, 2})}
    for absent in set(bench.boards) - set(captured):
        bench.boards[absent].power_off()
    for ms, board, direction, data in script:
        if direction == "<-host":
            bench.advance(int(ms * MS))
            bench.boards[board].write(data)
        elif ms > 9:  # before that boards boot, before the port exists
            captured[board].append((ms, data))
    bench.advance(int((script[-1][0] + 60) * MS))
    for board, lines in captured.items():
        sent = [(t / MS, data) for t, tag, data in ports.transfers if tag == board]
        assert [shape(data) for _, data in sent] == [shape(data) for _, data in lines]
        for (ours, _), (theirs, data) in zip(sent, lines, strict=True):
            # Both poll their buffer once a millisecond, at phases of their own; the rest is processor time.
            assert ours == pytest.approx(theirs, abs=1.4), data


def test_two_commands_in_one_write_execute_the_last_and_retries_are_inherited():
    ports = VirtualPorts(bench_scenario())
    board = ports.bench.boards[1]
    board.write(b"C05|9|0|1|0\r")
    ports.bench.advance(20 * MS)  # two tries have failed
    board.write(b"C05|8|0|1|0\r")
    ports.bench.advance(80 * MS)
    failed = [t for t, _, data in ports.transfers if data.startswith(b"COMMANDED")]
    # Six tries of 7 ms in all, not six more: the newcomer inherits the count.
    assert len(failed) == 1
    assert failed[0] < 46 * MS


def test_a_long_command_that_straddles_a_poll_kills_the_board_in_a_share_of_phases():
    dead = 0
    for seed in range(200):
        ports = VirtualPorts(bench_scenario(seed))
        ports.bench.boards[1].write(b"C06|\x50\x00" + b"a" * 80 + b"\r")
        ports.bench.advance(10 * MS)
        dead += not ports.bench.boards[1].alive
    # 55 us between the packets in a period of 1 ms: 5.5 % of phases, 11 of 200, give or take three sigma.
    assert 1 <= dead <= 21


def test_a_power_cycle_forgets_passive_listening_and_the_delay():
    ports = VirtualPorts(bench_scenario())
    board = ports.bench.boards[3]
    board.write(b"C04|1\r")
    ports.bench.advance(5 * MS)
    board.write(b"C08|3000\r")
    ports.bench.advance(10 * MS)
    assert (board.passive, board.delay_uus) == (True, 3000)
    board.power_cycle()
    assert (board.passive, board.delay_uus) == (False, 1500)


def test_a_listener_that_misses_the_response_prints_26_fields_and_otherwise_nothing():
    ports = VirtualPorts(bench_scenario(), lost_share=0.3)
    bench = ports.bench
    bench.boards[3].write(b"C04|1\r")
    bench.advance(5 * MS)
    for k in range(400):
        bench.advance((10 + 60 * k) * MS)
        bench.boards[1].write(b"C05|2|1|1|0\r")
    bench.advance((10 + 60 * 400) * MS)
    counts = Counter(data.count(b"|") for _, tag, data in ports.transfers if tag == 3 and data[:3] == b"S01")
    assert set(counts) == {21, 26}
    # A listener that hears the poll hears the other four frames, of which the last is sent only if the initiator heard
    # the two before (0.7^6), or it misses the response (0.7 x 0.3), which may never have been sent (0.3).
    whole, zeros = 0.7**6, 0.3 + 0.7 * 0.3
    assert counts.total() > 200
    assert counts[26] / counts.total() == pytest.approx(zeros / (zeros + whole), abs=0.075)  # three sigma
