"""Tests of every kind of board: virtual in process, virtual behind a pseudo-terminal, and real.

Real boards are tested if the environment variable UWB_PORTS names two ports, separated by a comma.
"""

import random
import re
from collections import Counter

import pytest

from tests.boards import bench_scenario, two_ports
from tests.contract.test_firmware import played
from tests.uwblink.wire import transcripts
from uwblink.boards.board import Board
from uwblink.errors import NoAnswerError, RangingFailedError, RefusedError
from uwblink.ticks import elapsed
from uwblink.twr import truncate4
from uwblink.wire import messages as m
from uwblink.wire.codec import Decoder
from uwbsim.boards.virtual_board import VirtualPorts


@pytest.fixture(params=["virtual", "terminal", "real"])
def pair(request):
    """The two boards, the initiator first."""
    with two_ports(request.param) as (ports, _):
        yield [Board(port) for port in ports]


@pytest.fixture
def one(pair):
    return pair[0]


@pytest.fixture
def two(pair):
    return pair[1]


def heard(board, *kinds, within_s=10.0):
    """Wait for reports of some kinds; under load, this may take long."""
    found: list[m.Message] = []
    until_s = board._transport.now_s() + within_s
    while len(found) < len(kinds) and board._transport.now_s() < until_s:
        found += [event for event in board.reports(0.05) if isinstance(event, kinds)]
    return found


def test_every_plain_command_is_answered(one):
    for command, reply in (
        (m.SetIdle(), m.IdleSet()),
        (m.Reset(), m.ResetDone()),
        (m.GetMaxFrame(), m.MaxFrameReport(100)),
        (m.SetPassive(False), m.PassiveSet()),
        (m.GetId(), m.IdReport(one.id)),
    ):
        assert one.request(command) == reply


def test_all_kinds_of_fields_are_unchanged_by_a_round_trip(one):
    echo = one.request(m.DoTests(-12345, "the test string", True, 1.2345, b"\x00\x01\r|\n\xff"))
    assert echo == m.TestsDone(0, -12345, "the test string", True, 1.2345, b"\x00\x01\r|\n\xff")
    one.test()


def test_double_sided_report_keeps_the_firmware_s_arithmetic(one, two):
    report = one.range(two.id)
    assert (report.neighbour, {stamp % 512 for stamp in (report.tx1, report.tx2, report.tx3)}) == (two.id, {52})
    assert int(elapsed(report.tx3, report.tx2)) == 65536 * 1500 + 16384
    for value in (report.range_m, report.fpp1_dbm, report.fpp2_dbm, report.skew1_ppm, report.skew2_ppm):
        assert value == pytest.approx(float(truncate4(value)), abs=1e-9)
    assert report.skew1_ppm == pytest.approx(-report.skew2_ppm, abs=3)


def test_single_sided_report_has_no_third_message_and_whole_ticks(one, two):
    report = one.range(two.id, protocol="ss")
    assert (report.tx3, report.rx3) == (0, 0)
    dt41, dt32 = int(elapsed(report.rx2, report.tx1)), int(elapsed(report.tx2, report.rx1))
    assert dt32 == (1500 * 65536 + 16436) - ((report.rx1 + 1500 * 65536) % 512)
    assert report.range_m == pytest.approx(int((dt41 - dt32) / 2) * 299_702_547 / (128 * 499.2e6), abs=2e-4)


def test_delays_are_set_at_the_target_and_work(one, two):
    for delay in (280, 700, 3000, 6400, 6500, 1500):
        two.set_response_delay(delay)
        report = one.range(two.id)
        assert int(elapsed(report.tx3, report.tx2)) == 65536 * delay + 16384


@pytest.mark.parametrize("protocol", ["ss", "ds"])
def test_the_target_reports_the_same_numbers_when_asked_to(one, two, protocol):
    list(two.reports(0.05))
    report = one.range(two.id, protocol=protocol, target_reports=True)
    (said,) = heard(two, m.TargetRangeReport)
    own = {name: getattr(report, name) for name in m.RangeReport.FIELDS}
    assert {name: getattr(said, name) for name in own} == own | {"neighbour": one.id}


def test_an_absent_target_fails_with_the_board_s_own_line(one):
    with pytest.raises(RangingFailedError, match="COMMANDED TASK FAILED AFTER 5 ATTEMPTS"):
        one.range(9)
    assert one.request(m.GetId()) == m.IdReport(one.id)


def test_the_own_id_is_refused_by_the_driver_and_by_the_board(one):
    with pytest.raises(RangingFailedError, match="same as the initiator"):
        one.range(one.request(m.GetId()).board)
    assert one.id >= 0
    with pytest.raises(RefusedError, match="own id"):
        one.range(one.id)


def test_a_broadcast_reaches_the_other_board(one, two):
    list(two.reports(0.05))
    payload = b"\x00R00\r\n|RS" + bytes(range(48))
    one.send(payload)
    assert heard(two, m.BroadcastReceived) == [m.BroadcastReceived(payload)]


def test_an_impulse_response_comes_with_its_index(one, two):
    _, response = one.cir(two.id)
    assert ((response.initiator, response.target), len(response.magnitudes)) == ((one.id, two.id), 1016)
    first = response.first_path_milli // 1000
    assert max(response.magnitudes) == max(response.magnitudes[first : first + 60])
    assert one.range(two.id).neighbour == two.id


def test_harmful_commands_are_not_sent(one):
    tests = (m.DoTests(1, "x", True, number, b"") for number in (float("nan"), float("inf"), 9999.1, -9999.1))
    large = m.DoTests(1, "x" * 43, True, 1.0, b"12345")
    for send, value, said in (
        *((one.set_response_delay, delay, "280 to 6500") for delay in (279, 6501, 40_000, -5)),
        *((one.send, bytes(n), f"broadcast of {n} bytes: at most 57 fit.*one USB packet") for n in (58, 80, 92, 93)),
        *((one.request, command, "overwrites the board's memory") for command in tests),
        (one.request, large, "DoTests of 65 bytes: a command must fit one USB packet of 64"),
        (one.request, m.IdleSet(), None),
    ):
        with pytest.raises(RefusedError, match=said):
            send(value)
    with pytest.raises(RefusedError, match="protocol"):
        one.range(2, protocol="tdoa")
    assert one.request(m.GetId()) == m.IdReport(one.id)


def test_the_longest_broadcast_fits_one_packet(one, two):
    for _ in range(20):
        one.send(bytes(range(57)))
    assert [e.data for e in heard(two, *[m.BroadcastReceived] * 20)] == [bytes(range(57))] * 20
    assert one.request(m.GetId()) == m.IdReport(one.id)


def test_a_target_that_prints_its_impulse_response_is_left_alone(one, two):
    # Under load, served boards may be later than the time-out of the driver; then a response may be damaged.
    needed = 10 if one.name.startswith("/dev/pts/") else 20
    good = 0
    for _ in range(20):
        list(two.reports(0.01))
        one.range(two.id, target_reports=True, get_cir=True)
        assert two.request(m.GetId()) == m.IdReport(two.id)
        kinds = [type(e) for e in heard(two, m.Cir, m.TargetRangeReport, within_s=1.0)]
        good += kinds == [m.Cir, m.TargetRangeReport]
    assert good >= needed


def test_a_board_that_prints_a_response_is_not_asked(one, two):
    """Another process lets the board print a response: the driver detects it and waits."""
    list(two.reports(0.01))
    one.request(m.RangeCommand(two.id, target_reports=True, get_cir=True))
    until_s = two._transport.now_s() + 10
    while two._connection.decoder.begun != m.Cir.KEY and two._transport.now_s() < until_s:
        two._pass(0.001)
    assert two.request(m.GetId()) == m.IdReport(two.id)
    if not one.name.startswith("/dev/pts/"):  # at which a loaded machine can be late
        assert len(heard(two, m.Cir)) == 1


def test_many_exchanges_in_a_row_are_all_good(one, two):
    ranges = [one.range(two.id).range_m for _ in range(60)]
    assert max(ranges) - min(ranges) < 1.0


@pytest.mark.parametrize("kind", ["virtual", "terminal"])
def test_a_hanging_board_is_named_with_what_was_sent_and_heard(kind):
    with two_ports(kind) as ((port, _), bench):
        bench.boards[1].hang()
        with pytest.raises(NoAnswerError, match=r"b'C01\\r'.*nothing"):
            _ = Board(port).id


# The captured transcripts as command scripts: virtual boards answer in the format and order of the firmware.


MS = 1_000_000
SCRIPTS = [piece for piece in transcripts.pieces() if any(way == "<-host" for _, _, way, _ in piece)]


def shape(data):
    """Return the properties to compare: the text, or key, ids, number of fields, and fields that are literally zero."""
    if not re.match(rb"[RS]\d\d\|", data) or data[:3] in (b"R01", b"R03", b"R07", b"S06"):
        return data
    parts = data.rstrip(b"\r\n").split(b"|")
    ids = {b"R05": 2, b"S05": 2, b"S01": 3}[parts[0]]
    return (*parts[:ids], *(p if p in (b"0", b"0.0000") else b"." if b"." in p else b"n" for p in parts[ids:]))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda s: repr(next(x[3] for x in s if x[2] == "<-host"))[:30])
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
        elif ms > 9:  # before that, boards start, before the port exists
            captured[board].append((ms, data))
    bench.advance(int((script[-1][0] + 60) * MS))
    for board, lines in captured.items():
        sent = [(t / MS, data) for t, tag, data in ports.transfers if tag == board]
        assert [shape(data) for _, data in sent] == [shape(data) for _, data in lines]
        for (ours, _), (theirs, data) in zip(sent, lines, strict=True):
            # Both poll their buffer once a millisecond, at different phases; the rest is processor time.
            assert ours == pytest.approx(theirs, abs=1.4), data


def test_two_commands_in_one_write_execute_the_last_and_retries_are_inherited():
    # After 20 ms, two tries have failed.
    ports = played((0, 1, b"C05|9|0|1|0\r"), (20, 1, b"C05|8|0|1|0\r"), until_ms=80)
    (failed_ns,) = [t for t, _, data in ports.transfers if data.startswith(b"COMMANDED")]
    # Six tries of 7 ms in all, not six more: the new command inherits the count.
    assert failed_ns < 46 * MS


def test_a_long_command_that_straddles_a_poll_kills_the_board_in_a_share_of_phases():
    dead = 0
    for seed in range(200):
        long = (0, 1, b"C06|\x50\x00" + b"a" * 80 + b"\r")
        dead += not played(long, until_ms=10, ports=VirtualPorts(bench_scenario(seed))).bench.boards[1].alive
    # 55 us between the packets in a period of 1 ms: 5.5 % of phases, 11 of 200, within three sigma.
    assert 1 <= dead <= 21


def test_a_power_cycle_forgets_passive_listening_and_the_delay():
    board = played((0, 3, b"C04|1\r"), (5, 3, b"C08|3000\r"), until_ms=10).bench.boards[3]
    assert (board.passive, board.delay_uus) == (True, 3000)
    board.power_cycle()
    assert (board.passive, board.delay_uus) == (False, 1500)


@pytest.mark.slow
def test_a_listener_that_misses_the_response_prints_26_fields_and_otherwise_nothing():
    ranging = [(10 + 60 * k, 1, b"C05|2|1|1|0\r") for k in range(240)]
    lossy = VirtualPorts(bench_scenario(), lost_share=0.3)
    ports = played((0, 3, b"C04|1\r"), *ranging, until_ms=10 + 60 * 240, ports=lossy)
    counts = Counter(data.count(b"|") for _, tag, data in ports.transfers if tag == 3 and data[:3] == b"S01")
    assert set(counts) == {21, 26}
    # A listener that receives the poll receives the other four frames, the last of which is sent only if the initiator
    # received the two before (0.7^6); or it misses the response (0.7 x 0.3), which may not have been sent (0.3).
    whole, zeros = 0.7**6, 0.3 + 0.7 * 0.3
    assert counts.total() > 120
    assert counts[26] / counts.total() == pytest.approx(zeros / (zeros + whole), abs=0.097)  # three sigma


# Compatibility with the existing client library, which expects the timing of real boards.
#
# It keeps no bytes between two reads, scans ids 0 to 10, and takes one line with a time-out at each call.


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
        parts, self.came = re.split(rb"(?=[RS]\d\d\|)", self.came), b""
        return [e for part in parts for e in Decoder(m.REPORTS).feed(part) if isinstance(e, m.Message)]


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
            got[client] += any(isinstance(e, m.Cir) for _ in range(3) for e in client.messages())
        for client in got:
            client.messages(0.02)
    assert min(got.values()) >= 90, got.values()


def test_a_scan_of_ids_finds_the_boards(clients):
    one, two = clients
    mine, other = board_id(one), board_id(two)
    found = []
    for number in range(11):
        one.write(b"C05|%d|0|1|0\r" % number)
        found += [number for e in one.messages() if isinstance(e, m.RangeReport) and e.neighbour == number]
    assert other in found
    assert mine not in found
