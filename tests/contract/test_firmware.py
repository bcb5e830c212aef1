"""Observed behaviour of the boards' firmware with lost frames, busy boards, and other frames in the air."""

from collections import Counter

import pytest

from tests.boards import bench_scenario
from uwblink.wire.messages import RangeCommand
from uwbsim import VirtualPorts
from uwbsim.boards.frames import NS_PER_MS, NS_PER_US, FinalPayload, Received


def played(*writes, until_ms, ports=None):
    """Write to boards of the bench, (ms, board, bytes) in order of time, and continue for a while."""
    ports = ports or VirtualPorts(bench_scenario())
    for ms, board, data in writes:
        ports.bench.advance(int(ms * NS_PER_MS))
        ports.bench.boards[board].write(data)
    ports.bench.advance(int(until_ms * NS_PER_MS))
    return ports


def said(ports, tag, start=b""):
    """Return lines of a board with a given start: (ms, bytes)."""
    return [(t / NS_PER_MS, data) for t, who, data in ports.transfers if who == tag and data.startswith(start)]


@pytest.fixture
def ports():
    return VirtualPorts(bench_scenario())


def range_often(ports, command, count, listening=()):
    """Range every 70 ms: six failing tries take 43 ms."""
    passive = [(0, tag, b"C04|1\r") for tag in listening]
    ranging = [(10 + 70 * k, 1, command) for k in range(count)]
    played(*passive, *ranging, until_ms=10 + 70 * count, ports=ports)


@pytest.mark.slow
def test_the_initiator_s_final_can_be_lost_too():
    ports = VirtualPorts(bench_scenario(), lost_share=0.4)
    range_often(ports, b"C05|2|1|1|0\r", 300)
    reports, theirs = len(said(ports, 1, b"R05")), len(said(ports, 2, b"S05"))
    # The firmware at 40 % loss: 209 S05 and 341 R05. Each R05 has its S05 with probability 0.6; three sigma of 170.
    assert reports > 125
    assert theirs / reports == pytest.approx(0.6, abs=0.113)
    mine, other = ({data[6:] for _, data in said(ports, *what)} for what in ((1, b"R05"), (2, b"S05")))
    assert other <= mine


@pytest.mark.parametrize(("delay", "works"), [(264, False), (280, True), (6400, True), (6500, True), (6600, False)])
def test_the_delays_that_work_are_those_of_the_firmware(delay, works):
    ports = played((0, 2, b"C08|%d\r" % delay), (5, 1, b"C05|2|1|1|0\r"), until_ms=90)
    printed = [len(said(ports, *what)) for what in ((1, b"R05"), (2, b"S05"), (1, b"COMMANDED"))]
    assert printed == [works, works, not works]


def test_a_target_answers_its_host_after_the_exchange():
    # After 2 ms: between poll and final.
    ports = played((0, 1, b"C05|2|1|1|0\r"), (2, 2, b"C01\r"), until_ms=20)
    assert [[data[:3] for _, data in said(ports, tag)] for tag in (1, 2)] == [[b"R05"], [b"S05", b"R01"]]


def sent_frames(ports):
    """Collect every frame that is scheduled."""
    frames, send = [], ports.bench.air.send

    def noting(*frame):
        frames.append(send(*frame))
        return frames[-1]

    ports.bench.air.send = noting
    return frames


def test_a_target_that_starts_ranging_sends_no_delayed_reply(ports):
    """The command comes within the delay of its reply, 6 ms here; without target reports the board accepts it."""
    frames, asked = sent_frames(ports), b"C05|2|0|1|0\r"
    # Both try without success for a while, because each blocks the other.
    played((0, 2, b"C08|6000\r"), (5, 1, asked), (7.5, 2, b"C05|3|0|1|0\r"), until_ms=80, ports=ports)
    reply = next(f for f in frames if (f.sender, f.receiver) == (2, 1) and isinstance(f.payload, FinalPayload))
    assert (reply.cancelled, said(ports, 1, b"R05")) == (True, [])
    played((80, 1, asked), until_ms=100, ports=ports)
    assert len(said(ports, 1, b"R05")) == 1


def test_a_report_is_lost_while_the_bus_is_busy(ports):
    board = ports.bench.boards[1]
    for delay in (1 * NS_PER_US, 50 * NS_PER_US, 200 * NS_PER_US):
        board.usb.send(b"%d" % delay + bytes(100), delay)
    ports.bench.advance(NS_PER_MS)
    # Two packets of 64 bytes take 110 us; a report 50 us after the first finds the bus busy.
    assert [data.rstrip(b"\0") for _, data in said(ports, 1)] == [b"1000", b"200000"]


def test_impulse_responses_follow_reports_by_four_to_six_milliseconds(ports):
    range_often(ports, b"C05|2|1|1|1\r", 40)
    after = [b[0] - a[0] for a, b in zip(said(ports, 1, b"R05"), said(ports, 1, b"S10"), strict=True)]
    assert 3.8 <= min(after) < 4.3
    assert 5.5 < max(after) <= 6.0
    assert [data[:3] for _, data in said(ports, 2) if data[:3] in (b"S10", b"S05")] == [b"S10", b"S05"] * 40


def test_passive_boards_print_zeros_for_tries_that_fail_and_others_warn(ports):
    """The target is absent: six tries, of which a listener receives only the poll."""
    range_often(ports, b"C05|9|0|1|0\r", 5, listening=[3])
    assert len(said(ports, 1, b"COMMANDED")) == 5
    zeros = said(ports, 3, b"S01|1|9|0|")
    assert (len(zeros), {data.count(b"|") for _, data in zeros}) == (5 * 6, {26})
    assert said(ports, 2) == [], "polls alone make nobody warn"
    single = VirtualPorts(bench_scenario())
    range_often(single, b"C05|9|0|0|0\r", 5, listening=[3])
    assert said(single, 3, b"S01") == [], "a single-sided one leaves nothing"


def test_failed_tries_make_bystanders_warn():
    """The delay is too short: the target answers with its response six times, and never sends its final."""
    ports = played((0, 2, b"C08|200\r"), until_ms=5)
    range_often(ports, b"C05|2|0|1|0\r", 1)
    assert Counter(data[:11] for _, data in said(ports, 3)) == {b"WARNING 0xB": 6}


def test_a_listener_that_misses_the_last_frame_is_deaf_until_another_comes(ports):
    bench, send = ports.bench, ports.bench.air.send

    def losing(*sent):
        frame = send(*sent)
        if isinstance(frame.payload, FinalPayload) and frame.sender == 1:
            frame.received[3].heard = False
        return frame

    setattr(bench.air, "send", losing)  # noqa: B010 - mypy minds an assignment
    played((0, 3, b"C04|1\r"), (5, 1, b"C05|2|1|1|0\r"), (15, 3, b"C01\r"), until_ms=300, ports=ports)
    assert len(said(ports, 2, b"S05")) == 1
    assert [data[:3] for _, data in said(ports, 3)] == [b"R04"], "the air is silent, and the board waits for a frame"
    played((300, 1, b"C06|\x01\x00x\r"), until_ms=310, ports=ports)
    assert [data[:3] for _, data in said(ports, 3)] == [b"R04", b"R01"], "which it does not take for a broadcast"


@pytest.mark.slow
def test_passive_boards_answer_late_where_frames_are_lost():
    """Asked 15 ms before the next exchange: the firmware answered 5 of 60 C01 only at that exchange, others soon."""
    waits = []
    for seed in range(60):
        asked_ms, ranging = 235, [(ms, 1, b"C05|2|1|1|0\r") for ms in range(10, 400, 60)]
        writes = sorted([(0, 3, b"C04|1\r"), (asked_ms, 3, b"C01\r"), *ranging])
        ports = played(*writes, until_ms=600, ports=VirtualPorts(bench_scenario(seed), lost_share=0.4))
        waits += [t - asked_ms for t, _ in said(ports, 3, b"R01")]
    assert len(waits) > 50
    assert 1 <= sum(wait > 10 for wait in waits) <= 15


def on_a_line(*positions_m):
    """Return boards on a line, board 1 at the first position."""
    places = {k: (x, 0.0, 1.0) for k, x in enumerate(positions_m, 1)}
    return bench_scenario(4, places, power_noise_db=0.0, capture_db=6.0)


@pytest.mark.parametrize(
    ("other_m", "lag_us", "received"),
    [
        (3.0, 50, None),  # 2 m and 1 m away: the second is stronger, and destroys the first
        (5.9, 50, None),  # 3.9 m, 5.8 dB weaker: not enough
        (6.1, 50, 1),  # 4.1 m, 6.2 dB weaker: captured
        (6.1, -50, None),  # the weaker one was first, and the receiver is locked to it
        (900.0, -50, 1),  # too far to be received at all
    ],
)
def test_of_two_frames_at_once_the_first_is_received_where_it_is_stronger_by_the_capture_ratio(
    other_m, lag_us, received
):
    """Board 1 polls board 2, two metres away, and board 3 polls board 4 slightly later or earlier."""
    bench = VirtualPorts(on_a_line(0.0, 2.0, other_m, other_m + 2)).bench
    came: list[Received | None] = []
    bench.boards[2].radio._interrupt = came.append
    starts = {1: 0, 3: lag_us * NS_PER_US}
    bench.advance(NS_PER_MS)
    for board in sorted(starts, key=lambda b: starts[b]):
        bench.advance(2 * NS_PER_MS + starts[board])
        bench.boards[board].radio.send(board + 1, RangeCommand(board + 1), bench.air.first_stamp(board))
    bench.advance(3 * NS_PER_MS)
    assert next(r.frame.sender if r else None for r in came) == received


def test_two_exchanges_at_once_disturb_each_other_near_by_and_not_far_away():
    shares = {}
    for distance_m in (3.0, 900.0):
        ports = VirtualPorts(on_a_line(0.0, 2.0, distance_m, distance_m + 2.0))
        frames = sent_frames(ports)
        writes = [(10 + 70 * k, board, b"C05|%d|0|1|0\r" % (board + 1)) for k in range(20) for board in (1, 3)]
        played(*writes, until_ms=10 + 70 * 20, ports=ports)
        good = sum(len(said(ports, board, b"R05")) for board in (1, 3))
        shares[distance_m] = good / sum(isinstance(f.payload, RangeCommand) for f in frames)
    assert shares[900.0] == 1
    assert shares[3.0] < 0.5
