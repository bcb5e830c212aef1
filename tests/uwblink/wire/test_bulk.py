"""Bytes to columns: the fast way and the message decoder agree on everything."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from uwblink.twr import COLUMNS
from uwblink.wire.codec import ColumnDecoder, Decoder, encode, exchanges_of
from uwblink.wire.messages import REPORTS, RangeReport, Skipped, TargetRangeReport

NUMBER = st.integers(-(10**8), 10**8).map(lambda n: n / 1e4)
STAMP = st.integers(0, 2**32 - 1)
REPORT = st.builds(
    lambda kind, values: kind(*values),
    st.sampled_from([RangeReport, TargetRangeReport]),
    st.tuples(st.integers(0, 255), NUMBER, *[STAMP] * 6, *[NUMBER] * 4),
)


def by_columns(pieces):
    decoder = ColumnDecoder(7)
    for k, piece in enumerate(pieces):
        decoder.feed(piece, k)
    decoder.finish(len(pieces))
    return decoder


def by_messages(pieces):
    decoder = Decoder(REPORTS)
    events = [(k, e) for k, piece in enumerate(pieces) for e in decoder.feed(piece)]
    events += [(len(pieces), e) for e in decoder.finish()]
    return events, decoder


def agree(pieces):
    ours = by_columns(pieces)
    events, theirs = by_messages(pieces)
    ranged = [(k, 7, e) for k, e in events if isinstance(e, RangeReport)]
    found = ours.exchanges()
    assert len(found) == len(ranged)
    if ranged:
        expected = exchanges_of(ranged)
        for name in COLUMNS:
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
    assert ours.decoder.skipped_bytes == theirs.skipped_bytes
    assert [e for _, e in ours.events if not isinstance(e, Skipped)] == [
        e for _, e in events if not isinstance(e, RangeReport | Skipped)
    ]


@given(st.lists(REPORT, max_size=20), st.lists(st.integers(1, 200), min_size=1, max_size=30))
def test_reports_in_pieces_of_any_size(reports, sizes):
    data, pieces = b"".join(map(encode, reports)), []
    for size in sizes:
        pieces.append(data[:size])
        data = data[size:]
    agree([*pieces, data])


@given(st.lists(REPORT, min_size=1, max_size=8), st.data())
def test_damaged_reports(reports, data):
    text = bytearray(b"".join(map(encode, reports)))
    for _ in range(data.draw(st.integers(1, 6))):
        text[data.draw(st.integers(0, len(text) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(text)))
    agree([bytes(text[:cut]), bytes(text[cut:])])


@given(st.lists(st.binary(max_size=60), max_size=6))
def test_arbitrary_bytes(pieces):
    agree(pieces)


def test_the_time_of_an_exchange_is_that_of_its_poll():
    line = b"R05|2|3.0|"
    line = b"R05|2|3.0000|4294967000|1|2|63897304|4|127794904|-87.0000|-87.0000|0.0000|0.0000\r\n"
    e = by_columns([b"", line]).exchanges()
    # rx3 - tx1 is 127 795 200 ticks, 2 ms, across the wrap of the counter; the report came at time 1 ns.
    assert e.time_ns[0] == 1 - 2_000_000
