"""Ports: errors state why a port cannot be opened, and a port can be a URL."""

import errno
import json
import socket
import threading

import pytest

from tests import processes
from tests.boards import served
from tests.errors import one_line
from uwblink.boards.board import Board
from uwblink.boards.ports import SerialPort, _port_error
from uwblink.boards.ranging_plan import RangingPlan, load_plan
from uwblink.errors import PlanError, PortBusyError, PortError, PortLostError, PortMissingError, PortPermissionError
from uwblink.recording.schema import Tag, load_places
from uwblink.wire import messages as m
from uwblink.wire.codec import encode


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
