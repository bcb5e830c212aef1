"""Tables in which an exchange has several rows: a few rows at a time they come to what they come to at once."""

import tracemalloc
from contextlib import nullcontext
from typing import ClassVar

import numpy as np
import pytest

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
from uwblink.importers import bags, import_file, read_table, staging


def at_once(patch, rows):
    patch.setattr(staging, "ROWS_AT_ONCE", rows)


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
        monkeypatch.setattr(bags, "opened", lambda path, bag=bag: nullcontext(bag))
        tracemalloc.start()
        done = import_file(bag.path, tmp_path / f"{count}.uwb")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert done.counts["exchanges"] == count
    # Exchanges that stayed would be 450 kB more.
    assert peaks[2] - peaks[1] < 100_000
