"""The captured bytes of tests/golden: sent to the boards, and received from them."""

import ast
import re
from pathlib import Path

FILE = Path(__file__).parents[2] / "golden" / "board_transcripts.txt"
LINE = re.compile(r"^ +[\d.]+ ms +board (\d+) +(<-host|->host) +(b\".*\")$")


def captured(direction):
    """Return the transfers of one direction, "<-host" or "->host", as (board, bytes)."""
    matches = map(LINE.match, FILE.read_text().splitlines())
    return [(int(m[1]), ast.literal_eval(m[3])) for m in matches if m and m[2] == direction]
