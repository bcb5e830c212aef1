"""A registered importer: from Python and from the command line, and errors."""

from dataclasses import replace

import numpy as np
import pytest

from tests.processes import succeed
from tests.registered import registered
from uwblink import Contents, Exchanges, import_recording, load, register_importer
from uwblink.errors import ArgumentError, ImportTableError, RecordingExistsError
from uwblink.importers import IMPORTERS, Importer


def read_blanks(source, map_file):
    rows = [[int(cell) for cell in line.split()] for line in source.read_text().splitlines()]
    if any(len(row) != 6 for row in rows):
        raise ImportTableError(f"{source}: expected six numbers a line")
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
        assert "--map" not in succeed("uwblink", "import", "plain", "--help").stdout
        with pytest.raises(ArgumentError, match="`map_file`: importer 'plain' uses none"):
            import_recording(tmp_path / "x.ranges", tmp_path / "x.uwb", importer="plain", map_file=tmp_path / "m")


def test_files_that_cannot_be_imported_are_named(source, tmp_path):
    with pytest.raises(
        ImportTableError,
        match=r"t\.xls: no importer for this kind of file; the known ones are \.csv, \.csv\.gz, .*\.ranges",
    ):
        import_recording(tmp_path / "t.xls", tmp_path / "x.uwb")
    with pytest.raises(ArgumentError, match="importer: found 'xls', allowed: csv"):
        import_recording(source, tmp_path / "x.uwb", importer="xls")
    (tmp_path / "old.uwb").write_text("")
    with pytest.raises(RecordingExistsError):
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
    with pytest.raises(ArgumentError, match=expected):
        register_importer(replace(BLANKS, **change))


def test_a_reader_must_return_contents(tmp_path):
    broken = replace(BLANKS, name="broken", read=lambda *_: [1, 2])  # type: ignore[arg-type]
    said = pytest.raises(ArgumentError, match=r"importer 'broken': returned \[1, 2\], expected Contents")
    with registered(IMPORTERS, broken), said:
        import_recording(tmp_path / "x.ranges", tmp_path / "x.uwb")
