"""Coverage-guided fuzzing of the decoder with atheris (see docs/testing.md); not part of `make test`.

Holds for arbitrary bytes in arbitrary pieces: nothing raises, every byte is in one event, whole and in pieces agree,
what decodes encodes to the same bytes, and the fast columns agree with the messages.
"""

import sys

import atheris

with atheris.instrument_imports(include=["uwblink"]):
    from uwblink.wire.codec import ColumnDecoder, Decoder, encode
    from uwblink.wire.messages import REPORTS, RangeReport, Skipped, TextLine


def as_bytes(event):
    if isinstance(event, Skipped):
        return event.data
    return event.text.encode() if isinstance(event, TextLine) else encode(event)


def check(data: bytes) -> None:
    size = data[0] % 40 + 1 if data else 1
    stream = data[1:]
    whole = Decoder(REPORTS)
    events = whole.feed(stream) + whole.finish()
    assert b"".join(map(as_bytes, events)) == stream
    pieces, columns = Decoder(REPORTS), ColumnDecoder(1)
    found = []
    for at in range(0, len(stream), size):
        found += pieces.feed(stream[at : at + size])
        columns.feed(stream[at : at + size], at)
    found += pieces.finish()
    columns.finish(len(stream))
    understood = [e for e in events if not isinstance(e, Skipped)]
    assert [e for e in found if not isinstance(e, Skipped)] == understood
    assert len(columns.exchanges()) == sum(isinstance(e, RangeReport) for e in understood)


if __name__ == "__main__":
    atheris.Setup(sys.argv, check)
    atheris.Fuzz()
