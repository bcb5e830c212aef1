"""Compatibility with the existing client library, which expects the timing of real boards.

It keeps no bytes between two reads, scans ids 0 to 10, and takes one line with a time-out at each call.
"""

import random
import re

import pytest

from tests.boards import two_ports
from uwblink.boards.board import Board
from uwblink.wire import messages as m
from uwblink.wire.codec import Decoder
from uwblink.wire.messages import REPORTS

TIMEOUT_S = 0.1
LATENCY_S = (0.0002, 0.0015)
"""Time from the end of a line to the next read by the client: of an operating system and an interpreter."""


class Client:
    """A client without a buffer: each call takes a line and all other bytes that have arrived, and discards them."""

    def __init__(self, transport, seed):
        self.transport, self.came, self.random = transport, b"", random.Random(seed)

    def write(self, data):
        self.transport.write(data)

    def pass_time(self, seconds):
        until = self.transport.now_s() + seconds
        while (left := until - self.transport.now_s()) > 0:
            self.came += self.transport.read(left)

    def messages(self, timeout_s=TIMEOUT_S):
        """Return the result of one call: a line, or the bytes until the time-out, and the other waiting bytes."""
        until = self.transport.now_s() + timeout_s
        while b"\r\n" not in self.came and (left := until - self.transport.now_s()) > 0:
            self.came += self.transport.read(left)
        self.pass_time(self.random.uniform(*LATENCY_S))
        data, self.came = self.came, b""
        found = []
        for part in re.split(rb"(?=[RS]\d\d\|)", data):
            found += [e for e in Decoder(REPORTS).feed(part) if isinstance(e, m.Message)]
        return found


@pytest.fixture(params=["virtual", "real"])
def clients(request):
    """Two clients, the initiator first; test_boards.py tests the effects of a terminal on bytes."""
    with two_ports(request.param) as (ports, _):
        yield [Client(port, seed) for seed, port in enumerate(ports, 1)]


def board_id(client):
    return Board(client.transport, answer_s=TIMEOUT_S).id


@pytest.mark.slow
def test_nine_of_ten_impulse_responses_reach_both_ends(clients):
    """Real boards with the firmware: 91 of 100."""
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


def test_a_scan_of_ids_finds_the_boards(clients):
    one, two = clients
    mine, other = board_id(one), board_id(two)
    found = []
    for number in range(11):
        one.write(b"C05|%d|0|1|0\r" % number)
        reports = [e for e in one.messages() if isinstance(e, m.RangeReport)]
        found += [number for report in reports if report.neighbour == number]
    assert other in found
    assert mine not in found
