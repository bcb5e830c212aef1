"""The captured bytes of tests/golden: sent to the boards, and received from them."""

import ast
import re
from pathlib import Path

FILE = Path(__file__).parents[2] / "golden" / "board_transcripts.txt"
LINE = re.compile(r"^ +([\d.]+) ms +board (\d+) +(<-host|->host) +(b\".*\")$")


def pieces():
    """Return the pieces of the transcript that start with fresh boards: lists of (ms, board, direction, bytes)."""
    texts = re.split(r"^(?:====|--).*$", FILE.read_text(), flags=re.MULTILINE)
    found = [[LINE.match(line) for line in text.splitlines()] for text in texts]
    return [[(float(m[1]), int(m[2]), m[3], ast.literal_eval(m[4])) for m in piece if m] for piece in found]


def captured(direction):
    """Return the transfers of one direction, "<-host" or "->host", as (board, bytes)."""
    return [(board, data) for piece in pieces() for _, board, way, data in piece if way == direction]
