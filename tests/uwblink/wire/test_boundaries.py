"""Where fields, lines and messages end: the last value that is taken, and the first that is not."""

import numpy as np
import pytest

from tests.uwblink.wire.test_codec import decode, understood
from uwblink.errors import FrameError
from uwblink.wire import messages as m
from uwblink.wire.codec import LONGEST_LINE, Decoder, encode, exchanges_of
from uwblink.wire.fields import BOOL, BYTES, ID, INT, STAMP, TEXT, Malformed, write_printed

REPORT = b"R05|2|3.0550|2334148660|1211574983|1233803316|2356378373|1332123700|2454699099|-87.4977|-87.5239|-3.4971|3.5222\r\n"  # noqa: E501 - as captured


def test_a_decoder_says_what_has_begun():
    decoder = Decoder(m.REPORTS)
    assert decoder.begun == b""
    decoder.feed(b"S10|1|2|7")
    assert decoder.begun == m.Cir.KEY
    decoder.feed(b"|x\r\n")
    assert decoder.begun == b""


def test_in_the_middle_of_damage_nothing_has_begun():
    decoder = Decoder(m.REPORTS)
    decoder.feed(b"\xff\xff R05|2|3.0")
    assert decoder.begun == b""
    # A message taken up in the middle of a line counts once its end is there, and makes the decoder sure again.
    (taken_up,) = understood(decoder.feed(REPORT[9:]))
    assert taken_up.neighbour == 2
    assert decoder.messages == 1


def test_after_damage_a_message_without_fields_waits_for_a_line_end():
    assert understood(decode(b"\xffR00\r\n", m.REPORTS)) == []
    assert understood(decode(b"\xff\r\nR00\r\n", m.REPORTS)) == [m.IdleSet()]
    assert understood(decode(b"\xffR01|7\r\n", m.REPORTS)) == [m.IdReport(7)]


@pytest.mark.parametrize("sizes", [None, [1] * 20])
def test_every_message_begins_anew_after_another(sizes):
    assert decode(b"R00\r\nR00\r\nR01|4\r\n", m.REPORTS, sizes) == [m.IdleSet(), m.IdleSet(), m.IdReport(4)]


def test_a_line_is_waited_for_up_to_8191_bytes():
    assert LONGEST_LINE == 8192
    decoder = Decoder(m.REPORTS)
    assert decoder.feed(b"R05|" + b"1" * 8187) == []
    assert decoder.skipped_bytes == 0
    assert decoder.begun == b"R05"
    assert decoder.feed(b"1") != []
    assert decoder.skipped_bytes > 0


def test_an_impulse_response_has_its_first_path_within_its_taps_and_eight_more():
    taps = tuple(range(m.Cir.TAPS))
    for milli in (0, 999, 1000, 1_015_999, 1_023_999):
        cir = m.Cir(1, 2, milli, taps)
        assert decode(encode(cir), m.REPORTS) == [cir]
    good = encode(m.Cir(1, 2, 747_015, taps))
    for bad in (b"|747|1000|", b"|747|-1|", b"|1024|0|", b"|-1|0|"):
        assert understood(decode(good.replace(b"|747|15|", bad), m.REPORTS)) == []
    assert understood(decode(good.replace(b"|1015\r\n", b"|100000\r\n"), m.REPORTS)) == []
    assert understood(decode(good.replace(b"|1015\r\n", b"|01015\r\n"), m.REPORTS)) == []
    assert understood(decode(good.replace(b"|1015\r\n", b"\r\n"), m.REPORTS)) == []


def test_a_missed_response_is_all_zeros_or_nothing():
    zeros = [b"0"] * 24
    for k in range(24):
        changed = [*zeros[:k], b"1", *zeros[k + 1 :]]
        assert understood(decode(b"S01|1|2|" + b"|".join(changed) + b"\r\n", m.REPORTS)) == []


@pytest.mark.parametrize(
    "text", [b"R01|7|8\r\n", b"R01\r\n", b"R01x|7\r\n", b"R01|\r\n", b"R01|256\r\n", b"R01|07\r\n"]
)
def test_too_many_fields_or_too_few_or_other_ones(text):
    assert understood(decode(text, m.REPORTS)) == []


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
    with pytest.raises(FrameError):
        kind.write(True)


def test_texts_and_bytes_have_the_length_of_the_firmware_s_buffers():
    assert TEXT.write("a" * 199) == b"a" * 199
    assert TEXT.read(b"a" * 199) == "a" * 199
    assert len(BYTES.write(bytes(1000))) == 1002
    with pytest.raises(FrameError, match="expected at most 199 bytes of text"):
        TEXT.write("a" * 200)
    with pytest.raises(Malformed):
        TEXT.read(b"a" * 200)
    with pytest.raises(FrameError, match="1001 bytes, at most 1000"):
        BYTES.write(bytes(1001))
    for text in (b"a\rb", b"a\0b", b"\xff"):
        with pytest.raises(Malformed):
            TEXT.read(text)
    with pytest.raises(FrameError):
        BOOL.write(1)


def test_a_text_of_199_letters_comes_through_whole_and_in_pieces():
    longest, longer = (b"C03|1|" + b"a" * n + b"|1|\x00\x00\x80?|\x01\x00x\r" for n in (199, 200))
    for sizes in (None, [1] * len(longest)):
        (message,) = decode(longest, m.COMMANDS, sizes)
        assert message.text == "a" * 199
        assert understood(decode(longer, m.COMMANDS, sizes)) == []


def test_numbers_are_printed_below_ten_billion_and_cut():
    assert write_printed(9_999_999_999.0) == b"9999999999.0000"
    assert write_printed(-0.0) == b"-0.0000"
    # What lacks more than a millionth of a unit of the last digit lacks that digit.
    assert write_printed(0.99999885e-4) == b"0.0000"
    assert write_printed(0.9999995e-4) == b"0.0001"
    for value in (1e10, 1.2e10, -1e10, float("inf")):
        with pytest.raises(FrameError):
            write_printed(value)


def columns_of(*pieces):
    decoder = Decoder(m.REPORTS)
    heard = [(10**9 * k, 7, event) for k, piece in enumerate(pieces) for event in decoder.feed(piece)]
    return exchanges_of(heard), decoder


def test_reports_become_rows_in_their_order_with_the_time_of_their_piece():
    other = REPORT.replace(b"R05|2|3.0550", b"S05|3|4.5000")
    e, decoder = columns_of(REPORT * 2 + other, b"\xff" + REPORT, REPORT[:50], REPORT[50:] + b"R01|7\r\n")
    assert e.range_m.tolist() == [3.055, 3.055, 4.5, 3.055, 3.055]
    assert e.initiator.tolist() == [7, 7, 3, 7, 7]
    assert e.target.tolist() == [2, 2, 7, 2, 2]
    assert e.reporter.tolist() == [7] * 5
    took_ns = np.rint((2454699099 - 2334148660) / 63.8976).astype(int)
    assert (e.time_ns + took_ns).tolist() == [0, 0, 0, 10**9, 3 * 10**9]
    assert decoder.messages == 6
    assert decoder.skipped_bytes == 1
    for name, value in (("tx1", 2334148660), ("rx3", 2454699099), ("fpp2_dbm", -87.5239), ("skew2_ppm", 3.5222)):
        assert getattr(e, name).tolist() == [value] * 5


def test_a_single_sided_report_ends_with_its_response():
    single = b"R05|2|3.8601|2795254324|1672694065|1771014196|2893576102|0|0|-87.6187|-88.0293|-3.5203|3.5054\r\n"
    for pieces in ((single,), (single[:9], single[9:])):
        e, _ = columns_of(*pieces)
        assert e.protocol.tolist() == ["ss"]
        took_ns = round((2893576102 - 2795254324) / 63.8976)
        assert e.time_ns.tolist() == [10**9 * (len(pieces) - 1) - took_ns]


@pytest.mark.parametrize("place", range(6))
def test_a_stamp_of_33_bits_in_any_place_is_no_report(place):
    stamps = [b"%d" % (1000 + k) for k in range(6)]
    stamps[place] = b"4294967296"
    line = b"R05|2|3.0550|" + b"|".join(stamps) + b"|-87.4977|-87.5239|-3.4971|3.5222\r\n"
    e, decoder = columns_of(REPORT + line + REPORT)
    assert len(e) == 2
    assert decoder.skipped_bytes == len(line)


def test_powers_beyond_32_bits_are_numbers_all_the_same():
    line = REPORT.replace(b"|-87.4977|", b"|4294967296.0000|")
    assert columns_of(line)[0].fpp1_dbm.tolist() == [4294967296.0]


def test_the_time_of_an_exchange_is_that_of_its_poll():
    line = b"R05|2|3.0000|4294967000|1|2|63897304|4|127794904|-87.0000|-87.0000|0.0000|0.0000\r\n"
    e, _ = columns_of(b"", line)
    # rx3 - tx1 is 127 795 200 ticks, 2 ms, across the wrap of the counter; the report came at 1 s.
    assert e.time_ns[0] == 10**9 - 2_000_000
