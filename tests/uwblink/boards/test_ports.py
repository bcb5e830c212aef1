"""Ports: what cannot be opened says why, and a port can be a URL."""

import errno
import json
import os
import socket
import threading

import pytest

from tests import processes
from tests.boards import served
from uwblink.boards.board import Board
from uwblink.boards.ports import SerialPort, _explained
from uwblink.errors import PortBusyError, PortError, PortLostError, PortMissingError, PortPermissionError
from uwblink.wire import messages as m
from uwblink.wire.codec import encode


def test_what_cannot_be_opened(tmp_path):
    with pytest.raises(PortMissingError, match="no such port; `uwblink ports`"):
        SerialPort("/dev/nothing")
    with pytest.raises(PortError, match="not a serial port"):
        SerialPort("/dev/null")
    (tmp_path / "file").write_text("x")
    with pytest.raises(PortError, match="not a serial port"):
        SerialPort(str(tmp_path / "file"))
    with pytest.raises(PortError, match=f"{tmp_path}: is a folder; name the ports in it, as with {tmp_path}/[*]"):
        SerialPort(f"{tmp_path}/")
    with pytest.raises(PortError, match="not a port"):
        SerialPort("nonsense://x")


def test_the_list_of_ports_as_json():
    done = processes.run("uwblink", "ports", "/dev/nothing", "--json")
    assert json.loads(done.stdout) == [{"device": "/dev/nothing", "description": "", "serial_number": None}]


def test_permission_denied_names_the_group(tmp_path):
    (tmp_path / "port").write_text("")
    error = _explained(str(tmp_path / "port"), PermissionError(errno.EACCES, "Permission denied"))
    assert isinstance(error, PortPermissionError)
    import grp

    group = grp.getgrgid(os.stat(tmp_path / "port").st_gid).gr_name
    assert f"join the group {group}" in str(error)


def test_a_second_opening_is_refused_and_a_lost_port_says_so():
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
    """A board behind TCP that knows only its id."""
    listening = socket.create_server(("127.0.0.1", 0))

    def serve():
        connection, _ = listening.accept()
        with connection:
            while data := connection.recv(100):
                if data == b"C01\r":
                    connection.sendall(b"R01|")
                    connection.sendall(b"77\r\n")
                if data == b"C07\r":
                    return

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


def test_nobody_at_a_socket_is_a_clear_error():
    with pytest.raises(PortError, match="cannot be opened"):
        Board.open("socket://127.0.0.1:1")


def test_bytes_from_before_the_opening_are_not_taken_for_answers():
    with served() as server:
        for _ in range(3):
            server._terminals[1].write(encode(m.IdReport(200)))
        with Board.open(server.names[1]) as board:
            assert board.id == 1
