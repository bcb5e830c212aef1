"""Tables, maps and plug-ins with faults: one line, soon, and no files left."""

import gzip
import json
import subprocess
import sys
import tracemalloc
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from typing import ClassVar

import numpy as np
import pytest

from tests import processes
from tests.errors import one_line
from tests.registered import registered
from tests.uwblink.importers.test_table_forms import (
    HEADER,
    as_messages,
    flights,
    later,
    mapped,
    read_rows,
    read_table,
    wrapped,
    write,
)
from uwblink import Contents, Exchanges, Recording, errors, import_recording, load, register_importer
from uwblink.exporters import EXPORTERS, Exporter, export_recording
from uwblink.importers import (
    IMPORTERS,
    ColumnMap,
    Importer,
    bags,
    import_file,
    read_source,
    staging,
)
from uwblink.importers.guess import guess_map

LINE = "0.5,1,2,3.25\n"
HEAD = "time_s,from_id,to_id,range_m\n"


def test_a_map_of_a_line_without_an_end_is_refused_soon(tmp_path):
    (tmp_path / "t.csv").write_text(HEAD + 5_000_000 * "1", encoding="utf-8")
    # Patterns of logs were searched from each character to the end of the line, which took minutes.
    processes.refuse("uwblink", "import", "guess", tmp_path / "t.csv", naming=["t.csv: row 2"], timeout=90)


def test_a_long_line_is_not_read_into_memory(tmp_path):
    """256 MB in one line, of which only a few lines' worth is read."""
    with gzip.open(tmp_path / "t.csv.gz", "wb", compresslevel=1) as file:
        file.write(HEAD.encode())
        for _ in range(256):
            file.write(bytes(1_000_000))
    code = (
        "import resource, sys; from uwblink.importers import read_source\n"
        "import duckdb, numpy\n"
        "was = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "try: read_source(sys.argv[1])\n"
        "except ValueError: print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - was)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "t.csv.gz"], capture_output=True, text=True, check=True
    )
    assert int(done.stdout) < 60_000, "kilobytes"


NAMES = [f"c{k}" for k in range(5000)]
LONG = HEAD + 30 * LINE + 200_000 * "1," + 30 * f"\n{LINE}"


def endless():
    return gzip.compress(HEAD.encode() + 40_000_000 * b"x", 1)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        pytest.param(*row, id=name)
        for name, *row in (
            ("no Parquet", "t.parquet", b"PAR1 no", ""),
            ("no JSON", "t.jsonl", b"no\n", ""),
            ("deep JSON", "t.jsonl", b"[" * 100_000 + b"\n", ""),
            ("no gzip", "t.csv.gz", b"no", ""),
            ("UTF-16", "t.csv", b"\xff\xfe\x00", ""),
            ("neither UTF-8 nor Latin-1", "t.csv", b"time_s,\x80\n0,1\n", "save it in UTF-8"),
            ("nothing", "t.csv", b"\n", ""),
            ("columns", "t.csv", ",".join(NAMES) + "\n" + ",".join(["1"] * 5000) + "\n", ""),
            ("fields", "t.jsonl", "{" + ", ".join(f'"{name}": 1' for name in NAMES) + "}\n", ""),
            ("ends of two letters", "t.csv", HEAD.strip() + "\\n" + "\\n".join([LINE.strip()] * 1000), ""),
            ("long names", "t.csv", "x" * 20_000 + "," + "y" * 20_000 + "\n1,2\n", ""),
            ("no header", "t.csv", 30 * "0.5,1,2,3.143\n", "its first line is a row"),
            ("many cells", "t.csv", LONG, "row 32"),
            ("many cells in gzip", "t.csv.gz", gzip.compress(LONG.encode(), 1), "row 32"),
            ("many letters", "t.csv.gz", endless, "row 2"),
            ("many letters in JSON", "t.jsonl.gz", endless, "row 2"),
        )
    ],
)
def test_files_that_are_no_tables_or_have_too_much_in_a_line_are_refused(tmp_path, name, content, said):
    content = content() if callable(content) else content
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(errors.ImportTableError, match=one_line(name, said)) as caught:
        import_recording(tmp_path / name, tmp_path / "o.uwb")
    assert len(str(caught.value)) < 3000
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_table_of_unknown_columns_is_guessed_with_a_line_that_names_them(tmp_path):
    (tmp_path / "t.csv").write_text("colour,shape\nred,round\nblue,square\n")
    assert "SELECT" not in processes.refuse("uwblink", "import", "guess", tmp_path / "t.csv", naming=["colour, shape"])


class StrangeError(Exception):
    """An error class that only a plug-in has."""


# The form of a table is that of its first 64 KiB.
@pytest.mark.parametrize(
    ("encoding", "time", "rows"), [("latin-1", "Zeit", 3), ("latin-1", "Zeit", 3000), ("utf-8", "🕒 Zeit", 3)]
)
def test_a_table_keeps_the_letters_of_columns_and_devices(tmp_path, encoding, time, rows):
    table = f"{time} [s];Sender;Empfänger;Entfernung [m];Pegel [dBm]\n" + "0,5;Gerät 1;Straße;3,25;-81,5\n" * rows
    (tmp_path / "r.csv").write_text(table, encoding)
    guessed = guess_map(tmp_path / "r.csv")
    (tmp_path / "map.toml").write_text(guessed.text)
    import_recording(tmp_path / "r.csv", tmp_path / "r.uwb", map_file=tmp_path / "map.toml")
    with Recording.open(tmp_path / "r.uwb") as recording:
        assert not guessed.asked
        assert {tag.body for tag in recording.tags()} == {"Gerät 1", "Straße"}
        assert recording.exchanges().fpp2_dbm.tolist() == [-81.5] * rows
        assert recording.show().protocols == {"unknown": rows}


def fails(*_):
    raise StrangeError("no such\nflux")


def test_a_plug_in_that_fails_is_one_line_with_its_name(tmp_path):
    (tmp_path / "a.flux").touch()
    import_recording(write(tmp_path / "t.csv", wrapped(flights())), tmp_path / "t.uwb")
    with registered(IMPORTERS, Importer("flux", (".flux",), fails, "Import flux.")):
        for work in (partial(import_recording, output=tmp_path / "o.uwb"), read_source):
            with pytest.raises(errors.ImportTableError, match=r"'flux'.*StrangeError: no such flux") as caught:
                work(tmp_path / "a.flux")
            assert isinstance(caught.value.__cause__, StrangeError)
    said = pytest.raises(errors.RecordingError, match=r"'flux'.*StrangeError")
    with registered(EXPORTERS, Exporter("flux", fails, "flux")), said:
        export_recording(tmp_path / "t.uwb", tmp_path / "out", to="flux")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.flux", "t.csv", "t.uwb"]


def test_errors_name_the_given_file(tmp_path):
    def tables(_sources, _map, folder):
        (folder / "flux.csv").write_text(HEAD)
        return [folder / "flux.csv"], ColumnMap()

    (tmp_path / "a.flux").touch()
    said = pytest.raises(errors.ImportTableError, match=rf"^{tmp_path}/a.flux: has a header but no rows$")
    with registered(IMPORTERS, Importer("flux", (".flux",), None, "Import flux.", tables=tables)), said:
        import_recording(tmp_path / "a.flux", tmp_path / "o.uwb")


def test_an_interrupted_import_of_a_hard_table_leaves_no_file(tmp_path):
    """Ctrl-C at any time: a file with the name is complete, and there are no other files."""
    source = write(tmp_path / "t.csv", wrapped(flights(300)))
    stages = []
    import_file(source, tmp_path / "o.uwb", watch=lambda what, _: stages.append(what))
    before = (tmp_path / "o.uwb").read_bytes()
    assert "writing" in stages
    for last in range(len(stages)):
        left = iter(range(last))

        def interrupted(*_, left=left):
            if next(left, None) is None:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            import_file(source, tmp_path / "o.uwb", force=True, watch=interrupted)
        assert sorted(p.name for p in tmp_path.iterdir()) == ["o.uwb", "t.csv"]
        assert (tmp_path / "o.uwb").read_bytes() == before


# A table is read as a whole or a few rows at a time, with constant memory.


def told(contents):
    columns = [contents.exchanges.to_dict(), contents.poses.to_dict(), contents.powers]
    listed = [{name: np.asarray(column).tolist() for name, column in part.items()} for part in columns]
    return json.dumps([listed, contents.meta, list(map(str, contents.tags + contents.faults))], default=str)


def lines_of(layout):
    """Return exchanges as rows in random order, some lost and some unusable."""
    plain = wrapped(flights(80))
    parts = [dict.fromkeys(names, "") for names in (("rx1", "tx2", "tx3"), ("tx1", "rx2", "rx3"))]
    lines = {
        "messages": as_messages(plain),
        "stamps": [
            {n: v for n, v in line.items() if n not in ("tx", "rx")} | {"event": kind, "stamp": line[kind]}
            for line in as_messages(plain)
            for kind in ("tx", "rx")
        ],
        "parts": [
            {n: row[n] for n in HEADER[:9]} | {"seq": k} | empty for empty in parts for k, row in enumerate(plain)
        ],
    }[layout]
    np.random.default_rng(2).shuffle(lines)
    del lines[5]
    lines[8] = lines[8] | {"from_id": "?"}
    return lines


@pytest.mark.parametrize("layout", ["messages", pytest.param("stamps", marks=pytest.mark.slow), "parts"])
def test_a_long_table_is_the_same_a_few_rows_at_a_time(tmp_path, monkeypatch, layout):
    table = write(tmp_path / "t.csv", lines_of(layout))
    text = mapped(tmp_path, f'layout = "{layout}"\nwithin_s = 0.1\n[columns]\nsequence = "seq"\n')
    whole = read_table(table, text)
    assert 70 < len(whole.exchanges) < 80
    monkeypatch.setattr(staging, "ROWS_PER_BLOCK", 50)
    monkeypatch.setattr(staging, "FAULTS_AT_ONCE", 5)
    said = []
    done = import_file(table, tmp_path / "t.uwb", map_file=text, watch=lambda *one: said.append(one))
    assert (told(load(tmp_path / "t.uwb")), done.counts) == (told(whole), whole.counts())
    assert list(dict.fromkeys(what for what, _ in said)) == ["reading", "sorting", "grouping", "checking", "writing"]
    assert all(0 <= share <= 1 for _, share in said)


@pytest.mark.parametrize("layout", ["messages", "stamps", "parts"])
def test_a_table_without_any_device_is_refused_with_that_reason(tmp_path, layout):
    lines = [line | {"from_id": "", "message": 1} for line in lines_of(layout)]
    with pytest.raises(errors.ImportTableError, match="row 2, column 'from_id'"):
        read_rows(tmp_path, lines, f'layout = "{layout}"\n[columns]\nsequence = "seq"\n')


class Bag:
    """Messages as from a bag, one at a time."""

    kinds: ClassVar = {"/uwb": "uwb"}

    def __init__(self, path, rows):
        self.path, self.rows = path, rows

    def messages(self, _):
        for k, whole in enumerate(self.rows):
            (row,) = wrapped([whole])
            yield "/uwb", "uwb", 1_000_000 * k, {n: v for n, v in row.items() if n != "time_s"}


@pytest.mark.parametrize(
    ("form", "at_once", "grown"),
    [
        ("exchanges", 500, 108_000),
        pytest.param("messages", 2_000, 144_000, marks=pytest.mark.slow),
        pytest.param("bag", 500, 450_000, marks=pytest.mark.slow),
    ],
)
def test_memory_does_not_grow_with_what_is_read(tmp_path, monkeypatch, form, at_once, grown):
    """A column of 8 bytes per row that stays in memory, or the exchanges of a bag, would exceed the bound."""
    monkeypatch.setattr(staging, "ROWS_PER_BLOCK", at_once)
    text = mapped(tmp_path, 'within_s = 0.1\n[columns]\nsequence = "seq"\n') if form == "messages" else None
    few, many = {"exchanges": (75, 300), "messages": (40, 140), "bag": (42, 92)}[form]
    peaks = []
    for times in (10, few, many):  # the first one includes objects that are created once
        # The same exchanges many times, with all clocks later each time, so that no stamps are equal.
        rows = [later(row, k) | {"time_s": row["time_s"] + 100 * k} for k in range(times) for row in flights()]
        path = tmp_path / (f"{times}.mcap" if form == "bag" else f"{times}.csv")
        path.touch()
        monkeypatch.setattr(bags, "open_bag", lambda path, rows=rows: nullcontext(Bag(path, rows)))
        if form != "bag":
            write(path, as_messages(wrapped(rows)) if form == "messages" else wrapped(rows))
        tracemalloc.start()
        import_file(path, tmp_path / f"{times}.uwb", map_file=text)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[2] - peaks[1] < 0.7 * grown


# A registered importer: from Python and from the command line, and errors.


def read_blanks(source, map_file):
    rows = [[int(cell) for cell in line.split()] for line in source.read_text().splitlines()]
    if any(len(row) != 6 for row in rows):
        raise errors.ImportTableError(f"{source}: expected six numbers a line")
    one, other, tx1, rx1, tx2, rx2 = np.array(rows).T
    more = {"map": map_file.read_text()} if map_file else {}
    return Contents(exchanges=Exchanges.from_arrays(one, other, tx1=tx1, rx1=rx1, tx2=tx2, rx2=rx2), meta=more)


BLANKS = Importer("blanks", (".ranges", ".ranges.txt"), read_blanks, "Import six numbers a line.", "What they mean.")


@pytest.fixture
def source(tmp_path):
    (tmp_path / "my.Ranges").write_text("1 2 0 5 1005 3000\n2 3 9 3 1003 3009\n")
    with registered(IMPORTERS, BLANKS):
        yield tmp_path / "my.Ranges"


def test_registered_importers_are_found_by_suffix_and_name(source, tmp_path):
    assert import_recording(source, tmp_path / "a.uwb") == 2
    (tmp_path / "note.txt").write_text("ticks")
    assert import_recording(source, tmp_path / "b.uwb", importer="blanks", map_file=tmp_path / "note.txt") == 2
    assert load(tmp_path / "b.uwb").meta["map"] == "ticks"
    np.testing.assert_allclose(load(tmp_path / "a.uwb").exchanges.range_m, 4.690357, rtol=1e-6)


def test_the_longest_ending_decides(tmp_path):
    (tmp_path / "my.blanks.csv").write_text("1 2 0 5 1005 3000\n")
    with registered(IMPORTERS, replace(BLANKS, suffixes=(".blanks.csv",))):
        assert import_recording(tmp_path / "my.blanks.csv", tmp_path / "a.uwb") == 1


def test_without_a_map_there_is_no_option_for_one(tmp_path):
    with registered(IMPORTERS, replace(BLANKS, name="plain", map_help=None)):
        assert "--map" not in processes.succeed("uwblink", "import", "plain", "--help").stdout
        with pytest.raises(errors.ArgumentError, match="`map_file`: importer 'plain' uses none"):
            import_recording(tmp_path / "x.ranges", tmp_path / "x.uwb", importer="plain", map_file=tmp_path / "m")


def test_files_that_cannot_be_imported_are_named(source, tmp_path):
    with pytest.raises(
        errors.ImportTableError,
        match=r"t\.xls: no importer for this kind of file; the known ones are \.csv, \.csv\.gz, .*\.ranges",
    ):
        import_recording(tmp_path / "t.xls", tmp_path / "x.uwb")
    with pytest.raises(errors.ArgumentError, match="importer: found 'xls', allowed: csv"):
        import_recording(source, tmp_path / "x.uwb", importer="xls")
    (tmp_path / "old.uwb").write_text("")
    with pytest.raises(errors.RecordingExistsError):
        import_recording(source, tmp_path / "old.uwb")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"name": "a b"}, "name: found 'a b', expected a word"),
        ({"name": "csv"}, "importer 'csv': this name is reserved"),
        ({"suffixes": ".csv"}, "suffixes: found '.csv', expected a tuple"),
        ({"suffixes": ("csv",)}, "suffixes: found .*, expected a tuple"),
        ({"read": None}, "read: found None, expected a function"),
        ({"help": ""}, "help: found '', expected a line of text"),
        ({"map_help": 3}, "map_help: found 3, expected a line of text"),
    ],
)
def test_wrong_importers_are_refused(change, expected):
    with pytest.raises(errors.ArgumentError, match=expected):
        register_importer(replace(BLANKS, **change))


def test_a_reader_must_return_contents(tmp_path):
    broken = replace(BLANKS, name="broken", read=lambda *_: [1, 2])  # type: ignore[arg-type]
    said = pytest.raises(errors.ArgumentError, match=r"importer 'broken': returned \[1, 2\], expected Contents")
    with registered(IMPORTERS, broken), said:
        import_recording(tmp_path / "x.ranges", tmp_path / "x.uwb")
