"""Writing files completely or not at all."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import current_thread, main_thread
from typing import Final, TextIO

from uwblink.errors import ArgumentError, OutputError, RecordingError, RecordingExistsError, raising

__all__ = [
    "check_apart",
    "check_ending",
    "check_folder",
    "check_output",
    "interrupts_held",
    "made_folder",
    "new_file",
    "whole",
    "write_bytes",
    "write_files",
    "write_text",
]

_INTERRUPTS: Final = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Delay SIGINT and SIGTERM until the end of the block, also in processes that are started in it.

    The system can give a signal to any thread that does not block it, such as those of DuckDB, and Python handles it
    in the main thread all the same. So the handlers are replaced, too; only the main thread can do that.
    """
    came: list[int] = []
    handlers = {} if current_thread() is not main_thread() else {int(one): signal.getsignal(one) for one in _INTERRUPTS}
    for number in handlers:
        signal.signal(number, lambda number, _: came.append(number))
    masks = hasattr(signal, "pthread_sigmask")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _INTERRUPTS) if masks else set()
    try:
        yield
    finally:
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for number, handler in handlers.items():
            signal.signal(number, handler or signal.SIG_DFL)
        for number in came:
            signal.raise_signal(number)


def write_text(path: Path, text: str, *, force: bool) -> None:
    """Write a text file as UTF-8, with escapes for file names in other encodings; raises what `write_bytes` raises."""
    write_bytes(path, text.encode(errors="backslashreplace"), force=force)


def check_utf8(path: Path, error: Callable[[str], Exception]) -> None:
    """Raise `error` if the absolute path of a file is not UTF-8, as DuckDB requires."""
    text = str(path.absolute())
    if text.encode(errors="replace").decode() != text:
        raise error(f"{path}: its name and those of its folders must be UTF-8; give another one")


def write_bytes(path: Path, data: bytes, *, force: bool) -> None:
    """Write a file; raises what `whole` raises."""
    with whole(path, force=force) as partial:
        partial.write_bytes(data)


@contextmanager
def whole(path: Path, *, force: bool) -> Iterator[Path]:
    """Yield a temporary path for a new file or folder, which is renamed to `path` at the end of the block.

    If the block fails or is interrupted, `path` stays as it was. Raises what `check_output` raises, and `OutputError`
    if the file cannot be written.
    """
    check_output(path, force=force)
    with raising(OutputError, f"{path}: cannot be written"), place_beside(path) as partial:
        yield partial
        take_name(partial, path)


@contextmanager
def place_beside(path: Path) -> Iterator[Path]:
    """Yield a temporary path for `path` in a new folder beside it, which is removed after the block with its contents.

    The folder has a random name and private permissions, so that other users cannot place links in it.
    """
    prefix = f".{path.name}."
    # File systems take names of 255 bytes, of which `tempfile` draws eight, and nine are ".partial".
    if len(os.fsencode(prefix)) > 255 - 8 - 9:
        prefix = "."
    with ExitStack() as place:
        with interrupts_held():  # an interrupt between creating and storing it would leave the folder
            made = TemporaryDirectory(".partial", prefix, path.absolute().parent, ignore_cleanup_errors=True)
            # A thread of DuckDB may make a file in it while it is being removed.
            place.callback(shutil.rmtree, made.name, ignore_errors=True)
            place.enter_context(made)
        yield Path(made.name) / path.name


def take_name(partial: Path, path: Path) -> None:
    """Rename a new file or folder to `path`; a folder of that name is replaced.

    Raises `RecordingError` if that folder has files that the new one does not have.
    """
    if path.is_dir() and not path.is_symlink():
        for place in path.rglob("*"):
            kept = place.relative_to(path)
            if not os.path.lexists(partial / kept):
                raise RecordingError(f"{path}: contains {kept}, which would be lost; give another name or remove it")
        path.replace(partial.with_name(".before"))
    partial.replace(path)


def new_file(path: Path) -> TextIO:
    """Create or replace a text file that is written under its own name; links are not followed.

    What is written between two flushes, up to a megabyte, reaches the file at once. Raises `OutputError`, and what
    `check_output` raises.
    """
    check_output(path, force=True)
    with raising(OutputError, f"{path}: cannot be written"):
        path.unlink(missing_ok=True)
        return path.open("x", 2**20, encoding="utf-8", newline="\n")


@contextmanager
def made_folder(folder: Path) -> Iterator[None]:
    """Create a folder and missing parents; if the block fails, the new folders are removed again if they are empty.

    Raises `OutputError` if a folder cannot be created or has the suffix of recordings.
    """
    check_ending(folder)
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        with raising(OutputError, f"{folder}: cannot be made"):
            folder.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        for place in missing:
            with suppress(OSError):
                place.rmdir()
        raise


def write_files(folder: Path, files: Mapping[str, bytes], *, force: bool) -> None:
    """Write files by name into a folder, which is created if necessary: all of them, or none.

    Raises what `whole` and `made_folder` raise.
    """
    with made_folder(folder), ExitStack() as every:
        for name, data in files.items():
            every.enter_context(whole(folder / name, force=force)).write_bytes(data)


def check_apart(outputs: Mapping[str, Path | None], inputs: Iterable[Path] = ()) -> None:
    """Raise `ArgumentError` if an output is the same file as another output or as an input.

    `outputs` are files and folders by the parameter that names them.
    """
    taken = {path.resolve(): "is also an input" for path in inputs}
    for name, path in outputs.items():
        if path is not None:
            place = path.resolve()
            if place in taken:
                raise ArgumentError(f"{path}: {taken[place]}; give another name", parameter=name)
            taken[place] = f"is also the output of `{name}`"


def check_output(path: Path, *, force: bool, recording: bool = False) -> None:
    """Raise an error if `path` cannot be written; writes nothing.

    A `recording` must not have the suffix of another format, and other outputs not that of a recording.
    """
    if not recording:
        check_ending(path)
    is_other = path.suffix.lower() in (
        ".csv", ".tsv", ".txt", ".gz", ".parquet", ".json", ".jsonl", ".ndjson", ".bag", ".mcap", ".db3", ".toml",
        ".html", ".pdf",
    )  # fmt: skip
    rules = (
        (
            recording and is_other,
            RecordingError,
            f"the output is a recording, but {path.suffix} is the ending of another kind of file; name it "
            f"{path.stem}.uwb (`uwblink export` writes tables)",
        ),
        (path.is_dir(), RecordingError, "is a directory, expected the name of an output file"),
        (
            path.exists() and not path.is_file(),
            RecordingError,
            "is a FIFO, socket or device, expected the name of an output file",
        ),
        (
            path.exists() and not force,
            RecordingExistsError,
            "already exists; give another name, or replace it with `force`",
        ),
        (not path.parent.is_dir(), RecordingError, f"the folder {path.parent} does not exist; create it first"),
        (not os.access(path.parent, os.W_OK), RecordingError, f"no permission to write in {path.parent}"),
    )
    for broken, error, why in rules:
        if broken:
            raise error(f"{path}: {why}")


def check_ending(path: Path) -> None:
    """Raise `OutputError` if an output that is not a recording has the suffix of recordings."""
    if path.suffix.lower() == ".uwb":
        raise OutputError(
            f"{path}: .uwb is the ending of recordings, but this output is not a recording; give another name"
        )


def check_folder(path: Path, names: Iterable[str] = (), *, force: bool = False) -> None:
    """Raise `OutputError` if a folder can be neither used nor created.

    `names` are files to be written there; raises what `check_output` raises for them.
    """
    if path.exists() and not path.is_dir():
        raise OutputError(f"{path}: is a file, expected a folder")
    check_ending(path)
    if not path.parent.is_dir():
        raise OutputError(f"{path}: {path.parent} does not exist")
    for name in names if path.is_dir() else ():
        check_output(path / name, force=force)
