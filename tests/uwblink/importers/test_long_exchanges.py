"""Tables in which an exchange has several rows: a few rows at a time they come to what they come to at once."""

import errno
import io
import tracemalloc
from contextlib import nullcontext
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.uwblink.importers.test_long_tables import told
from tests.uwblink.importers.test_planted_delays import messages_of
from tests.uwblink.importers.test_table_forms import (
    as_messages,
    flights,
    later,
    mapped,
    repeated,
    stamps,
    wrapped,
    write,
)
from uwblink.errors import ImportTableError
from uwblink.importers import exchange_bags, import_file, row_files, split_rows, staged_tables, table_rows
from uwblink.importers.column_map import ColumnMap
from uwblink.importers.exchange_tables import read_table
from uwblink.importers.long_tables import exchanges_of_long
from uwblink.importers.staging import Stage
from uwblink.importers.stamps import NEVER
from uwblink.importers.table_rows import HeldRows, Rows
from uwblink.importers.unusable import Unusable

SECOND = 1_000_000_000


def at_once(patch, rows):
    for room in (table_rows, staged_tables, split_rows, row_files):
        patch.setattr(room, "ROWS_AT_ONCE", rows)
    # Or the few rows of a test were all in one part.
    patch.setattr(split_rows, "DRAWN", 2)


class Tables:
    """Rows in memory where tables are expected."""

    def __init__(self, rows, size):
        self.rows, self.size, self.stage = rows, size, self

    def __len__(self):
        return len(self.rows)

    def has(self, name):
        return table_rows.has(self.rows, name)

    def blocks(self, names=None):
        for start in range(0, len(self), self.size):
            yield table_rows.take(self.rows, np.arange(start, min(start + self.size, len(self))))

    def at(self, places, names):
        return HeldRows(self.rows).at(places, names)

    file = io.BytesIO


@st.composite
def long_rows(draw):
    """Rows of a few devices, in any order, some of them repeated or with nothing in a cell, close to each other."""
    layout = draw(st.sampled_from(["messages", "stamps", "parts"]))
    count = draw(st.integers(1, 60))
    chance = np.random.default_rng(draw(st.integers(0, 2**32)))
    few, low, high = draw(st.integers(1, 8)), draw(st.integers(0, 1)), draw(st.integers(2, 4))
    have = {name: draw(st.booleans()) for name in ("sequence", "message", "time", "gt_range_m", "fpp")}
    cells = {
        "sequence": chance.integers(few, size=count),
        "message": chance.integers(low, high + 1, size=count),
    }
    cells |= {"gt_range_m": chance.random(count), "fpp": chance.random(count)}
    named = {"messages": ("tx", "rx"), "stamps": ("stamp",), "parts": ("tx1", "rx1", "tx2", "rx2")}[layout]
    cells = {name: column for name, column in cells.items() if have[name] or (layout, name) == ("stamps", "message")}
    cells |= {name: chance.integers(2**32, size=count) for name in named}
    if layout == "stamps":
        cells["event"] = chance.integers(1, 3, size=count)
    empty = draw(st.sampled_from([0.0, 0.0, 0.1, 0.5]))
    cells = {n: np.where(chance.random(count) < empty, np.nan, column.astype(float)) for n, column in cells.items()}
    ids = [np.where(chance.random(count) < 0.05, NEVER, chance.integers(3, size=count)) for _ in range(2)]
    return layout, Rows(
        column_map=ColumnMap(within_s=draw(st.sampled_from([0.5, 2.0, 100.0]))),
        cells=cells,
        ids=dict(zip(("from_id", "to_id"), ids, strict=True)),
        time_ns=chance.integers(count, size=count) * SECOND if have["time"] else None,
        origin=np.arange(count),
    )


def columns(source):
    rows = table_rows.joined(list(source.blocks())) if len(source) else None
    return rows and {**rows.cells, **rows.ids, "time": rows.time_ns, "origin": rows.origin}


@settings(max_examples=120, derandomize=True, deadline=None)
@given(long_rows(), st.integers(2, 12))
def test_a_few_rows_at_a_time_make_the_same_exchanges(made, size):
    layout, rows = made
    with pytest.MonkeyPatch.context() as patch:
        told = []
        for count in (1000, size):
            at_once(patch, count)
            unusable = Unusable()
            tables: Any = Tables(rows, count)
            source, protocol = exchanges_of_long(tables, layout, unusable)
            reasons = [(reason, places.tolist()) for reason, places in unusable.reasons()]
            told.append((columns(source), protocol, reasons, len(source)))
    (whole, *others), (few, *same) = told
    assert same == others
    assert (few is None) == (whole is None)
    for name in whole or ():
        np.testing.assert_array_equal(few[name], whole[name], err_msg=name)


def lines_of(layout):
    """Exchanges as rows in any order, some lost and some that nobody can use."""
    rows = flights(80)
    plain = wrapped(rows)
    if layout == "messages":
        lines = as_messages(plain)
    elif layout == "stamps":
        lines = [
            common | {"event": kind, "stamp": both[kind], "fpp": power}
            for k, row in enumerate(plain)
            for common, both, power in messages_of(row | {"fpp3": ""}, k)
            for kind in ("tx", "rx")
        ]
    else:
        common = ("time_s", "from_id", "to_id")
        ours = [{n: row[n] for n in (*common, "tx1", "rx2", "rx3")} | {"seq": k} for k, row in enumerate(plain)]
        theirs = [{n: row[n] for n in (*common, "rx1", "tx2", "tx3")} | {"seq": k} for k, row in enumerate(plain)]
        names = dict.fromkeys(n for line in (ours[0], theirs[0]) for n in line)
        lines = [dict.fromkeys(names, "") | line for line in ours + theirs]
    np.random.default_rng(2).shuffle(lines)
    del lines[5]
    lines[8] = lines[8] | {"from_id": "?"}
    return lines


@pytest.mark.parametrize("layout", ["messages", "stamps", "parts"])
def test_a_table_is_the_same_a_few_rows_at_a_time(tmp_path, monkeypatch, layout):
    table = write(tmp_path / "t.csv", lines_of(layout))
    text = mapped(tmp_path, f'layout = "{layout}"\nwithin_s = 0.1\n[columns]\nsequence = "seq"\n')
    whole = read_table(table, text)
    assert 70 < len(whole.exchanges) < 80
    at_once(monkeypatch, 50)
    assert told(read_table(table, text)) == told(whole)
    said = []
    done = import_file(table, tmp_path / "t.uwb", map_file=text, watch=lambda *one: said.append(one))
    assert done.counts == whole.counts()
    assert list(dict.fromkeys(what for what, _ in said)) == ["reading", "sorting", "grouping", "checking", "writing"]
    assert all(0 <= share <= 1 for _, share in said)


def test_all_rows_and_not_the_first_ones_tell_the_protocol(tmp_path, monkeypatch):
    # The pair that is looked at first lost its third messages; of all exchanges it is a third.
    lines = [
        line
        for line in as_messages(wrapped(flights(90)))
        if line["message"] < 3 or 3 in (line["from_id"], line["to_id"])
    ]
    table = write(tmp_path / "t.csv", lines)
    text = mapped(tmp_path, 'within_s = 0.1\n[columns]\nsequence = "seq"\n')
    at_once(monkeypatch, 40)
    found = read_table(table, text)
    assert set(found.exchanges.protocol) == {"ds"}
    assert (len(found.exchanges), len(found.faults)) == (60, 30)


def test_messages_are_counted_from_zero_where_all_of_them_are(tmp_path, monkeypatch):
    # The pair that is looked at first has a message 0 in each exchange by damage.
    lines = [line | {"message": line["message"] - 1} for line in as_messages(wrapped(flights(90)))]
    text = mapped(tmp_path, 'within_s = 0.1\n[columns]\nsequence = "seq"\n')
    at_once(monkeypatch, 40)
    assert len(read_table(write(tmp_path / "0.csv", lines), text).exchanges) == 90
    first = [line | {"message": line["message"] + (3 in (line["from_id"], line["to_id"]))} for line in lines]
    found = read_table(write(tmp_path / "1.csv", first), text)
    assert (len(found.exchanges), len(found.faults)) == (60, 30)


def test_a_group_that_is_longer_than_many_blocks(tmp_path, monkeypatch):
    rows = flights(12)
    ends, names = ("time_s", "from_id", "to_id"), ("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")
    lines = []
    for k, row in enumerate(wrapped(rows)):
        plain = {n: row[n] for n in ends} | {"sequence": k} | dict.fromkeys(names, "")
        lines += [plain | {n: row[n]} for n in names]
        # One of the exchanges comes with a hundred rows that say nothing.
        lines += [plain] * (100 if k == 4 else 0)
    np.random.default_rng(6).shuffle(lines)
    table, text = write(tmp_path / "t.csv", lines), mapped(tmp_path, 'layout = "parts"')
    at_once(monkeypatch, 10)
    found = read_table(table, text).exchanges
    order = np.argsort(found.time_ns)
    assert [stamps(found)[k] for k in order] == [[row[n] for n in names] for row in wrapped(rows)]


@pytest.mark.parametrize("layout", ["messages", "stamps", "parts"])
def test_a_table_without_any_device_says_so(tmp_path, layout):
    lines = [line | {"from_id": "", "message": 1} for line in lines_of(layout)]
    text = mapped(tmp_path, f'layout = "{layout}"\n[columns]\nsequence = "seq"\n')
    with pytest.raises(ImportTableError, match="row 2, column 'from_id'"):
        read_table(write(tmp_path / "t.csv", lines), text)


@pytest.mark.parametrize(("layout", "missing"), [("messages", "tx"), ("stamps", "event")])
def test_what_a_layout_needs_is_said(tmp_path, layout, missing):
    lines = [{n: v for n, v in line.items() if n != missing} for line in lines_of(layout)]
    with pytest.raises(ImportTableError, match=f"column '{missing}' is missing"):
        read_table(write(tmp_path / "t.csv", lines), mapped(tmp_path, f'layout = "{layout}"'))


def test_memory_does_not_grow_with_the_table(tmp_path, monkeypatch):
    at_once(monkeypatch, 2_000)
    text = mapped(tmp_path, 'within_s = 0.1\n[columns]\nsequence = "seq"\n')
    peaks = []
    for times in (10, 40, 140):  # the first is for what is only made once
        rows = [row | {"time_s": row["time_s"] + 100 * (k // 60)} for k, row in enumerate(repeated(flights(), times))]
        table = write(tmp_path / f"{times}.csv", as_messages(wrapped(rows)))
        tracemalloc.start()
        import_file(table, tmp_path / f"{times}.uwb", map_file=text)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # A column of 8 bytes a row that stayed would be 144 kB more.
    assert peaks[2] - peaks[1] < 100_000


class Bag:
    """Messages as if they were read from a bag, one at a time."""

    kinds: ClassVar = {"/uwb": "uwb"}

    def __init__(self, path, count):
        self.path, self.count = path, count

    def messages(self, _):
        rows = flights()
        for k in range(self.count):
            (row,) = wrapped([later(rows[k % 60], k // 60)])
            yield "/uwb", "uwb", 1_000_000 * k, {n: v for n, v in row.items() if n != "time_s"}


def test_memory_does_not_grow_with_a_bag(tmp_path, monkeypatch):
    at_once(monkeypatch, 500)
    (tmp_path / "b.mcap").touch()
    peaks = []
    for count in (200, 2_500, 5_500):  # the first is for what is only made once; the others fill a sample of 2,000
        bag = Bag(tmp_path / "b.mcap", count)
        monkeypatch.setattr(exchange_bags, "opened", lambda path, bag=bag: nullcontext(bag))
        tracemalloc.start()
        done = import_file(bag.path, tmp_path / f"{count}.uwb")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert done.counts["exchanges"] == count
    # Exchanges that stayed would be 450 kB more.
    assert peaks[2] - peaks[1] < 100_000


def test_a_disk_that_takes_no_more_is_told_of(monkeypatch):
    class Full(io.BytesIO):
        def write(self, _):
            raise OSError(errno.ENOSPC, "No space left on device")

    rows = Rows(column_map=ColumnMap(), cells={}, ids={}, time_ns=None, origin=np.arange(0))
    with Stage([]) as stage:
        monkeypatch.setattr(stage, "file", Full)
        with pytest.raises(ImportTableError, match=r"No space left on device\); TMPDIR names another folder"):
            row_files.RowFile(stage, rows).append(rows)
