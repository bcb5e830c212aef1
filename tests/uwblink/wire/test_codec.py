"""The codec against captured bytes, and against arbitrary ones."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.uwblink.wire import transcripts
from uwblink.errors import FrameError
from uwblink.twr import board_range, raw_range
from uwblink.wire import messages as m
from uwblink.wire.codec import Decoder, encode, exchanges_of

REPORTED = [data for _, data in transcripts.captured("->host")]
COMMANDED = [data for _, data in transcripts.captured("<-host")]

# What the boards themselves take to be odd: the codec skips it, counted.
ODD_COMMANDS = {
    b"C", b"\r", b"~", b"Hello\r", b"c01\r", b"xxC01\r", b"C01\r\n", b"C01|1|2|3\r", b"Comment\r", b"Cxx\r",
    b"C04|maybe\r", b"C05|two|0|0|0\r", b"C05|258|0|0|0\r", b"C05|2|0|0|0|7\r", b"C08|\r", b"C05|2|0|1\r",
    b"C05|2\r", b"C01", b"C06|\x05\x00ab\r", b"C06|]\x00" + 93 * b"a" + b"\r",
}  # fmt: skip


def decode(data, table, sizes=None):
    decoder = Decoder(table)
    events, at = [], 0
    for size in sizes or [len(data)]:
        events += decoder.feed(data[at : at + size])
        at += size
    events += decoder.feed(data[at:]) + decoder.finish()
    assert decoder.skipped_bytes == sum(len(e.data) for e in events if isinstance(e, m.Skipped))
    return events


def as_bytes(event):
    if isinstance(event, m.Skipped):
        return event.data
    return event.text.encode() if isinstance(event, m.TextLine) else encode(event)


def understood(events):
    return [e for e in events if not isinstance(e, m.Skipped)]


def test_the_transcripts_are_there():
    assert len(REPORTED) > 60
    assert len(COMMANDED) > 40


@pytest.mark.parametrize("data", REPORTED, ids=lambda d: repr(d[:24]))
def test_every_captured_report_decodes_and_encodes_to_the_same_bytes(data):
    for sizes in (None, [1] * len(data)):
        events = decode(data, m.REPORTS, sizes)
        assert len(events) == 1
        assert not isinstance(events[0], m.Skipped)
        assert as_bytes(events[0]) == data
        expected = m.REPORTS.get(data[:3], m.TextLine)
        assert isinstance(events[0], expected)


def test_all_captured_reports_in_one_stream_byte_at_a_time():
    stream = b"".join(REPORTED)
    assert [as_bytes(e) for e in decode(stream, m.REPORTS, [1] * len(stream))] == REPORTED


@pytest.mark.parametrize("data", COMMANDED, ids=lambda d: repr(d[:24]))
def test_every_captured_command_decodes_or_is_a_counted_skip(data):
    for sizes in (None, [1] * len(data)):
        events = decode(data, m.COMMANDS, sizes)
        assert b"".join(map(as_bytes, events)) == data
        if data == b"C01\rC07\r":
            assert events == [m.GetId(), m.GetMaxFrame()]
        elif data == b"C01\r\n":
            assert understood(events) == [m.GetId()]
        elif data in ODD_COMMANDS or data == b"C08|-5\r":
            assert [type(e) for e in understood(events)] in ([], [m.SetResponseDelay])
        else:
            assert events == understood(events)
            assert len(events) == 1


def test_values_of_captured_messages():
    (ranged,) = decode(next(d for d in REPORTED if d.startswith(b"R05|2|3.0577")), m.REPORTS)
    assert ranged.neighbour == 2
    assert (ranged.tx1, ranged.rx3) == (1058319924, 1175665891)
    assert (ranged.fpp1_dbm, ranged.skew2_ppm) == (-87.7053, 3.5241)
    (heard,) = decode(next(d for d in REPORTED if d.startswith(b"S01|1|2|552281815")), m.REPORTS)
    assert heard.fpp3_dbm is None
    assert heard.fpp2_n_dbm == 0.0
    (test,) = decode(next(d for d in COMMANDED if d.startswith(b"C03")), m.COMMANDS)
    assert (test.text, test.data) == ("the test string", b"\x01\r|")
    assert test.number == np.float32(1.2345)
    (heard,) = decode(next(d for d in REPORTED if d.startswith(b"S06")), m.REPORTS)
    assert heard.data == b"\x00test\x00\r\n|message"


def test_ranges_recomputed_from_every_captured_exchange():
    events = decode(b"".join(REPORTED), m.REPORTS)
    found = [e for e in events if isinstance(e, m.RangeReport | m.TargetRangeReport)]
    double = exchanges_of([(0, 9, e) for e in found if e.tx3])
    single = exchanges_of([(0, 9, e) for e in found if not e.tx3])
    assert len(double) >= 5
    assert len(single) >= 5
    assert np.abs(raw_range(double) - double.range_m).max() < 1e-4
    np.testing.assert_array_equal(board_range(single), single.range_m)
    np.testing.assert_array_equal(board_range(double), double.range_m)


def test_a_missed_response_has_26_fields():
    data = b"S01|1|2|" + b"|".join([b"0"] * 24) + b"\r\n"
    assert decode(data, m.REPORTS) == [m.OverheardNothing(1, 2)]
    assert encode(m.OverheardNothing(1, 2)) == data


def test_a_cir_comes_in_many_pieces():
    cir = m.Cir(1, 2, 747_015, tuple(range(1016)))
    data = encode(cir)
    assert data.startswith(b"S10|1|2|747|15|0|1|2|")
    assert decode(data, m.REPORTS, [300] * 15) == [cir]


def test_after_damage_every_intact_message_comes_back():
    whole = next(d for d in REPORTED if d.startswith(b"R05"))
    (expected,) = decode(whole, m.REPORTS)
    for place in range(len(whole)):
        for damaged in (whole[:place] + whole[place + 1 :], whole[:place] + b"\xff" + whole[place + 1 :]):
            events = understood(decode(whole + damaged + whole + b"R01|7\r\n", m.REPORTS))
            assert events[0] == expected
            assert events[-2:] == [expected, m.IdReport(7)]
            assert len(events) <= 4


def test_a_payload_is_no_message_and_a_damaged_broadcast_does_not_answer():
    payload = m.BroadcastReceived(b"R00\r\nR01|3\r\n|S")
    assert decode(encode(payload), m.REPORTS) == [payload]
    damaged = b"X06|\x04\x00xR00y"
    assert understood(decode(damaged, m.REPORTS)) == []


def test_endless_garbage_does_not_pile_up():
    decoder = Decoder(m.REPORTS)
    for _ in range(100):
        decoder.feed(b"R05|" + b"1" * 4000)
    assert len(decoder._buffer) <= 8192 + 4004
    assert decoder.skipped_bytes > 300_000


GARBAGE = [b"\x00", b"\r", b"\n"]
FRAGMENTS = [
    (m.REPORTS, [*GARBAGE, b"R00", b"R01|7"], 4),
    (m.REPORTS, [*GARBAGE, b"R00\r", b"R", b"S06|\x01\x00", b"No next key character found."], 3),
    (m.COMMANDS, [*GARBAGE, b"C00", b"C06|\x01\x00"], 4),
]


@pytest.mark.parametrize(("table", "fragments", "most"), FRAGMENTS, ids=["ids", "payloads", "commands"])
def test_short_streams_decode_alike_wherever_they_are_cut(table, fragments, most):
    for count in range(1, most + 1):
        for data in map(b"".join, itertools.product(fragments, repeat=count)):
            whole = understood(decode(data, table))
            for cut in range(1, len(data)):
                assert understood(decode(data, table, [cut])) == whole, (data, cut)
            assert understood(decode(data, table, [1] * len(data))) == whole, data


@pytest.mark.parametrize("line_end", [b"\r\n", b"\r\r\n", b"\n\r\n"])
def test_a_line_end_of_garbage_may_come_in_two_chunks(line_end):
    data = b"\x00" * 20 + line_end + b"R00\r\n"
    for cut in range(len(data)):
        assert understood(decode(data, m.REPORTS, [cut])) == [m.IdleSet()]


SPLICES = [b"\r\n", b"\r", b"\n", b"R00\r\n", b"R05|", b"S06|\x03\x00", b"S10|", b"R0", b"S01|1"]
ANYTHING = st.lists(
    st.one_of(st.binary(max_size=40), st.sampled_from(REPORTED + COMMANDED), st.sampled_from(SPLICES)), max_size=12
).map(b"".join)


@pytest.mark.parametrize("table", [m.REPORTS, m.COMMANDS], ids=["reports", "commands"])
@given(data=ANYTHING, sizes=st.lists(st.integers(1, 60), max_size=60))
def test_any_bytes_in_any_chunks_are_messages_or_counted_skips(table, data, sizes):
    whole = decode(data, table)
    pieces = decode(data, table, [*sizes, *([1] * len(data))])
    assert understood(pieces) == understood(whole)
    for events in (whole, pieces):
        assert b"".join(map(as_bytes, events)) == data
        assert all(isinstance(e, m.Message | m.TextLine | m.Skipped) for e in events)


@given(st.binary(max_size=92))
def test_any_broadcast_comes_back(data):
    for table, kind in ((m.COMMANDS, m.Broadcast), (m.REPORTS, m.BroadcastReceived)):
        assert decode(encode(kind(data)), table) == [kind(data)]


@given(st.floats(-9999, 9999), st.integers(0, 2**32 - 1))
def test_printed_numbers_are_cut_towards_zero(value, stamp):
    ranged = m.RangeReport(1, value, stamp, 0, 0, 0, 0, 0, -90.0, -0.00001, 0.0, 1.5)
    data = encode(ranged)
    printed = float(data.split(b"|")[2])
    assert abs(printed) <= abs(value) + 1e-9
    assert abs(printed - value) < 1e-4 + 1e-9
    assert b"|-0.0000|" in data
    (back,) = decode(data, m.REPORTS)
    assert encode(back) == data


@pytest.mark.parametrize(
    ("message", "text"),
    [
        (m.Broadcast(bytes(93)), "C06 data: found 93 bytes, at most 92"),
        (m.DoTests(1, "a|b", True, 1.0, b""), "C03 text: found 'a|b'"),
        (m.DoTests(1, "a", True, 1e60, b""), "C03 number: found 1e+60"),
        (m.RangeCommand(300), "C05 target: found 300"),
        (m.IdReport(-1), "R01 board: found -1"),
        (m.RangeReport(1, float("nan"), *[0] * 6, *[0.0] * 4), "R05 range_m: found nan"),
    ],
)
def test_values_that_do_not_fit_are_refused(message, text):
    with pytest.raises(FrameError) as caught:
        encode(message)
    assert str(caught.value).startswith(text)
