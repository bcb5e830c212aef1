"""Variants of tables, by a separate writer that shares no code with the importer, with planted values."""

import csv
import gzip
import json
import re
from itertools import cycle

import duckdb
import numpy as np
import pytest

from tests.errors import one_line
from uwblink import errors, import_recording, load, raw_range
from uwblink.importers import read_source
from uwblink.importers.guess import guess_map
from uwblink.importers.tables import SourceTable, connected

TICKS = 128 * 499_200_000
AIR = 299_702_547.0
HEADER = ["time_s", "from_id", "to_id", "tx1", "rx1", "tx2", "rx2", "tx3", "rx3", "fpp1", "fpp2"]


BOUNDS = ((200, 3000), (0, 2**41), (0, 2**41), (20_000_000, 40_000_000), (80_000_000, 90_000_000))
"""Ticks of an exchange: flight, start of each clock, reply, and from the second message to the third."""


def flights(count=60, third="target"):
    """Return exchanges between tags 1, 2, 3 as unwrapped ticks of two clocks, and true distances (whole ticks)."""
    random = np.random.default_rng(1)
    rows = []
    for k in range(count):
        one, two = [(1, 2), (2, 3), (3, 1)][k % 3]
        flight, mine, other, reply, later = (int(random.integers(*bounds)) for bounds in BOUNDS)
        tx1, rx1 = mine, other + flight
        tx2, rx2 = rx1 + reply, tx1 + 2 * flight + reply
        tx3 = (tx2 if third == "target" else rx2) + later
        rx3 = tx3 - other + mine + flight if third == "target" else tx3 - mine + other + flight
        stamps = dict(zip(HEADER[3:9], (tx1, rx1, tx2, rx2, tx3, rx3), strict=True))
        row = {"time_s": 10 + k / 4, "from_id": one, "to_id": two, **stamps}
        rows.append({**row, "fpp1": -80 - k / 8, "fpp2": -81 - k / 8, "truth": flight / TICKS * AIR})
    return rows


def later(row, ticks):
    """Return the same exchange with both clocks later."""
    return {n: v + ticks if n in HEADER[3:9] else v for n, v in row.items()}


def wrapped(rows, bits=32):
    return [{n: v % 2**bits if n in HEADER[3:9] else v for n, v in row.items() if n != "truth"} for row in rows]


def write(path, rows, delimiter=",", text=str, header=True):
    names = list(rows[0])
    lines = [delimiter.join(names)] * header + [delimiter.join(text(row[n]) for n in names) for row in rows]
    data = ("\n".join(lines) + "\n").encode()
    path.write_bytes(gzip.compress(data) if path.suffix == ".gz" else data)
    return path


def mapped(tmp_path, text):
    (tmp_path / "map.toml").write_text(text)
    return tmp_path / "map.toml"


def stamps(exchanges):
    return [[int(getattr(exchanges, n)[k]) for n in HEADER[3:9]] for k in range(len(exchanges))]


def same(found, rows, bits=32):
    assert found.exchanges.bits == bits
    assert stamps(found.exchanges) == [[row[n] % 2**bits for n in HEADER[3:9]] for row in rows]
    np.testing.assert_allclose(found.exchanges.range_m, [row["truth"] for row in rows], atol=1e-9)


@pytest.fixture
def rows():
    return flights()


POSE = ("time_s", "body", "x", "y", "z", "qx", "qy", "qz", "qw")


def with_names(**others):
    """Return exchanges with some stamps in the columns of others."""
    return [row | {name: row[other] for name, other in others.items()} for row in wrapped(flights())]


def without_replies(count):
    return [row | {"tx2": ""} if k < count else row for k, row in enumerate(wrapped(flights()))]


def read_table(source, map_file=None):
    return read_source(source, importer="csv", map_file=map_file)


def read_rows(tmp_path, rows, text=None):
    """Write rows to a table, and read it with a map of this text."""
    return read_table(write(tmp_path / "t.csv", rows), None if text is None else mapped(tmp_path, text))


def imported(tmp_path, text, map_text="", name="t.csv"):
    """Write a text to a file, and read it with a map of another text if there is one."""
    (tmp_path / name).write_text(text)
    return read_table(tmp_path / name, mapped(tmp_path, map_text) if map_text else None)


@pytest.mark.parametrize("delimiter", [";", "\t", "|"])
def test_any_delimiter_with_a_byte_order_mark_comments_and_windows_lines(tmp_path, delimiter, rows):
    path = write(tmp_path / "t.csv", wrapped(rows), delimiter)
    path.write_text("\ufeff# what this is\n" + path.read_text(), newline="\r\n")
    same(read_table(path), rows)


@pytest.mark.parametrize(
    ("columns", "text", "unread"),
    [
        ("time_s range_m fpp_dbm gt_range note", None, ["'fpp_dbm' (fpp2?)", "'gt_range' (gt_range_m?)"]),
        ("time range_m fpp", None, ["'time' (time_s?)", "'fpp' (fpp2?)"]),
        ("time_s range_m fpp1 gt_range_m x2", None, ["'x2' (to_x_m?)"]),
        ("time_s range_m rxp1 seq note", None, []),
        ("time_s distance fpp_dbm", '[columns]\nrange_m = "distance"\n', []),
    ],
)
def test_a_note_names_columns_that_are_not_read(tmp_path, columns, text, unread):
    row = {"from_id": 1, "to_id": 2} | dict.fromkeys(columns.split(), -2)
    notes = read_rows(tmp_path, [row | {"time" + "_s" * ("time_s" in row): k} for k in range(9)], text).meta["notes"]
    named = [note for note in notes if "not read" in note]
    assert len(named) == bool(unread)
    assert all(one in named[0] for one in unread)


def test_several_files_are_one_table(tmp_path, rows):
    paths = [write(tmp_path / f"{k}.csv", wrapped(rows[k::2])) for k in (0, 1)]
    same(read_table(paths), rows)
    same(read_source(paths[::-1]), rows)
    assert len(read_table(tmp_path).exchanges) == len(rows)
    with pytest.raises(errors.ArgumentError, match="found no files"):
        read_source([])
    write(tmp_path / "2.csv", [{"time_s": 1, "from_id": 1, "to_id": 2, "range_m": 3}])
    with pytest.raises(errors.ImportTableError, match="other columns than"):
        read_table(tmp_path)


@pytest.mark.parametrize(
    ("unit", "scale", "after"),
    [
        *(('"ns"', 1e9 / TICKS, 0), ('"us"', 1e6 / TICKS, 0), ('"s"', 1 / TICKS, 0), (repr(1 / TICKS), 1.0, 0)),
        ('"ticks"', 1, 2**60),  # which no float holds
    ],
)
def test_unwrapped_stamps_in_any_unit(tmp_path, unit, scale, after, rows):
    scaled = [{n: repr(v * scale) if n in HEADER[3:9] else v for n, v in later(row, after).items()} for row in rows]
    found = read_rows(tmp_path, [{n: row[n] for n in HEADER} for row in scaled], f"[units]\nstamps = {unit}\n")
    # The first stamp of a clock has the rounding error of a float of so many seconds; the following intervals do not.
    np.testing.assert_allclose(found.exchanges.range_m, [row["truth"] for row in rows], atol=1e-9)
    assert any("unwrapped" in note for note in found.meta["notes"])


@pytest.mark.parametrize("bits", [32, 40])
def test_the_width_is_found_and_signed_stamps_are_read(tmp_path, bits):
    rows, half = flights(), 2 ** (bits - 1)
    same(read_rows(tmp_path, wrapped(rows, bits)), rows, bits)
    signed = [later(row, -half) for row in wrapped([later(row, half) for row in rows], bits)]
    found = read_rows(tmp_path, signed)
    same(found, rows, bits)
    assert f"stamps are signed, and are taken modulo 2^{bits}" in found.meta["notes"]


def test_the_protocol_is_found_by_the_stamps(tmp_path):
    rows = flights(third="initiator")
    found = read_rows(tmp_path, wrapped(rows))
    same(found, rows)
    assert set(found.exchanges.protocol) == {"ds-alt"}
    assert any('read with protocol = "ds-alt"' in note for note in found.meta["notes"])


@pytest.mark.parametrize(
    ("rows", "text", "said"),
    [
        ([dict.fromkeys(POSE, 1)] * 3, "", "these are poses, which `uwblink poses` adds to"),
        ([dict.fromkeys(("from_id", "to_id", "length"), 2)] * 30, "", "'range_m' is missing; there are from_id, to_id"),
        (wrapped(flights(third="initiator")), 'protocol = "ds"', 'with protocol = "ds-alt" they are'),
        (with_names(rx1="rx2", rx2="rx1"), "", "the columns of rx1 and rx2 exchanged"),
        (
            with_names(tx1="rx1", rx1="tx1", tx2="rx2", rx2="tx2"),
            "",
            "tx1 and rx1 exchanged and the columns of tx2 and rx2",
        ),
        # Half of the rows, one more than is accepted.
        (without_replies(30), "", "row 2"),
        ([dict.fromkeys((*HEADER[:3], "message", "rx"), 1)] * 2, 'layout = "messages"', "column 'tx' is missing"),
        ([dict.fromkeys((*HEADER[:3], "message", "stamp"), 1)] * 2, 'layout = "stamps"', "column 'event' is missing"),
    ],
)
def test_tables_that_cannot_be_meant_are_refused_with_the_reason(tmp_path, rows, text, said):
    with pytest.raises(errors.ImportTableError, match=said):
        read_rows(tmp_path, rows, text)


def test_corrupt_rows_are_faults_with_their_place(tmp_path):
    rows = flights(count=200)
    lines = write(tmp_path / "t.csv", wrapped(rows)).read_text().splitlines()
    lines[10] = lines[10].replace(",", ",x", 1)  # not an id
    lines[20] = ",".join(lines[20].split(",")[:6])  # a row with too few cells
    lines[30] += ",1,2,3"  # a row with too many cells
    lines[40] = lines[40].rsplit(",", 2)[0] + ",,nan"  # powers are optional
    lines[50] = lines[50].replace(f",{rows[49]['rx2'] % 2**32},", ",-5.5,")
    lines.insert(60, "")
    lines[70] = lines[70].replace(str(rows[68]["time_s"]) + ",", "soon,", 1)
    (tmp_path / "t.csv").write_text("\n".join(lines) + "\n")
    found = read_table(tmp_path / "t.csv")
    expected = (
        "row 11, column 'from_id': found 'x.*",
        "row 21, column '[tr]x2': found ''.*",
        "row 31: more cells than the header has",
        "row 51, .*found '-5.5'.*",
        "row 71, .*found 'soon', expected a time.*",
    )
    for pattern, detail in zip(expected, sorted(fault.detail for fault in found.faults), strict=True):
        assert re.fullmatch(pattern, detail), detail
    assert (len(found.exchanges), np.isnan(found.exchanges.fpp2_dbm).sum()) == (195, 1)
    same(found, [row for k, row in enumerate(rows) if k not in (9, 19, 29, 49, 68)])
    assert any(note.startswith("5 of ") for note in found.meta["notes"])
    assert len(read_rows(tmp_path, without_replies(29)).exchanges) == 31


def test_iso_times_names_and_programmed_delays(tmp_path):
    named = [
        {**row, "time_s": f"2024-05-06T07:08:{10 + k % 50:02d}.000000{k:03d}+02:00", "from_id": f"AA:{row['from_id']}"}
        for k, row in enumerate(wrapped(flights()))
    ]
    text = '[ids]\n"AA:1" = 77\n[antenna_delays]\nunit = "ns"\ntx = 257.0\nrx = 258.0\n'
    found = read_rows(tmp_path, named, text + "[antenna_delays.tags.77]\ntx = 1.0\n")
    assert found.meta["configured_antenna_delay_ticks"] == {"tx": 16422, "rx": 16486}
    assert found.meta["configured_antenna_delay_ticks_by_tag"] == {"77": {"tx": 64, "rx": 16486}}
    assert (found.meta["tag_names"]["77"], found.exchanges.initiator[0]) == ("AA:1", 77)
    assert {tag.body for tag in found.tags} >= {"AA:1", "AA:2", "AA:3"}
    # 07:08:10 two hours east of Greenwich; DuckDB keeps microseconds, and zones are shifts.
    assert abs(int(found.exchanges.time_ns[0]) - 1714972090_000000000) < 1000


def test_unused_repeated_headers_are_accepted(tmp_path, rows):
    lines = write(tmp_path / "t.csv", wrapped(rows)).read_text().splitlines()
    (tmp_path / "t.csv").write_text(
        "\n".join(f"{'note,note' if k == 0 else 'a,b'},{line}" for k, line in enumerate(lines))
    )
    same(read_table(tmp_path / "t.csv"), rows)
    with pytest.raises(errors.ImportTableError, match="two columns are called 'note'"):
        read_table(tmp_path / "t.csv", mapped(tmp_path, '[columns]\nskew1 = "note"\n'))


def test_reported_ranges_are_kept_with_stamps(tmp_path):
    rows = [{**row, "range_m": "" if k else 7.5} for k, row in enumerate(wrapped(flights()))]
    assert read_rows(tmp_path, rows).exchanges.range_m[:2] == pytest.approx([7.5, flights()[1]["truth"]])


def test_tables_without_times_are_read(tmp_path):
    found = read_rows(tmp_path, [{n: row[n] for n in HEADER[1:]} for row in wrapped(flights())])
    assert found.exchanges.time_ns[:3].tolist() == [0, 1_000_000, 2_000_000]
    assert any("no time" in note for note in found.meta["notes"])


@pytest.mark.parametrize(("unit", "scale"), [("mm", 1e3), ("in", 1 / 0.0254)])
def test_ranges_without_stamps_with_total_powers_and_places(tmp_path, unit, scale):
    anchor, rows = np.array([4.0, 1.0, 2.0]), []
    for k, place in enumerate(np.random.default_rng(4).normal(size=(30, 3))):
        lengths = {"range_m": np.linalg.norm(place - anchor) + 0.25}
        lengths |= {f"from_{a}_m": v for a, v in zip("xyz", place, strict=True)}
        lengths |= {f"to_{a}_m": v for a, v in zip("xyz", anchor, strict=True)}
        scaled = {name: repr(float(v) * scale) for name, v in lengths.items()}
        rows.append({"t": k * 100, "from_id": 7, "to_id": 8, **scaled, "rxp2": -79.5, "fpp2": -83.25})
    text = f'[columns]\ntime_s = "t"\n[units]\ntime = "ms"\ndistance = "{unit}"\n'
    import_recording(write(tmp_path / "t.csv", rows), tmp_path / "o.uwb", map_file=mapped(tmp_path, text))
    found = load(tmp_path / "o.uwb")
    e, powers, bodies = found.exchanges, found.powers, found.poses.body
    np.testing.assert_allclose(raw_range(e) - e.truth_m, 0.25, atol=1e-9)
    assert (e.time_ns[1], powers["rxp2_dbm"][3], e.fpp2_dbm[3]) == (100_000_000, -79.5, -83.25)
    assert np.isnan(powers["rxp1_dbm"]).all()
    assert ((bodies == "tag8").sum(), (bodies == "tag7").sum()) == (1, 30)


@pytest.mark.parametrize(("column", "other"), [("range_m", "true distances"), ("gt_range_m", "ranges")])
def test_the_column_in_another_unit_is_named_with_its_line_of_the_map(tmp_path, column, other):
    rows = [{"from_id": 7, "to_id": 8, "range_m": 2.3 + 0.1 * k, "gt_range_m": 2 + 0.1 * k} for k in range(30)]
    scaled = [row | {column: row[column] / 0.3048} for row in rows]
    with pytest.raises(errors.ImportTableError, match=f"in ft according to the {other}.* write units.{column} = 'ft'"):
        read_rows(tmp_path, scaled)
    found = read_rows(tmp_path, scaled, f"[units]\n{column} = 'ft'\n").exchanges
    np.testing.assert_allclose(found.range_m - found.truth_m, 0.3, atol=1e-6)


def as_messages(rows, third="target"):
    found = []
    for k, row in enumerate(rows):
        for n in (1, 2, 3):
            forward = n == 1 or (n == 3 and third == "initiator")
            ends = (row["from_id"], row["to_id"])
            sender, receiver = ends if forward else ends[::-1]
            line = {"time_s": row["time_s"] + n / 1000, "seq": k % 8, "from_id": sender, "to_id": receiver}
            found.append(
                {**line, "message": n, "tx": row[f"tx{n}"], "rx": row[f"rx{n}"], "fpp": row.get(f"fpp{n}", "")}
            )
    return found


@pytest.mark.parametrize(
    ("third", "without"),
    [
        ("target", ()), ("initiator", ("seq", "message")), ("initiator", ("time_s",)),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in (("initiator", ("seq",)), ("target", ("message",)))),
    ],
)  # fmt: skip
def test_tables_with_a_row_per_message_are_read(tmp_path, third, without):
    rows = flights(third=third)
    lines = [{n: v for n, v in line.items() if n not in without} for line in as_messages(wrapped(rows), third)]
    if "time_s" not in without:
        np.random.default_rng(5).shuffle(lines)
    sequence = "" if "seq" in without else 'sequence = "seq"\n'
    found = read_rows(tmp_path, lines, f"within_s = 0.1\n[columns]\n{sequence}")
    assert not found.faults
    e, expected = found.exchanges[np.argsort(found.exchanges.tx1)], sorted(rows, key=lambda row: row["tx1"] % 2**32)
    assert stamps(e) == [[row[n] % 2**32 for n in HEADER[3:9]] for row in expected]
    assert e.initiator.tolist() == [row["from_id"] for row in expected]
    assert e.fpp2_dbm.tolist() == [row["fpp2"] for row in expected]
    assert set(e.protocol) == {"ds" if third == "target" else "ds-alt"}


def test_a_message_that_got_lost_is_a_fault_not_another_exchange(tmp_path):
    lines = as_messages(wrapped(flights()))
    del lines[7]  # message 2 of the third exchange
    found = read_rows(tmp_path, lines, 'within_s = 0.1\n[columns]\nsequence = "seq"\n')
    assert (len(found.exchanges), [fault.detail.split(",")[0] for fault in found.faults]) == (59, ["row 8"])


def test_tables_with_two_rows_per_exchange_are_read(tmp_path):
    rows, at_target = flights(), dict.fromkeys(("rx1", "tx2", "tx3"), "")
    lines = []
    for k, row in enumerate(wrapped(rows)):
        whole = {n: row[n] for n in HEADER[:9]} | {"sequence": k}
        lines += [whole | dict.fromkeys(("tx1", "rx2", "rx3"), ""), whole | at_target]
    e = read_rows(tmp_path, lines, 'layout = "parts"').exchanges
    assert stamps(e[np.argsort(e.time_ns)]) == [[row[n] % 2**32 for n in HEADER[3:9]] for row in rows]


def test_hostile_names_of_columns_are_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {"tx1": 'a"; DROP TABLE x; --', "rx1": "c0'); ATTACH 'evil.db'; --", "tx2": "{0}?\\"}
    rows = flights()
    table = [{names.get(n, n): row[n] for n in HEADER} for row in wrapped(rows)]
    with (tmp_path / "t.csv").open("w", newline="") as file:
        csv.writer(file).writerows([table[0], *(row.values() for row in table)])
    (tmp_path / "t.jsonl").write_text("".join(json.dumps(row) + "\n" for row in table))
    with duckdb.connect() as db:
        db.read_csv("t.csv", header=True).write_parquet("t.parquet")
    mapped(tmp_path, "[columns]\n" + "".join(f"{n} = {json.dumps(name)}\n" for n, name in names.items()))
    for ending in ("csv", "jsonl", "parquet"):
        same(read_table(tmp_path / f"t.{ending}", tmp_path / "map.toml"), rows)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map.toml", "t.csv", "t.jsonl", "t.parquet"]


HOSTILE = ("x'); COPY (SELECT 1) TO 'pwned.csv'; --", "__import__('os').mkdir('pwned')", '{0.__class__}"; ${HOME}')
PLACES = (
    "layout = {}", "counter = {}", "protocol = {}", "delimiter = {}", "decimal = {}", "each = {}",
    "[columns]\ntx1 = {}",
    "[columns]\ntime_s = {}", "[units]\nstamps = {}", "[units]\ntime = {}", "[units]\ndistance = {}",
    "[constants]\nfrom_id = {}", "[constants]\ntx1 = {}", "[ids]\n{} = 3", "[antenna_delays]\nunit = {}",
    "[antenna_delays.tags.{}]\ntx = 1", "[topics.{}]\nto_id = 1",
)  # fmt: skip


def test_no_text_of_a_map_is_a_program(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "t.csv", wrapped(flights()))
    for place, text in zip(PLACES, cycle(HOSTILE), strict=False):
        map_file = mapped(tmp_path, place.format(json.dumps(text)))
        if place.startswith(("[constants]\nfrom_id", "[ids]")):  # only the name of a device can be any text
            assert len(read_table(tmp_path / "t.csv", map_file).exchanges) == 60
        else:
            with pytest.raises(errors.ImportTableError, match=one_line()):
                read_table(tmp_path / "t.csv", map_file)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map.toml", "t.csv"]


def test_duckdb_may_open_the_named_file_only(tmp_path):
    write(tmp_path / "t.csv", wrapped(flights()))
    (tmp_path / "secret.csv").write_text("a\n1\n")
    with connected([tmp_path / "t.csv"]) as db:
        table = SourceTable(db, tmp_path / "t.csv")
        for query in (f"SELECT * FROM read_csv('{tmp_path}/secret.csv')", f"COPY (SELECT 1) TO '{tmp_path}/x.csv'"):
            with pytest.raises(duckdb.Error):
                table.db.execute(query)
    assert not (tmp_path / "x.csv").exists()


@pytest.mark.parametrize(("bits", "counter", "low"), [(32, "wrapped", 0), (40, "signed", -1)])
def test_the_first_stamp_that_a_counter_cannot_show_is_a_fault(tmp_path, bits, counter, low):
    lowest, rows = low * 2 ** (bits - 1), wrapped(flights(), bits - 1)
    for k, stamp in enumerate((lowest, lowest + 2**bits - 1, lowest - 1, lowest + 2**bits), 3):
        rows[k]["tx1"] = stamp
    found = read_rows(tmp_path, rows, f'protocol = "ds"\nbits = {bits}\ncounter = "{counter}"\n')
    assert len(found.exchanges) == 58
    assert [fault.detail.split(",")[0] for fault in found.faults] == ["row 7", "row 8"]


@pytest.mark.parametrize(("unit", "scale"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9), ("iso", None)])
def test_every_unit_of_times(tmp_path, unit, scale):
    rows = wrapped(flights())
    for k, row in enumerate(rows):
        row["time_s"] = f"1970-01-01T00:00:{10 + k / 4:05.2f}" if scale is None else round((10 + k / 4) * scale, 6)
    found = read_rows(tmp_path, rows, f'[units]\ntime = "{unit}"\n').exchanges
    assert found.time_ns.tolist() == [10**10 + k * 250_000_000 for k in range(60)]


# Exchanges that both devices log, so that a table has them twice.


def test_the_same_stamps_of_the_same_devices_are_one_exchange(tmp_path):
    """The second log has the clock of another host, and its own power; the first row is used."""
    rows = wrapped(flights(317))
    again = [row | {"time_s": row["time_s"] + 0.003, "fpp1": -99.0} for row in rows[:246:2]]
    found = read_rows(tmp_path, sorted([*rows, *again], key=lambda row: row["time_s"]))
    assert "123 of 440 rows" in found.meta["notes"][0]
    columns = found.exchanges.tx1.tolist(), found.exchanges.fpp1_dbm.tolist()
    assert columns == tuple([row[name] for row in rows] for name in ("tx1", "fpp1"))


def test_unusable_rows_and_rows_without_stamps_are_no_repetition(tmp_path):
    rows = wrapped(flights(60))
    found = read_rows(tmp_path, [row if k % 7 else row | {"tx2": ""} for k, row in enumerate(rows)])
    assert len(found.exchanges) == 60 - 9
    assert not any("repeat" in note for note in found.meta["notes"])
    zeros = [row | dict.fromkeys(HEADER[3:9], 0) | {"range_m": 3.25} for row in rows]
    assert len(read_rows(tmp_path, zeros).exchanges) == 60


def plain(count, every_s, jitter_s, share, seed, quantum=0.01, noise=0.03):
    """Return ranges of three pairs, a share of which is also logged by the other device, with its own clock."""
    random, rows = np.random.default_rng(seed), []
    for k in range(count):
        one, other = [(1, 2), (2, 3), (3, 1)][k % 3]
        true = 4 + 2 * np.sin(k * every_s / 5 + one)
        row = {"time_s": k * every_s, "from_id": one, "to_id": other}
        row["range_m"] = round(round((true + random.normal(0, noise)) / quantum) * quantum, 6)
        rows.append(row)
        if random.random() < share:
            rows.append(
                row | {"time_s": row["time_s"] + abs(random.normal(0, jitter_s)), "from_id": other, "to_id": one}
            )
    return rows


@pytest.mark.parametrize("seed", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_ranges_without_stamps_that_both_devices_logged_are_merged(tmp_path, seed):
    rows = plain(317, 0.05, 0.004, 0.39, seed)
    found = read_rows(tmp_path, rows)
    first = [
        row["range_m"]
        for k, row in enumerate(rows)
        if not k or row["from_id"] != rows[k - 1]["to_id"] or row["to_id"] != rows[k - 1]["from_id"]
    ]
    assert found.exchanges.range_m.tolist() == first
    (note,) = found.meta["notes"]
    assert note.startswith(f"{len(rows) - 317} of {len(rows)} ranges repeat")


def test_repeated_ranges_of_one_end_are_noted_and_kept(tmp_path):
    rows = plain(317, 0.05, 0.004, 0.39, 0)
    rows = [
        row | {"from_id": min(row["from_id"], row["to_id"]), "to_id": max(row["from_id"], row["to_id"])} for row in rows
    ]
    found = read_rows(tmp_path, rows)
    assert len(found.exchanges) == len(rows)
    assert any("may be logged twice" in note for note in found.meta["notes"])


@pytest.mark.parametrize(("quantum", "noise"), [(0.1, 0.03), (0.01, 0.0)])
def test_ranges_that_are_equal_by_chance_are_not_noted(tmp_path, quantum, noise):
    assert not read_rows(tmp_path, plain(600, 0.05, 0, 0, 1, quantum, noise)).meta["notes"]


# Stamps of devices with and without programmed antenna delays, and of protocols that need more than stamps.


PROGRAMMED = 16_436
"""Ticks of each direction, as on the boards; a device without them stamps its transmissions earlier by this."""


def undelayed(rows, tags=(1, 2, 3), delay=PROGRAMMED):
    """Return the same exchanges as stamped by devices without programmed delays: sent early, received late."""
    found = []
    for row in rows:
        ends = {"i": row["from_id"] in tags, "t": row["to_id"] in tags}
        late = {"tx1": -ends["i"], "rx2": ends["i"], "rx3": ends["i"], "rx1": ends["t"], "tx2": -ends["t"]}
        late["tx3"] = -ends["t"]
        found.append(row | {name: row[name] + sign * delay for name, sign in late.items()})
    return found


def with_truth(rows):
    return [short | {"gt_range_m": row["truth"]} for short, row in zip(wrapped(rows), rows, strict=True)]


ZEROS = "[antenna_delays]\ntx = 0\nrx = 0\n"


@pytest.mark.parametrize(
    ("tags", "text", "ticks"),
    [
        ((1, 2, 3), "", 0),
        ((1, 2, 3), "protocol = 'ds'\nbits = 32\n" + ZEROS, 0),
        ((1, 2, 3), None, 0),
        ((), None, PROGRAMMED),
    ],
    ids=["no map", "a map", "the guess", "the guess of devices that have them"],
)
def test_devices_without_antenna_delays_are_read_beside_true_distances(tmp_path, tags, text, ticks):
    path = write(tmp_path / "t.csv", with_truth(undelayed(flights(), tags)))
    found = read_table(path, mapped(tmp_path, guess_map(path).text if text is None else text))
    assert set(found.exchanges.protocol) == {"ds"}
    assert found.meta["configured_antenna_delay_ticks"] == {"tx": ticks, "rx": ticks}
    longer = found.exchanges.range_m - found.exchanges.truth_m
    assert longer == pytest.approx(2 * (PROGRAMMED - ticks) * AIR / TICKS, abs=1e-6)
    assert len(found.meta["notes"]) == (text == "")


def test_one_device_without_antenna_delays(tmp_path):
    """Ranges to it are 77 m longer, which the map explains."""
    said = f"[antenna_delays]\ntx = {PROGRAMMED}\nrx = {PROGRAMMED}\n[antenna_delays.tags.2]\ntx = 0\nrx = 0\n"
    found = read_rows(tmp_path, with_truth(undelayed(flights(), tags=(2,))), said)
    assert (set(found.exchanges.protocol), found.meta["notes"]) == ({"ds"}, [])
    assert found.meta["configured_antenna_delay_ticks_by_tag"] == {"2": {"tx": 0, "rx": 0}}


def test_antenna_delays_of_a_map_have_priority(tmp_path):
    rows = with_truth(undelayed(flights()))
    with pytest.raises(errors.ImportTableError, match="antenna_delays"):
        read_rows(tmp_path, rows, f"[antenna_delays]\ntx = {PROGRAMMED}\nrx = {PROGRAMMED}\n")
