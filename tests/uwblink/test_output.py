"""Output files: complete or absent, also after Ctrl-C."""

import json
import os
import signal
import subprocess
import tempfile
import threading
import time

import pytest

import calib
import uwblink
from tests import processes
from tests.boards import served
from tests.errors import one_line
from uwblink.errors import ArgumentError, ImportTableError, OutputError
from uwblink.output import check_apart, write_bytes, write_files, write_text
from uwblink.text_files import read_text


def test_text_is_utf8_and_read_as_it_was_written_and_no_temporary_file_remains(tmp_path):
    write_text(tmp_path / "a.txt", "± 1 µs\n", force=False)
    assert (tmp_path / "a.txt").read_bytes() == "± 1 µs\n".encode()
    assert read_text(tmp_path / "a.txt", ValueError) == "± 1 µs\n"
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_no_output_is_written_over_another_or_over_what_is_read(tmp_path):
    a, b = tmp_path / "a", tmp_path / "b"
    check_apart({"output": a, "pdf": b, "figures": None}, [tmp_path / "c"])
    for outputs, sources, said in (
        ({"output": a, "pdf": tmp_path / "x" / ".." / "a"}, [], "`pdf`: .*a: is also the output of `output`"),
        ({"output": a}, [b, a], "`output`: .*a: is also an input"),
    ):
        with pytest.raises(ArgumentError, match=said):
            check_apart(outputs, sources)


def test_several_files_are_all_there_or_none_and_no_folder_is_left(tmp_path, monkeypatch):
    plain, folder = type(tmp_path).write_bytes, tmp_path / "deep" / "er"

    def full(self, data):
        if b"third" in data:
            raise OSError(28, "No space left on device")
        return plain(self, data)

    monkeypatch.setattr(type(tmp_path), "write_bytes", full)
    with pytest.raises(OutputError, match=r"c: cannot be written \(No space left on device\)$"):
        write_files(folder, {"a": b"first", "b": b"second", "c": b"third"}, force=False)
    assert list(tmp_path.iterdir()) == []
    write_files(folder, {"a": b"first", "b": b"second"}, force=False)
    with pytest.raises(OutputError, match="c: cannot be written"):
        write_files(folder, {"a": b"other", "c": b"third"}, force=True)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == {"a": b"first", "b": b"second"}


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OutputError, match=r"er: cannot be made \(Not a directory\)"):
        write_files(tmp_path / "file" / "er", {"a": b""}, force=False)


# Files that cannot be read as text: one line each, as the caller's error.


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("nowhere", "no such map"),
        ("folder", "is a directory, expected a map"),
        ("latin1", "not a text file in UTF-8"),
        ("nowhere\0", "no path of a map"),
        ("n" * 300, "(File name too long)"),
    ],
)
def test_unreadable_text_files_are_one_line(tmp_path, name, line):
    (tmp_path / "folder").mkdir()
    (tmp_path / "latin1").write_bytes("abcé".encode("latin-1"))
    with pytest.raises(ImportTableError, match=one_line(line)) as found:
        read_text(str(tmp_path / name), ImportTableError, "map")
    assert "\0" not in str(found.value)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_that_another_thread_receives_as_a_file_begins_leaves_nothing(tmp_path, monkeypatch, number):
    """Python handles it in the main thread, where it must not come between making a folder and its removal."""

    def leave(*_):
        raise KeyboardInterrupt

    def made_and_then(*arguments):
        folder = plain(*arguments)
        signal.pthread_kill(other.ident or 0, number)
        time.sleep(0.05)
        return folder

    plain, done = tempfile.mkdtemp, threading.Event()
    other = threading.Thread(target=done.wait)
    other.start()
    monkeypatch.setattr(tempfile, "mkdtemp", made_and_then)
    before = signal.signal(number, leave)
    try:
        with pytest.raises(KeyboardInterrupt):
            write_bytes(tmp_path / "a", b"first", force=False)
        assert signal.getsignal(number) is leave
        assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == set()
    finally:
        signal.signal(number, before)
        done.set()
        other.join()
    assert list(tmp_path.iterdir()) == []


# Ctrl-C: a summary, the right exit status, a closed file, no traceback.


def ended(process, number=signal.SIGINT):
    process.send_signal(number)
    try:
        out, err = process.communicate(timeout=60)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGABRT)  # it prints in its own folder
        raise AssertionError(process.communicate()) from None
    assert "Traceback" not in err, err
    return out, err


def test_twr_prints_each_line_when_it_comes_and_a_summary_at_the_end():
    with served() as server:
        words = [str(processes.BIN / "uwblink"), "twr", server.names[1], "2", "-n", "1000000", "--json"]
        environment = os.environ | {"PYTHONFAULTHANDLER": "1"}
        process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
        # A buffer would keep lines that came with the first one from what is read at the end.
        begun = os.read(process.stdout.fileno(), 65_536).decode()
        assert process.poll() is None, "the line came while it goes on"
        out, _ = ended(process)
    *rows, last = [json.loads(line) for line in (begun + out).splitlines()]
    assert process.returncode == 130
    assert {(row["initiator"], row["target"]) for row in rows} == {(1, 2)}
    assert last["summary"]["exchanges"] == len(rows) < 1_000_000
    assert last["summary"]["mean_m"] == pytest.approx(3.0, abs=0.5)


def test_twr_that_is_not_interrupted_has_status_0_and_a_summary():
    with served() as server:
        said = processes.succeed("uwblink", "twr", server.names[1], "2", "-n", "5", "--json").stdout
    rows = [json.loads(line) for line in said.splitlines()]
    assert [set(row) == {"summary"} for row in rows] == [False] * 5 + [True]
    assert rows[-1]["summary"]["exchanges"] == 5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "words"),
    [
        (signal.SIGTERM, ("uwbsim", "run", "icra2023/test1", "-o", "f.uwb", "--set", "run.duration_s=100")),
        (signal.SIGINT, ("uwblink", "export", "../long.uwb", "--to", "csv", "-o", "f")),
        (signal.SIGINT, ("uwblink", "import", "csv", "../long.csv", "-o", "f.uwb")),
        (signal.SIGTERM, ("calib", "apply", "../long.uwb", "-c", "../c.json", "-o", "f.uwb")),
    ],
)
def test_a_terminated_writer_leaves_no_file(long, tmp_path, words, number):
    """Interrupted when the first file appears in its folder."""
    folder = long.parent / f"{tmp_path.name}"
    folder.mkdir()
    process = subprocess.Popen(
        [str(processes.BIN / words[0]), *words[1:]],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    processes.wait_until(lambda: any(folder.iterdir()), process, step_s=0.002)
    _, err = ended(process, number)
    assert ((process.returncode, err), list(folder.iterdir())) == ((130, "interrupted\n"), [])


@pytest.fixture(scope="module")
def long(tmp_path_factory):
    """A recording and a table that take a second to write, and a calibration of their tags."""
    folder = tmp_path_factory.mktemp("long")
    flight = calib.sample_flight(300_000)
    uwblink.Contents(exchanges=flight.exchanges, poses=flight.poses, tags=flight.tags).save(folder / "long.uwb")
    calib.fit(calib.sample_flight(2000)).calibration.save(folder / "c.json")
    rows = (f"{k}.25,{k % 5},9,{3.25 + k % 7:.3f},-80.5,-81.5\n" for k in range(600_000))
    (folder / "long.csv").write_text("time_s,from_id,to_id,range_m,fpp1,fpp2\n" + "".join(rows))
    return folder / "long.uwb"
