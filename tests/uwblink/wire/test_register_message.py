"""A message that somebody adds: declared once, then written and read like those of the boards."""

from dataclasses import FrozenInstanceError

import pytest

from uwblink.errors import ArgumentError, FrameError
from uwblink.wire.codec import Decoder, encode
from uwblink.wire.fields import BOOL, BYTES, ID, INT, PRINTED, RAW_FLOAT, TEXT
from uwblink.wire.messages import (
    COMMANDS,
    REPORTS,
    Message,
    RangeReport,
    Skipped,
    message,
    register_message,
    wire,
)  # fmt: skip


@message(b"R42")
class Weather(Message):
    """R42: what a board feels."""

    board: int = wire(ID)
    place: str = wire(TEXT)
    celsius: float = wire(PRINTED)
    raw: bytes = wire(BYTES)
    wet: bool = wire(BOOL, default=False)


@message(b"C42")
class GetWeather(Message):
    """C42: ask for it, above a height."""

    height_m: float = wire(RAW_FLOAT)


@pytest.fixture(autouse=True)
def registered():
    register_message(Weather)
    register_message(GetWeather)
    yield
    del REPORTS[b"R42"], COMMANDS[b"C42"]


SAMPLE = Weather(7, "roof", -3.5, b"|\r\nR05|", wet=True)
LINE = b"R42|7|roof|-3.5000|\x07\x00|\r\nR05||1\r\n"


def decoded(table, *pieces):
    decoder = Decoder(table)
    return [event for piece in pieces for event in decoder.feed(piece)] + decoder.finish()


def test_it_is_written_and_read_whole_byte_by_byte_and_among_others():
    assert encode(SAMPLE) == LINE
    assert decoded(REPORTS, LINE) == [SAMPLE]
    assert decoded(REPORTS, *(LINE[k : k + 1] for k in range(len(LINE)))) == [SAMPLE]
    assert decoded(REPORTS, b"R00\r\n" + LINE + b"R01|5\r\n")[1] == SAMPLE
    assert decoded(COMMANDS, encode(GetWeather(1.5))) == [GetWeather(1.5)]


def test_damage_is_a_counted_skip():
    for damaged in (LINE.replace(b"-3.5000", b"-3.5"), LINE.replace(b"R42|7|", b"R42|256|"), LINE[:-1] + b"x"):
        events = decoded(REPORTS, damaged, LINE)
        assert events[-1] == SAMPLE
        assert b"".join(e.data for e in events if isinstance(e, Skipped)) == damaged


def test_fields_are_declared_once_and_frozen():
    assert list(Weather.FIELDS) == ["board", "place", "celsius", "raw", "wet"]
    assert Weather(1, "x", 0.0, b"").wet is False
    with pytest.raises(FrozenInstanceError):
        SAMPLE.board = 3  # type: ignore[misc]
    with pytest.raises(FrameError, match="R42 board: found 300, expected a whole number from 0 to 255"):
        encode(Weather(300, "x", 0.0, b""))


@pytest.mark.parametrize("key", [b"X01", b"R1", b"R123", "R42", None])
def test_keys_are_a_letter_and_two_digits(key):
    with pytest.raises(ArgumentError, match=r"key: found .*, expected a letter C, R or S and two digits"):
        message(key)


@message(b"R43")
class Half(Message):
    """One field has no kind."""

    board: int = wire(ID)
    rest: int = 0


@message(b"R05")
class Another(Message):
    """A key of the boards."""

    count: int = wire(INT)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        (Weather, r"message Weather \(R42\): R42 is Weather already; choose another key"),
        (Another, r"message Another \(R05\): R05 is RangeReport already"),
        (Half, r"message Half \(R43\): rest: has no kind; declare it as in `count: int = wire\(INT\)`"),
        (Message, "expected a class made with @message"),
        (int, "expected a class made with @message"),
        (SAMPLE, "expected a class made with @message"),
    ],
)
def test_what_cannot_be_a_message_is_refused(kind, expected):
    with pytest.raises(ArgumentError, match=expected):
        register_message(kind)
    assert REPORTS[b"R05"] is RangeReport
