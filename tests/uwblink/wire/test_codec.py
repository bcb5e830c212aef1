"""The codec with captured bytes, and with arbitrary ones."""

import itertools
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tests.errors import one_line
from tests.uwblink.wire import transcripts
from uwblink.errors import ArgumentError, FrameError
from uwblink.twr import board_range, raw_range
from uwblink.wire import messages as m
from uwblink.wire.codec import LONGEST_LINE, Decoder, encode, exchanges_of
from uwblink.wire.fields import BOOL, BYTES, ID, INT, PRINTED, RAW_FLOAT, STAMP, TEXT, Malformed, write_printed

REPORTED = [data for _, data in transcripts.captured("->host")]
COMMANDED = [data for _, data in transcripts.captured("<-host")]

# Captured bytes that boards themselves do not understand: the codec skips and counts them.
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


@pytest.mark.parametrize("data", REPORTED, ids=lambda d: repr(d[:24]))
def test_every_captured_report_decodes_and_encodes_to_the_same_bytes(data):
    for sizes in (None, [1] * len(data)):
        (event,) = decode(data, m.REPORTS, sizes)
        assert (type(event), as_bytes(event)) == (m.REPORTS.get(data[:3], m.TextLine), data)


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
            assert (events, len(events)) == (understood(events), 1)


@pytest.mark.parametrize(
    ("start", "values"),
    [
        (
            b"R05|2|3.0577",
            {"neighbour": 2, "tx1": 1058319924, "rx3": 1175665891, "fpp1_dbm": -87.7053, "skew2_ppm": 3.5241},
        ),
        (b"S01|1|2|552281815", {"fpp3_dbm": None, "fpp2_n_dbm": 0.0}),
        (b"C03", {"text": "the test string", "data": b"\x01\r|", "number": np.float32(1.2345)}),
        (b"S06", {"data": b"\x00test\x00\r\n|message"}),
    ],
)
def test_values_of_captured_messages(start, values):
    data = next(data for data in REPORTED + COMMANDED if data.startswith(start))
    (found,) = decode(data, m.COMMANDS if start[:1] == b"C" else m.REPORTS)
    assert {name: getattr(found, name) for name in values} == values


def test_ranges_recomputed_from_every_captured_exchange():
    events = decode(b"".join(REPORTED), m.REPORTS)
    found = [e for e in events if isinstance(e, m.RangeReport | m.TargetRangeReport)]
    double, single = (exchanges_of([(0, 9, e) for e in found if bool(e.tx3) == third]) for third in (True, False))
    assert np.abs(raw_range(double) - double.range_m).max() < 1e-4
    for exchanges in (single, double):
        assert len(exchanges) >= 5
        np.testing.assert_array_equal(board_range(exchanges), exchanges.range_m)


def test_after_damage_every_intact_message_is_decoded():
    whole = next(d for d in REPORTED if d.startswith(b"R05"))
    (expected,) = decode(whole, m.REPORTS)
    for place in range(len(whole)):
        for damaged in (whole[:place] + whole[place + 1 :], whole[:place] + b"\xff" + whole[place + 1 :]):
            events = understood(decode(whole + damaged + whole + b"R01|7\r\n", m.REPORTS))
            assert (events[0], events[-2:]) == (expected, [expected, m.IdReport(7)])
            assert len(events) <= 4


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
@example(b"R00\r\nR01|3\r\n|S")
def test_any_broadcast_is_decoded_as_encoded(data):
    for table, kind in ((m.COMMANDS, m.Broadcast), (m.REPORTS, m.BroadcastReceived)):
        assert decode(encode(kind(data)), table) == [kind(data)]


@given(st.floats(-9999, 9999), st.integers(0, 2**32 - 1))
def test_printed_numbers_are_cut_towards_zero(value, stamp):
    data = encode(m.RangeReport(1, value, stamp, 0, 0, 0, 0, 0, -90.0, -0.00001, 0.0, 1.5))
    assert -1e-9 <= abs(value) - abs(float(data.split(b"|")[2])) < 1e-4 + 1e-9
    assert b"|-0.0000|" in data
    assert [encode(message) for message in decode(data, m.REPORTS)] == [data]


# Ends of fields, lines and messages: the last accepted value, and the first refused one.


REPORT = b"R05|2|3.0550|2334148660|1211574983|1233803316|2356378373|1332123700|2454699099|-87.4977|-87.5239|-3.4971|3.5222\r\n"  # noqa: E501 - as captured


def test_decoders_state_the_start_of_messages():
    decoder = Decoder(m.REPORTS)
    for data, begun in ((b"", b""), (b"S10|1|2|7", m.Cir.KEY), (b"|x\r\n", b""), (b"\xff\xff R05|2|3.0", b"")):
        decoder.feed(data)
        assert decoder.begun == begun

    # A message read from the middle of a line counts when its end has arrived, and ends the state of damage.
    (taken_up,) = understood(decoder.feed(REPORT[9:]))
    assert (taken_up.neighbour, decoder.messages) == (2, 1)


@pytest.mark.parametrize(
    ("data", "messages"),
    [
        # After damage, a message without fields waits for the end of a line.
        (b"\xffR00\r\n", []),
        (b"\xff\r\nR00\r\n", [m.IdleSet()]),
        (b"\xffR01|7\r\n", [m.IdReport(7)]),
        (b"X06|\x04\x00xR00y", []),
        # Too many fields, too few, other ones.
        (b"R01|7|8\r\n", []),
        (b"R01\r\n", []),
        (b"R01x|7\r\n", []),
        (b"R01|\r\n", []),
        (b"R01|256\r\n", []),
        (b"R01|07\r\n", []),
    ],
)
def test_damaged_lines_are_decoded_or_skipped(data, messages):
    assert understood(decode(data, m.REPORTS)) == messages


def test_lines_may_have_8191_bytes():
    assert LONGEST_LINE == 8192
    decoder = Decoder(m.REPORTS)
    assert (decoder.feed(b"R05|" + b"1" * 8187), decoder.skipped_bytes, decoder.begun) == ([], 0, b"R05")
    assert (decoder.feed(b"1") != [], decoder.skipped_bytes > 0) == (True, True)


def test_an_impulse_response_has_its_first_path_within_its_taps_and_eight_more():
    taps = tuple(range(m.Cir.TAPS))
    for milli in (0, 999, 1000, 1_015_999, 1_023_999):
        cir = m.Cir(1, 2, milli, taps)
        assert decode(encode(cir), m.REPORTS) == decode(encode(cir), m.REPORTS, [300] * 15) == [cir]
    good = encode(m.Cir(1, 2, 747_015, taps))
    assert good.startswith(b"S10|1|2|747|15|0|1|2|")
    indices = ((b"|747|15|", bad) for bad in (b"|747|1000|", b"|747|-1|", b"|1024|0|", b"|-1|0|"))
    lasts = ((b"|1015\r\n", bad) for bad in (b"|100000\r\n", b"|01015\r\n", b"\r\n"))
    for part, bad in (*indices, *lasts):
        assert understood(decode(good.replace(part, bad), m.REPORTS)) == []


def test_a_missed_response_is_all_zeros_or_nothing():
    zeros = [b"0"] * 24
    data = b"S01|1|2|" + b"|".join(zeros) + b"\r\n"
    assert (decode(data, m.REPORTS), encode(m.OverheardNothing(1, 2))) == ([m.OverheardNothing(1, 2)], data)
    for k in range(24):
        changed = [*zeros[:k], b"1", *zeros[k + 1 :]]
        assert understood(decode(b"S01|1|2|" + b"|".join(changed) + b"\r\n", m.REPORTS)) == []


@pytest.mark.parametrize(
    ("kind", "low", "high"),
    [(ID, 0, 255), (STAMP, 0, 4_294_967_295), (INT, -2_147_483_648, 2_147_483_647)],
)
def test_whole_numbers_have_the_bounds_of_the_firmware(kind, low, high):
    for value in (low, high):
        assert kind.read(kind.write(value)) == value
    for value in (low - 1, high + 1):
        with pytest.raises(FrameError):
            kind.write(value)
        with pytest.raises(Malformed):
            kind.read(b"%d" % value)


def test_texts_and_bytes_have_the_length_of_the_firmware_s_buffers():
    assert (TEXT.write("a" * 199), TEXT.read(b"a" * 199)) == (b"a" * 199, "a" * 199)
    assert len(BYTES.write(bytes(1000))) == 1002
    for text in (b"a" * 200, b"a\rb", b"a\0b", b"\xff"):
        with pytest.raises(Malformed):
            TEXT.read(text)


def test_numbers_are_printed_below_ten_billion_and_cut():
    assert (write_printed(9_999_999_999.0), write_printed(-0.0)) == (b"9999999999.0000", b"-0.0000")
    # A value that lacks more than a millionth of a unit of the last digit has the lower digit.
    assert (write_printed(0.99999885e-4), write_printed(0.9999995e-4)) == (b"0.0000", b"0.0001")


@pytest.mark.parametrize(
    ("write", "value", "said"),
    [
        *((kind.write, True, None) for kind in (ID, STAMP, INT)),
        *((write_printed, value, None) for value in (1e10, 1.2e10, -1e10, float("inf"))),
        (BOOL.write, 1, None),
        (TEXT.write, "a" * 200, "expected at most 199 bytes of text"),
        (BYTES.write, bytes(1001), "1001 bytes, at most 1000"),
        *(
            (encode, message, one_line(text))
            for message, text in (
                (m.Broadcast(bytes(93)), "C06 data: found 93 bytes, at most 92"),
                (m.DoTests(1, "a|b", True, 1.0, b""), "C03 text: found 'a|b'"),
                (m.DoTests(1, "a", True, 1e60, b""), "C03 number: found 1e+60"),
                (m.RangeCommand(300), "C05 target: found 300"),
                (m.IdReport(-1), "R01 board: found -1"),
                (m.RangeReport(1, float("nan"), *[0] * 6, *[0.0] * 4), "R05 range_m: found nan"),
            )
        ),
    ],
)
def test_values_that_cannot_be_written_are_refused(write, value, said):
    with pytest.raises(FrameError, match=said):
        write(value)


def columns_of(*pieces):
    decoder = Decoder(m.REPORTS)
    heard = [(10**9 * k, 7, event) for k, piece in enumerate(pieces) for event in decoder.feed(piece)]
    return exchanges_of(heard), decoder


def test_reports_become_rows_in_their_order_with_the_time_of_their_piece():
    other = REPORT.replace(b"R05|2|3.0550", b"S05|3|4.5000")
    e, decoder = columns_of(REPORT * 2 + other, b"\xff" + REPORT, REPORT[:50], REPORT[50:] + b"R01|7\r\n")
    assert (e.range_m.tolist(), e.initiator.tolist()) == ([3.055, 3.055, 4.5, 3.055, 3.055], [7, 7, 3, 7, 7])
    assert (e.target.tolist(), e.reporter.tolist()) == ([2, 2, 7, 2, 2], [7] * 5)
    took_ns = np.rint((2454699099 - 2334148660) / 63.8976).astype(int)
    assert (e.time_ns + took_ns).tolist() == [0, 0, 0, 10**9, 3 * 10**9]
    assert (decoder.messages, decoder.skipped_bytes) == (6, 1)
    for name, value in (("tx1", 2334148660), ("rx3", 2454699099), ("fpp2_dbm", -87.5239), ("skew2_ppm", 3.5222)):
        assert getattr(e, name).tolist() == [value] * 5


@pytest.mark.parametrize("place", range(6))
def test_a_stamp_of_33_bits_in_any_place_is_no_report(place):
    stamps = [b"4294967296" if k == place else b"%d" % (1000 + k) for k in range(6)]
    line = b"R05|2|3.0550|" + b"|".join(stamps) + b"|-87.4977|-87.5239|-3.4971|3.5222\r\n"
    e, decoder = columns_of(REPORT + line + REPORT)
    assert (len(e), decoder.skipped_bytes) == (2, len(line))


def test_powers_beyond_32_bits_are_numbers_all_the_same():
    assert columns_of(REPORT.replace(b"|-87.4977|", b"|4294967296.0000|"))[0].fpp1_dbm.tolist() == [4294967296.0]


def test_the_time_of_an_exchange_is_that_of_its_poll():
    line = b"R05|2|3.0000|4294967000|1|2|63897304|4|127794904|-87.0000|-87.0000|0.0000|0.0000\r\n"
    e, _ = columns_of(b"", line)
    # rx3 - tx1 is 127 795 200 ticks, 2 ms, across the wrap of the counter; the report arrived at 1 s.
    assert e.time_ns[0] == 10**9 - 2_000_000


# A stream with damaged bytes: every intact message is decoded, and no other.


def stream_of(count, rng):
    """Return random reports of the kinds that boards send while ranging."""

    def number(scale):
        return round(float(rng.normal(0, scale)), 4)

    def stamps(n):
        return rng.integers(0, 2**32, n).tolist()

    kinds = [
        lambda: m.RangeReport(int(rng.integers(0, 255)), number(5), *stamps(6), *[number(50) for _ in range(4)]),
        lambda: m.TargetRangeReport(int(rng.integers(0, 255)), number(5), *stamps(6), *[number(50) for _ in range(4)]),
        lambda: m.Overheard(1, 2, *stamps(9), *[number(50) for _ in range(10)]),
        lambda: m.BroadcastReceived(rng.integers(0, 256, int(rng.integers(0, 92))).astype(np.uint8).tobytes()),
    ]
    return [kinds[k]() for k in rng.integers(0, len(kinds), count)]


@pytest.mark.parametrize("seed", range(2))
def test_one_percent_of_damaged_bytes(seed):
    rng = np.random.default_rng(seed)
    sent = stream_of(2000, rng)
    texts = [encode(message) for message in sent]
    whole = np.frombuffer(b"".join(texts), dtype=np.uint8)
    damaged = np.where(rng.random(len(whole)) < 0.01, rng.integers(0, 256, len(whole)), whole).astype(np.uint8)
    ends = np.cumsum([len(t) for t in texts])[:-1]
    touched = np.array([changed.any() for changed in np.split(damaged != whole, ends)])
    assert 0.5 < touched.mean() < 0.9
    found = [e for e in decode(damaged.tobytes(), m.REPORTS, [333] * (len(damaged) // 333)) if isinstance(e, m.Message)]
    intact = [message for message, bad in zip(sent, touched, strict=True) if not bad]
    # The intact ones are all decoded, in their order ...
    place = -1
    for each in intact:
        place = found.index(each, place + 1)
    # ... and there are no more messages than were sent: other decoded ones are sent messages with damaged digits only,
    # which no decoder can detect, because the wire has no checksum.
    assert len(found) <= min(len(sent), len(intact) + 0.5 * touched.sum())


# A registered message: declared once, then written and read like those of the boards.


@m.message(b"R42")
class Weather(m.Message):
    """R42: weather at a board."""

    board: int = m.wire(ID)
    place: str = m.wire(TEXT)
    celsius: float = m.wire(PRINTED)
    raw: bytes = m.wire(BYTES)
    wet: bool = m.wire(BOOL, default=False)


@m.message(b"C42")
class GetWeather(m.Message):
    """C42: ask for the weather above a height."""

    height_m: float = m.wire(RAW_FLOAT)


@pytest.fixture(autouse=True)
def registered():
    m.register_message(Weather)
    m.register_message(GetWeather)
    yield
    del m.REPORTS[b"R42"], m.COMMANDS[b"C42"]


SAMPLE = Weather(7, "roof", -3.5, b"|\r\nR05|", wet=True)
LINE = b"R42|7|roof|-3.5000|\x07\x00|\r\nR05||1\r\n"


def test_registered_messages_are_written_and_read():
    assert (encode(SAMPLE), decode(LINE, m.REPORTS), decode(LINE, m.REPORTS, [1] * len(LINE))) == (
        LINE,
        [SAMPLE],
        [SAMPLE],
    )
    assert decode(b"R00\r\n" + LINE + b"R01|5\r\n", m.REPORTS)[1] == SAMPLE
    assert decode(encode(GetWeather(1.5)), m.COMMANDS) == [GetWeather(1.5)]


def test_damage_is_a_counted_skip():
    for damaged in (LINE.replace(b"-3.5000", b"-3.5"), LINE.replace(b"R42|7|", b"R42|256|"), LINE[:-1] + b"x"):
        events = decode(damaged + LINE, m.REPORTS, [len(damaged)])
        assert (events[-1], b"".join(e.data for e in events if isinstance(e, m.Skipped))) == (SAMPLE, damaged)


def test_fields_are_declared_once_and_frozen():
    assert list(Weather.FIELDS) == ["board", "place", "celsius", "raw", "wet"]
    assert Weather(1, "x", 0.0, b"").wet is False
    with pytest.raises(FrozenInstanceError):
        SAMPLE.board = 3  # type: ignore[misc]
    with pytest.raises(FrameError, match="R42 board: found 300, expected a whole number from 0 to 255"):
        encode(Weather(300, "x", 0.0, b""))


@m.message(b"R43")
class Half(m.Message):
    """One field has no kind."""

    board: int = m.wire(ID)
    rest: int = 0


@m.message(b"R05")
class Another(m.Message):
    """A key of the boards."""

    count: int = m.wire(INT)


@pytest.mark.parametrize(
    ("make", "given", "expected"),
    [
        *(
            (m.message, key, "key: found .*, expected a letter C, R or S and two digits")
            for key in (b"X01", b"R1", b"R123", "R42", None)
        ),
        (m.register_message, Weather, r"message Weather \(R42\): R42 is Weather already; choose another key"),
        (m.register_message, Another, r"message Another \(R05\): R05 is RangeReport already"),
        (
            m.register_message,
            Half,
            r"message Half \(R43\): rest: has no kind; declare it as in `count: int = wire\(INT\)`",
        ),
        *((m.register_message, other, "expected a class made with @message") for other in (m.Message, int, SAMPLE)),
    ],
)
def test_wrong_keys_and_messages_are_refused(make, given, expected):
    with pytest.raises(ArgumentError, match=expected):
        make(given)
    assert m.REPORTS[b"R05"] is m.RangeReport
