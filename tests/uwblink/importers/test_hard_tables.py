"""Tables, maps and plug-ins that go wrong: one line, soon, and nothing left behind."""

import gzip
import subprocess
import sys
from functools import partial

import pytest

from tests import processes
from tests.uwblink.importers.test_table_forms import flights, wrapped, write
from uwblink.errors import ImportTableError, RecordingError
from uwblink.exporters import EXPORTERS, Exporter, export_recording, register_exporter
from uwblink.importers import IMPORTERS, Importer, import_file, import_recording, read_source, register_importer

LINE = "0.5,1,2,3.25\n"
HEAD = "time_s,from_id,to_id,range_m\n"


def refused(path):
    """Import a table, which must not work; returns the line that says why."""
    with pytest.raises(ImportTableError) as caught:
        import_recording(path, path.parent / "o.uwb")
    said = str(caught.value)
    assert (said.count("\n"), path.name in said, len(said) < 3000) == (0, True, True)
    assert [p for p in path.parent.iterdir() if "o.uwb" in p.name] == []
    return said


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz"])
def test_a_line_of_very_many_cells_is_named_with_its_row(tmp_path, suffix):
    path = tmp_path / f"t{suffix}"
    text = (HEAD + 30 * LINE + ",".join(["1"] * 200_000) + "\n" + 30 * LINE).encode()
    path.write_bytes(gzip.compress(text) if suffix.endswith("gz") else text)
    assert "row 32" in refused(path)


def test_a_line_of_very_many_letters_is_named_with_its_row(tmp_path):
    for name in ("t.csv.gz", "t.jsonl.gz"):
        with gzip.open(tmp_path / name, "wb", compresslevel=1) as file:
            file.write(HEAD.encode())
            for _ in range(40):
                file.write(b"x" * 1_000_000)
        assert "row 2" in refused(tmp_path / name)


def test_a_map_of_a_line_without_an_end_is_refused_soon(tmp_path):
    (tmp_path / "t.csv").write_text(HEAD + 5_000_000 * "1", encoding="utf-8")
    # The patterns of logs were searched from each letter to the end of the line, which took minutes.
    processes.refuse("uwblink", "import", "guess", tmp_path / "t.csv", naming=["t.csv: row 2"], timeout=90)


def test_a_long_line_takes_no_memory(tmp_path):
    """Half a gigabyte in one line, of which no more than a few lines' worth is ever read."""
    with gzip.open(tmp_path / "t.csv.gz", "wb", compresslevel=1) as file:
        file.write(HEAD.encode())
        for _ in range(512):
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


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("t.csv", ",".join(NAMES) + "\n" + ",".join(["1"] * 5000) + "\n"),
        ("t.jsonl", "{" + ", ".join(f'"{name}": 1' for name in NAMES) + "}\n"),
        ("t.csv", HEAD.strip() + "\\n" + "\\n".join([LINE.strip()] * 1000)),
        ("t.csv", "x" * 20_000 + "," + "y" * 20_000 + "\n1,2\n"),
    ],
    ids=["columns", "fields", "ends of two letters", "long names"],
)
def test_columns_beyond_number_and_lines_without_end(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    refused(tmp_path / name)


def test_a_table_of_unknown_columns_is_guessed_with_a_line_that_names_them(tmp_path):
    (tmp_path / "t.csv").write_text("colour,shape\nred,round\nblue,square\n")
    done = processes.run("uwblink", "import", "guess", tmp_path / "t.csv")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "colour, shape" in done.stderr
    assert "SELECT" not in done.stderr


class StrangeError(Exception):
    """An error that only a plug-in knows."""


def fails(*_):
    raise StrangeError("no such\nflux")


def test_a_plug_in_that_fails_is_one_line_with_its_name(tmp_path):
    (tmp_path / "a.flux").touch()
    register_importer(Importer("flux", (".flux",), fails, "Import flux."))
    try:
        for work in (partial(import_recording, output=tmp_path / "o.uwb"), read_source):
            with pytest.raises(ImportTableError, match=r"'flux'.*StrangeError: no such flux") as caught:
                work(tmp_path / "a.flux")
            assert isinstance(caught.value.__cause__, StrangeError)
    finally:
        IMPORTERS.remove("flux")
    register_exporter(Exporter("flux", fails, "flux"))
    source = write(tmp_path / "t.csv", wrapped(flights()))
    import_recording(source, tmp_path / "t.uwb")
    try:
        with pytest.raises(RecordingError, match=r"'flux'.*StrangeError"):
            export_recording(tmp_path / "t.uwb", tmp_path / "out", to="flux")
    finally:
        EXPORTERS.remove("flux")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.flux", "t.csv", "t.uwb"]


def test_an_interrupted_import_leaves_nothing(tmp_path):
    """Ctrl-C at any time of it: what is there under the name is whole, and nothing stands beside it."""
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
