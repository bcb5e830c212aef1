"""The existing client library's habits: boards that stand in for real ones must be kind to them.

It keeps no bytes between two reads, scans ids 0 to 10, and takes one line with a time-out at each call.
"""

import random
import re
import time
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import pytest

from tests.boards import bench_scenario, two_ports
from uwblink.boards.board import Board
from uwblink.boards.ports import SerialPort
from uwblink.wire import messages as m
from uwblink.wire.codec import Decoder
from uwblink.wire.messages import REPORTS
from uwbsim import Server

TIMEOUT_S = 0.1
LATENCY_S = (0.0002, 0.0015)
"""From the end of a line to the client's next look at its port: an operating system and an interpreter."""


class SteppedPort(SerialPort):
    """The port of a served board whose time passes only while a client waits: no machine is too busy for it."""

    def __init__(self, server, tag, clock):
        super().__init__(server.names[tag])
        self.server, self.tag, self.clock, self.board = server, tag, clock, server.bench.boards[tag]

    def now_s(self):
        return self.clock.ns * 1e-9

    def write(self, data):
        """Send bytes, and wait until they have come through the pseudo-terminal."""
        with patch.object(self.board, "write", wraps=self.board.write) as written:
            super().write(data)
            while not written.called:
                self.server.step()

    def read(self, timeout_s):
        """Let time pass until the board has printed something, which is there however late the terminal gives it."""
        until = self.clock.ns + int(timeout_s * 1e9) + 1
        while not self.clock.printed[self.tag] and self.clock.ns < until:
            due = self.server.bench.next_ns()
            self.clock.ns = int(min(max(due, self.clock.ns + 1), until))
            if due <= until:  # a server that has nothing to do waits for the wall clock
                self.server.step()
        data = super().read(60.0) if self.clock.printed[self.tag] else b""
        assert data or not self.clock.printed[self.tag], "what a board printed does not come"
        self.clock.printed[self.tag] -= len(data)
        return data


@contextmanager
def stepped_ports():
    """Give the ports of two boards behind pseudo-terminals, in time that passes step by step."""
    clock: Any = SimpleNamespace(
        ns=0, monotonic_ns=lambda: clock.ns, time_ns=time.time_ns, printed=dict.fromkeys((1, 2, 3), 0)
    )
    with patch("uwbsim.boards.server.time", clock):
        server = Server(bench_scenario())
        send = server.bench.send

        def noted(time_ns, tag, data):
            clock.printed[tag] += len(data)
            send(time_ns, tag, data)

        server.bench.send = noted
        ports = [SteppedPort(server, tag, clock) for tag in (1, 2)]
        yield ports, server.bench
        for port in ports:
            port.close()
        server.close()


class Client:
    """A client that forgets: each call takes a line and whatever else has come by then, and no more is kept."""

    def __init__(self, transport, seed):
        self.transport, self.came, self.random = transport, b"", random.Random(seed)

    def write(self, data):
        self.transport.write(data)

    def pass_time(self, seconds):
        until = self.transport.now_s() + seconds
        while (left := until - self.transport.now_s()) > 0:
            self.came += self.transport.read(left)

    def messages(self, timeout_s=TIMEOUT_S):
        """What one call finds: a line, or what came before the time was over, and what else waits then."""
        until = self.transport.now_s() + timeout_s
        while b"\r\n" not in self.came and (left := until - self.transport.now_s()) > 0:
            self.came += self.transport.read(left)
        self.pass_time(self.random.uniform(*LATENCY_S))
        data, self.came = self.came, b""
        found = []
        for part in re.split(rb"(?=[RS]\d\d\|)", data):
            decoder = Decoder(REPORTS)
            found += [e for e in decoder.feed(part) if isinstance(e, m.Message)]
        return found


@pytest.fixture(params=["virtual", "terminal", "real"])
def clients(request):
    """Two clients, the initiator first."""
    with stepped_ports() if request.param == "terminal" else two_ports(request.param) as (ports, _):
        yield [Client(port, seed) for seed, port in enumerate(ports, 1)]


def board_id(client):
    return Board(client.transport, answer_s=TIMEOUT_S).id


@pytest.mark.slow
def test_nine_of_ten_impulse_responses_reach_both_ends(clients):
    """The firmware's own boards: 91 of 100."""
    one, two = clients
    target = board_id(two)
    got = {one: 0, two: 0}
    for _ in range(100):
        one.write(b"C05|%d|1|1|1\r" % target)
        for client in got:
            found = []
            for _ in range(3):
                found += client.messages()
                if any(isinstance(e, m.Cir) for e in found):
                    break
            got[client] += any(isinstance(e, m.Cir) for e in found)
        for client in got:
            client.messages(0.02)
    assert min(got.values()) >= 90, got.values()


def test_a_scan_of_ids_finds_who_is_there(clients):
    one, two = clients
    mine, other = board_id(one), board_id(two)
    found = []
    for number in range(11):
        one.write(b"C05|%d|0|1|0\r" % number)
        reports = [e for e in one.messages() if isinstance(e, m.RangeReport)]
        found += [number for report in reports if report.neighbour == number]
    assert other in found
    assert mine not in found
