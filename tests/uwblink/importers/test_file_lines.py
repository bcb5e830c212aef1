"""Where rows of a file stand, looked at line by line by a reader of its own."""

import gzip

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from uwblink.importers import tables
from uwblink.importers.tables import lines_of

LINES = ["1,2,3", "4,5,6", "é,1", "", " ", "\t", "\u00a0", '"a', 'b",3', '"x",4', "\ufeff", "\ufeff7,8"]
ENDS = ["\n", "\n", "\n", "\r\n", "\r"]


def beginnings(path, skip, rejected):
    """Lines at which rows begin, as an importer counts them: one character after the other."""
    opened = gzip.open if path.suffix == ".gz" else open
    with opened(path, "rt", encoding="utf-8-sig", errors="replace") as file:
        lines = file.read().split("\n")
    quoted, found = False, []
    for number, line in enumerate(lines, start=1):
        if not quoted and line.strip() and number > skip and number not in rejected:
            found.append(number)
        for letter in line:
            quoted ^= letter == '"'
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("lines")


@settings(max_examples=150, derandomize=True, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from(LINES), st.sampled_from(ENDS)), min_size=1, max_size=25),
    st.integers(0, 3),
    st.sets(st.integers(1, 25), max_size=4),
    st.integers(1, 60),
    st.sampled_from([".csv", ".csv.gz"]),
)
@example([("1,2,3", "\n")] * 20, 1, {3, 9}, 10, ".csv")
def test_rows_are_found_a_piece_of_the_file_at_a_time(folder, lines, skip, rejected, piece, suffix):
    text = "".join(line + end for line, end in lines).rstrip("\n").encode()
    path = folder / f"t{suffix}"
    path.write_bytes(gzip.compress(text) if suffix.endswith("gz") else text)
    expected = beginnings(path, skip, rejected)
    out = np.array(sorted(rejected), dtype=np.int64)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tables, "PIECE_BYTES", piece)
        assert lines_of(path, skip, out, np.arange(len(expected))).tolist() == expected
        some = np.arange(len(expected))[::-3]
        assert lines_of(path, skip, out, some).tolist() == [expected[k] for k in some]
