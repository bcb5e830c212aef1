"""One battery for every kind of board: virtual in process, virtual behind a pseudo-terminal, and real.

Real boards are tested when the environment variable UWB_PORTS names two ports, separated by a comma.
"""

import pytest

from tests.boards import two_ports
from uwblink.boards.board import Board
from uwblink.errors import NoAnswerError, RangingFailedError, RefusedError
from uwblink.ticks import elapsed
from uwblink.twr import truncate4
from uwblink.wire import messages as m

ABSENT = 9


@pytest.fixture(params=["virtual", "terminal", "real"])
def pair(request):
    """The two boards, the initiator first."""
    with two_ports(request.param) as (ports, _):
        yield [Board(port) for port in ports]


def heard(board, *kinds, within_s=10.0):
    """Wait for reports of some kinds, as many as are named; a busy machine may take its time."""
    found: list[m.Message] = []
    until_s = board._transport.now_s() + within_s
    while len(found) < len(kinds) and board._transport.now_s() < until_s:
        for event in board.reports(0.05):
            found += [event] if isinstance(event, kinds) else []
            if len(found) == len(kinds):
                break
    return found


def test_every_plain_command_is_answered(pair):
    one, _ = pair
    for command, reply in (
        (m.SetIdle(), m.IdleSet()),
        (m.Reset(), m.ResetDone()),
        (m.GetMaxFrame(), m.MaxFrameReport(100)),
        (m.SetPassive(False), m.PassiveSet()),
    ):
        assert one.request(command) == reply
    assert one.request(m.GetId()) == m.IdReport(one.id)


def test_every_kind_of_field_survives_the_way_there_and_back(pair):
    one, _ = pair
    echo = one.request(m.DoTests(-12345, "the test string", True, 1.2345, b"\x00\x01\r|\n\xff"))
    assert echo == m.TestsDone(0, -12345, "the test string", True, 1.2345, b"\x00\x01\r|\n\xff")
    one.test()


def test_double_sided_report_keeps_the_firmware_s_arithmetic(pair):
    one, two = pair
    report = one.range(two.id)
    assert report.neighbour == two.id
    assert {stamp % 512 for stamp in (report.tx1, report.tx2, report.tx3)} == {52}
    assert int(elapsed(report.tx3, report.tx2)) == 65536 * 1500 + 16384
    for value in (report.range_m, report.fpp1_dbm, report.fpp2_dbm, report.skew1_ppm, report.skew2_ppm):
        assert value == pytest.approx(float(truncate4(value)), abs=1e-9)
    assert report.skew1_ppm == pytest.approx(-report.skew2_ppm, abs=3)


def test_single_sided_report_has_no_third_message_and_whole_ticks(pair):
    one, two = pair
    report = one.range(two.id, protocol="ss")
    assert (report.tx3, report.rx3) == (0, 0)
    dt41, dt32 = int(elapsed(report.rx2, report.tx1)), int(elapsed(report.tx2, report.rx1))
    assert dt32 == (1500 * 65536 + 16436) - ((report.rx1 + 1500 * 65536) % 512)
    ticks = int((dt41 - dt32) / 2)
    assert report.range_m == pytest.approx(ticks * 299_702_547 / (128 * 499.2e6), abs=2e-4)


def test_every_delay_that_the_driver_sets_is_set_at_the_target_and_works(pair):
    one, two = pair
    for delay in (280, 700, 3000, 6400, 6500, 1500):
        two.set_response_delay(delay)
        report = one.range(two.id)
        assert int(elapsed(report.tx3, report.tx2)) == 65536 * delay + 16384


@pytest.mark.parametrize("protocol", ["ss", "ds"])
def test_the_target_reports_the_same_numbers_when_asked_to(pair, protocol):
    one, two = pair
    list(two.reports(0.05))
    report = one.range(two.id, protocol=protocol, target_reports=True)
    said = heard(two, m.TargetRangeReport)
    assert len(said) == 1
    assert said[0].neighbour == one.id
    for name in m.RangeReport.FIELDS:
        if name != "neighbour":
            assert getattr(said[0], name) == getattr(report, name)


def test_an_absent_target_fails_with_the_board_s_own_line(pair):
    one, _ = pair
    with pytest.raises(RangingFailedError, match="COMMANDED TASK FAILED AFTER 5 ATTEMPTS"):
        one.range(ABSENT)
    assert one.request(m.GetId()) == m.IdReport(one.id)


def test_the_own_id_is_refused_by_the_driver_and_by_the_board(pair):
    one, _ = pair
    with pytest.raises(RangingFailedError, match="same as the initiator"):
        one.range(one.request(m.GetId()).board)
    assert one.id >= 0
    with pytest.raises(RefusedError, match="own id"):
        one.range(one.id)


def test_a_broadcast_reaches_the_other_board(pair):
    one, two = pair
    list(two.reports(0.05))
    payload = b"\x00R00\r\n|RS" + bytes(range(48))
    one.send(payload)
    assert heard(two, m.BroadcastReceived) == [m.BroadcastReceived(payload)]


def test_an_impulse_response_comes_with_its_index(pair):
    one, two = pair
    _, response = one.cir(two.id)
    assert (response.initiator, response.target) == (one.id, two.id)
    assert len(response.magnitudes) == 1016
    assert max(response.magnitudes) == max(
        response.magnitudes[response.first_path_milli // 1000 : response.first_path_milli // 1000 + 60]
    )
    assert one.range(two.id).neighbour == two.id


def test_what_would_harm_a_board_is_never_sent(pair):
    one, _ = pair
    for delay in (279, 6501, 40_000, -5):
        with pytest.raises(RefusedError, match="280 to 6500"):
            one.set_response_delay(delay)
    for length in (58, 80, 92, 93):
        with pytest.raises(RefusedError, match=rf"broadcast of {length} bytes: at most 57 fit.*one USB packet"):
            one.send(bytes(length))
    for number in (float("nan"), float("inf"), 9999.1, -9999.1):
        with pytest.raises(RefusedError, match="overwrites the board's memory"):
            one.request(m.DoTests(1, "x", True, number, b""))
    with pytest.raises(RefusedError, match=r"DoTests of 65 bytes: a command must fit one USB packet of 64"):
        one.request(m.DoTests(1, "x" * 43, True, 1.0, b"12345"))
    with pytest.raises(RefusedError, match="protocol"):
        one.range(2, protocol="tdoa")
    with pytest.raises(RefusedError):
        one.request(m.IdleSet())
    assert one.request(m.GetId()) == m.IdReport(one.id)


def test_the_longest_broadcast_fits_one_packet(pair):
    one, two = pair
    for _ in range(20):
        one.send(bytes(range(57)))
    assert [e.data for e in heard(two, *[m.BroadcastReceived] * 20)] == [bytes(range(57))] * 20
    assert one.request(m.GetId()) == m.IdReport(one.id)


def test_a_target_that_prints_its_impulse_response_is_left_alone(pair):
    one, two = pair
    # Served boards may be late by more than the driver waits, on a busy machine; then a response may be damaged.
    needed = 10 if one.name.startswith("/dev/pts/") else 20
    good = 0
    for _ in range(20):
        list(two.reports(0.01))
        one.range(two.id, target_reports=True, get_cir=True)
        assert two.request(m.GetId()) == m.IdReport(two.id)
        kinds = [type(e) for e in heard(two, m.Cir, m.TargetRangeReport, within_s=1.0)]
        good += kinds == [m.Cir, m.TargetRangeReport]
    assert good >= needed


def test_a_board_whose_response_is_coming_in_is_not_asked(pair):
    """Somebody else, another process say, had it print one: the driver sees it come and waits."""
    one, two = pair
    list(two.reports(0.01))
    one.request(m.RangeCommand(two.id, target_reports=True, get_cir=True))
    until_s = two._transport.now_s() + 10
    while two._connection.decoder.begun != m.Cir.KEY and two._transport.now_s() < until_s:
        two._pass(0.001)
    assert two.request(m.GetId()) == m.IdReport(two.id)
    if not one.name.startswith("/dev/pts/"):  # where a busy machine can make it come late
        assert len(heard(two, m.Cir)) == 1


def test_many_exchanges_in_a_row_are_all_good(pair):
    one, two = pair
    ranges = [one.range(two.id).range_m for _ in range(60)]
    assert max(ranges) - min(ranges) < 1.0


@pytest.mark.parametrize("kind", ["virtual", "terminal"])
def test_a_hanging_board_is_named_with_what_was_sent_and_heard(kind):
    with two_ports(kind) as ((port, _), bench):
        bench.boards[1].hang()
        with pytest.raises(NoAnswerError, match=r"b'C01\\r'.*nothing"):
            _ = Board(port).id
