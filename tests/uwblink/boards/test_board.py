"""Boards that react late or never, the driver's side of a conversation, ports, and ranging plans."""

import errno
import json
import socket
import threading

import pytest

from tests import processes
from tests.boards import served
from tests.errors import one_line
from uwblink.boards.board import FENCE, Board, Connection
from uwblink.boards.ports import SerialPort, _port_error
from uwblink.boards.ranging_plan import RangingPlan, load_plan
from uwblink.errors import (
    NoAnswerError,
    PlanError,
    PortBusyError,
    PortError,
    PortLostError,
    PortMissingError,
    PortPermissionError,
    RangingFailedError,
    RefusedError,
)
from uwblink.recording.schema import Tag, load_places
from uwblink.wire import messages as m
from uwblink.wire.codec import encode


class Deaf:
    """A board that reads its input only from `wakes_s` on; time advances while it is read."""

    name = "port"

    def __init__(self, wakes_s, answers):
        self.time_s, self.wakes_s, self.answers, self.heard = 0.0, wakes_s, answers, []

    def write(self, data):
        self.heard.append(data)

    def read(self, timeout_s):
        if self.heard and self.time_s + timeout_s >= self.wakes_s:
            self.time_s = max(self.time_s, self.wakes_s)
            # The firmware executes only the last of the waiting commands.
            last, self.heard = self.heard[-1], []
            return self.answers[last]
        self.time_s += timeout_s
        return b""

    def now_s(self):
        return self.time_s

    def close(self):
        pass


ANSWERS = {b"C00\r": b"R00\r\n", b"C01\r": b"R01|7\r\n", b"C06|\x01\x00x\r": b"R06\r\n"}


def test_a_board_without_reaction_for_300_ms_is_asked_once_more():
    assert Board(Deaf(0.3, ANSWERS)).id == 7


def test_a_broadcast_is_not_sent_twice():
    deaf = Deaf(0.3, ANSWERS)
    with pytest.raises(NoAnswerError, match="no answer to b'C06") as caught:
        Board(deaf).send(b"x")
    assert "must be unplugged" not in str(caught.value), "it came back"


def test_boards_without_an_answer_for_a_second_are_reported_as_dead():
    deaf = Deaf(1e9, ANSWERS)
    said = r"b'C01.* within 150 ms; heard nothing; then no answer.*1000 ms.*must be unplugged\Z"
    with pytest.raises(NoAnswerError, match=said):
        _ = Board(deaf).id
    assert deaf.time_s == pytest.approx(1.15)


def test_the_second_request_may_fail():
    with pytest.raises(NoAnswerError, match="b'C01"):
        Board(Deaf(0.0, ANSWERS | {b"C01\r": b""})).request(m.GetId())


# The driver's side of a conversation, without ports: outcomes, late replies, fences, times, allowed commands.


REPORT = (
    b"R05|2|3.0550|2334148660|1211574983|1233803316|2356378373|1332123700|2454699099"
    b"|-87.4977|-87.5239|-3.4971|3.5222\r\n"
)


def asked(command=None):
    connection = Connection("port")
    assert connection.send(command or m.RangeCommand(2), 0.0) == encode(command or m.RangeCommand(2))
    return connection


def test_only_one_command_is_outstanding():
    with pytest.raises(RefusedError, match="still waiting"):
        asked().send(m.GetId(), 0.001)


def test_a_line_of_failure_does_not_end_a_command_that_cannot_fail():
    connection = asked(m.GetId())
    assert connection.receive(b"COMMANDED TASK FAILED AFTER 5 ATTEMPTS.\r\n", 0.001)[1] is None
    # The first of two replies is the outcome.
    assert connection.receive(b"R01|4\r\nR01|5\r\n", 0.002)[1].reply == m.IdReport(4)


CIR = encode(m.Cir(1, 2, 747_015, tuple(range(1016))))


def test_long_time_outs_of_a_connection_are_kept():
    connection = Connection("port", answer_s=2.0)
    for sent_s, heard, heard_s in ((0.0, b"", 2.0), (3.0, b"R00\r\n", 3.1)):
        connection.send(FENCE, sent_s)
        assert connection.deadline_s() == sent_s + 2.0
        connection.receive(heard, heard_s)
    assert not connection.doubtful


def test_the_last_60_bytes_are_quoted():
    connection = asked()
    connection.receive(b"\xff" + b"a" * 40, 0.01)
    connection.receive(b"b" * 21, 0.02)
    error = connection.receive(b"", 1.0)[1].error
    assert (type(error), str(error).partition("heard ")[2]) == (NoAnswerError, f"'{'a' * 39}{'b' * 21}'")


def test_only_requested_impulse_responses_block_the_board():
    connection = asked(m.RangeCommand(2))
    connection.receive(REPORT, 1.0)
    assert connection.ready_s(1.0) == 0.0
    with_cir = asked(m.RangeCommand(2, get_cir=True))
    with_cir.receive(REPORT, 1.0)
    assert (with_cir.ready_s(1.0), with_cir.ready_s(1.02)) == (pytest.approx(0.030), pytest.approx(0.010))
    # After it, the report of a target may follow within 3 ms.
    with_cir.receive(CIR, 1.028)
    assert (with_cir.ready_s(1.03), with_cir.ready_s(1.04)) == (pytest.approx(0.003), 0.0)


@pytest.mark.parametrize(
    ("command", "what"),
    [(m.RangeCommand(2), "ranging with 2"), (m.Broadcast(b"x"), "the broadcast")],
)
def test_failures_are_named_and_lines_quoted_once(command, what):
    connection = asked(command)
    warned = b"WARNING 0xC: TWR message is firing an interrupt when it shouldn't be.\r\n"
    assert connection.receive(warned + warned, 0.01)[1] is None
    outcome = connection.receive(b"COMMANDED TASK FAILED AFTER 5 ATTEMPTS.\r\n", 0.02)[1]
    assert isinstance(outcome.error, RangingFailedError)
    assert str(outcome.error).startswith(f"port: {what} failed; the board says: WARNING")
    assert (str(outcome.error).count("WARNING"), (outcome.reply, connection.busy)) == (1, (None, False))
    assert not connection.doubtful


def test_reports_answer_only_requests_of_their_target_and_protocol():
    single = REPORT.replace(b"|1332123700|2454699099|", b"|0|0|")
    for double_sided, not_asked, answer in (
        (False, single.replace(b"R05|2|", b"R05|3|"), single),
        (True, single, REPORT),
    ):
        connection = asked(m.RangeCommand(2, double_sided=double_sided))
        assert connection.receive(not_asked, 0.01)[1] is None
        assert (connection.receive(answer, 0.02)[1].reply.tx3 != 0) == double_sided
    assert asked(m.GetId()).receive(REPORT, 0.01)[1] is None


# Ports: errors state why a port cannot be opened, and a port can be a URL.


@pytest.mark.parametrize(
    ("name", "error", "said"),
    [
        ("/dev/nothing", PortMissingError, "no such port; `uwblink ports`"),
        ("/dev/null", PortError, "not a serial port"),
        ("{here}/file", PortError, "not a serial port"),
        ("{here}/", PortError, "{here}: is a folder; name the ports in it, as with {here}/[*]"),
        ("nonsense://x", PortError, "not a port"),
        ("socket://127.0.0.1:1", PortError, "cannot be opened"),
    ],
)
def test_ports_that_cannot_be_opened_are_named(tmp_path, name, error, said):
    (tmp_path / "file").write_text("x")
    with pytest.raises(error, match=said.format(here=tmp_path)):
        SerialPort(name.format(here=tmp_path))


def test_the_list_of_ports_as_json():
    done = processes.run("uwblink", "ports", "/dev/nothing", "--json")
    assert json.loads(done.stdout) == [{"device": "/dev/nothing", "description": "", "serial_number": None}]


def test_permission_denied_names_the_group(tmp_path):
    (tmp_path / "port").write_text("")
    error = _port_error(str(tmp_path / "port"), PermissionError(errno.EACCES, "Permission denied"))
    assert isinstance(error, PortPermissionError)
    assert f"join the group {(tmp_path / 'port').group()}" in str(error)


def test_a_port_opens_once_and_a_lost_port_is_an_error():
    with served() as server:
        port = SerialPort(server.names[1])
        with pytest.raises(PortBusyError, match="another process"):
            SerialPort(server.names[1])
        server.unplug(1)
        with pytest.raises(PortLostError, match="the port is gone"):
            for _ in range(10):
                port.read(0.1)
        port.close()


@pytest.fixture
def answerer():
    """A board behind TCP that only has an id."""
    listening = socket.create_server(("127.0.0.1", 0))

    def serve():
        connection, _ = listening.accept()
        with connection:
            while data := connection.recv(100):
                if data == b"C07\r":
                    return
                for piece in (b"R01|", b"77\r\n") if data == b"C01\r" else ():
                    connection.sendall(piece)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    yield listening.getsockname()[1]
    thread.join(5)
    listening.close()


def test_a_port_can_be_a_socket(answerer):
    with Board.open(f"socket://127.0.0.1:{answerer}") as board:
        assert board.id == 77
        with pytest.raises(PortLostError):
            board.request(m.GetMaxFrame())


def test_bytes_from_before_the_opening_are_not_taken_for_answers():
    with served() as server:
        for _ in range(3):
            server._terminals[1].write(encode(m.IdReport(200)))
        with Board.open(server.names[1]) as board:
            assert board.id == 1


# Ranging plans: files, turns, and errors.


def written(tmp_path, text):
    (tmp_path / "plan.toml").write_text(text)
    return tmp_path / "plan.toml"


def test_a_whole_plan(tmp_path):
    text = "pairs = [[1, 2], [3, 1]]\nrate_hz = 50\nprotocol = 'ss'\ntarget_reports = true\nget_cir = true\n"
    plan = load_plan(written(tmp_path, text + "[[tags]]\nid = 1\nbody = 'a'\nlever_arm_m = [0.1, 0, -1]\n"))
    tags = (Tag(1, "a", (0.1, 0.0, -1.0)),)
    expected = RangingPlan(((1, 2), (3, 1)), rate_hz=50, protocol="ss", target_reports=True, get_cir=True, tags=tags)
    assert (plan, plan.turns([1, 2, 3])) == (expected, ((1, 2), (3, 1)))


def test_all_leaves_out_pairs_on_one_body():
    tags = (Tag(1, "a", (0, 0, 0)), Tag(2, "a", (1, 0, 0)), Tag(3, "b", (0, 0, 0)))
    assert RangingPlan(tags=tags).turns([3, 1, 2]) == ((1, 3), (2, 3))
    assert RangingPlan().turns([3, 1, 2]) == ((1, 2), (1, 3), (2, 3))


@pytest.mark.parametrize(
    ("text", "fragment"),
    [
        ("rate = 5", "rate: unknown key"),
        ("rate_hz = -1", "rate_hz: found -1"),
        ("rate_hz = 0", "rate_hz: found 0, expected a positive number"),
        ("rate_hz = nan", "rate_hz: found nan"),
        ("rate_hz = 'fast'", "rate_hz"),
        ("protocol = 'tdoa'", "protocol: found 'tdoa', expected ds or ss"),
        ("pairs = [[1, 1]]", "pairs: found ((1, 1),), expected"),
        ("pairs = [[1]]", "pairs"),
        ("pairs = []", "pairs"),
        ("pairs = [[1, 300]]", "pairs: found"),
        ("pairs = 'some'", "pairs: found 'some'"),
        ("get_cir = 1", "get_cir"),
        ("tags = 3", "tags"),
        ("[[tags]]\nid = 1", "body"),
        ("[[tags]]\nid = 1\nbody = 'a'\n[[tags]]\nid = 1\nbody = 'b'", "tags[1].id: found 1"),
        ("[[tags]]\nid = 1\nbody = 'a'\nlever_arm_m = [1, 2]", "lever_arm_m"),
        ("pairs = [", "not valid TOML"),
    ],
)
def test_wrong_plan_files_are_refused(tmp_path, text, fragment):
    with pytest.raises(PlanError, match=one_line("plan.toml", fragment)):
        load_plan(written(tmp_path, text))


def test_tags_come_from_a_scenario_too(tmp_path):
    assert load_places(written(tmp_path, "[run]\nseed = 1\n[[tags]]\nid = 4\nbody = 'x'\nskew_ppm = 3\n"))[0] == (
        Tag(4, "x", (0.0, 0.0, 0.0)),
    )
