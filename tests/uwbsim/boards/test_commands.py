"""What boards read and do: C's numbers, floats that are none, and commands that a stranger adds."""

from itertools import pairwise

import pytest

from tests.boards import bench_scenario
from uwblink.boards.board import Board
from uwblink.errors import RefusedError
from uwblink.wire import messages as m
from uwblink.wire.fields import INT, PRINTED, TEXT
from uwbsim.boards.commands import EXECUTORS, atoi, printed_float, read_commands, register_command
from uwbsim.boards.frames import NS_PER_MS
from uwbsim.boards.virtual_board import VirtualPorts
from uwbsim.errors import UwbsimError


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
    """The new messages as a stranger registers them, taken out again afterwards."""
    m.register_message(GetVoltage)
    m.register_message(Voltage)
    yield
    del m.COMMANDS[b"C10"], m.REPORTS[b"R10"]
    EXECUTORS.pop(b"C10", None)


def test_a_new_command_is_one_message_class_and_one_executor(voltage):
    register_command(GetVoltage, lambda board, factor, name: Voltage(board.id, 3.25 * factor, name.decode()))
    ports = VirtualPorts(bench_scenario())
    assert Board(ports.port(2)).request(GetVoltage(2, "core")) == Voltage(2, 6.5, "core")
    assert Board(ports.port(1)).request(m.GetId()) == m.IdReport(1)
    assert ports.transfers.maxlen == 20_000, "what boards sent long ago is not kept"


def test_an_executor_may_take_its_time_and_may_fail(voltage):
    def slowly(board, factor, name):
        tries.append(int(board.bench.env.now))
        yield board.bench.env.timeout(3 * NS_PER_MS)
        if len(tries) <= factor:
            return False
        yield from board.answer(Voltage(board.id, 1.0, name.decode()))
        return True

    register_command(GetVoltage, slowly)
    board = Board(VirtualPorts(bench_scenario()).port(1))
    tries: list[int] = []
    assert board.request(GetVoltage(2, "slow")) == Voltage(1, 1.0, "slow")
    # Tried at the polls of the USB buffer, one each millisecond.
    assert [(b - a) / NS_PER_MS for a, b in pairwise(tries)] == [4.0, 4.0]
    tries.clear()
    assert board.request(GetVoltage(5, "last")) == Voltage(1, 1.0, "last")


def test_commands_and_fields_that_boards_cannot_read_are_refused(monkeypatch):
    with pytest.raises(UwbsimError, match="GetVoltage: not a command that uwblink knows"):
        register_command(GetVoltage, lambda board: m.IdleSet())
    monkeypatch.setitem(m.COMMANDS, b"R10", Voltage)
    with pytest.raises(UwbsimError, match=r"Voltage\.volts: boards read no printed number from the host; they read"):
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
def test_what_boards_take_otherwise_than_the_firmware_is_what_the_page_says(data, kinds, alive):
    """docs/boards.md says it; the last of them has 255 bytes."""
    reading = read_commands(data)
    assert [command.kind for command in reading.commands] == kinds
    assert reading.alive == alive


@pytest.mark.parametrize("text", ["a\0b", "a|b", "a\rb"])
def test_the_driver_writes_no_text_that_boards_read_otherwise(text):
    ports = VirtualPorts(bench_scenario())
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
def test_floats_that_are_none_are_printed_as_the_processor_prints_them(value, printed):
    assert printed_float(value) == printed


@pytest.mark.parametrize("raw", [b"\x00\x00\xc0\x7f", b"\x00\x00\x80\x7f", b"\x00\x00\x80\xff", b"\xff\xff\x7f\x7f"])
def test_a_number_that_is_none_does_not_stop_the_bench(raw):
    ports = VirtualPorts(bench_scenario())
    ports.bench.boards[1].write(b"C03|1|a|1|" + raw + b"|\x01\x00x\r")
    ports.bench.advance(5 * NS_PER_MS)
    assert ports.transfers[0][2].startswith(b"R03|0|1|a|1|")
    assert Board(ports.port(2)).id == 2
