"""Files that are whole or not there at all."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Final

from uwblink.errors import ArgumentError, OutputError, RecordingError, RecordingExistsError, UwblinkError

__all__: Final = ["check_apart", "check_output", "made_folder", "whole", "write_bytes", "write_files", "write_text"]


def write_text(path: Path, text: str, *, force: bool) -> None:
    """Write a text file as UTF-8, names of files that are none with escapes; raises what `write_bytes` raises."""
    write_bytes(path, text.encode(errors="backslashreplace"), force=force)


def is_utf8(path: Path) -> bool:
    """Whether the whole name of a file is UTF-8, as DuckDB needs it: the system takes any bytes."""
    try:
        str(path.absolute()).encode()
    except UnicodeEncodeError:
        return False
    return True


def write_bytes(path: Path, data: bytes, *, force: bool) -> None:
    """Write a file; raises what `whole` raises."""
    with whole(path, force=force) as partial:
        partial.write_bytes(data)


@contextmanager
def whole(path: Path, *, force: bool) -> Iterator[Path]:
    """Yield the name of a hidden neighbour to write to, which takes the name of `path` when the block is done.

    Raises what `check_output` raises, and `OutputError` where the disk does not take it. Where the block fails, a file
    that was there stays, and no part of the new one does.
    """
    check_output(path, force=force)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        partial.replace(path)
    except UwblinkError:
        raise  # of this or of another file of several
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from error
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def made_folder(folder: Path) -> Iterator[None]:
    """Make a folder, and those above it, where they are missing; where the block fails, what was made goes away empty.

    Raises `OutputError` where it cannot be made.
    """
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{folder}: cannot be made ({error.strerror})") from error
        yield
    except BaseException:
        for place in missing:
            with suppress(OSError):
                place.rmdir()
        raise


def write_files(folder: Path, files: Mapping[str, bytes], *, force: bool) -> None:
    """Write files by their names into a folder, which is made where it is missing: all of them, or none.

    Raises what `whole` and `made_folder` raise.
    """
    with made_folder(folder), ExitStack() as every:
        for name, data in files.items():
            every.enter_context(whole(folder / name, force=force)).write_bytes(data)


def check_apart(outputs: Mapping[str, Path | None], inputs: Iterable[Path] = ()) -> None:
    """Raise `ArgumentError` where one output would be written over another, or over what is read.

    `outputs` are files and folders by the parameter that names them.
    """
    read = {path.resolve() for path in inputs}
    taken: dict[Path, str] = {}
    for name, path in outputs.items():
        if path is None:
            continue
        place = path.resolve()
        if place in read:
            raise ArgumentError(f"{path}: is what is read; give another name", parameter=name)
        if place in taken:
            raise ArgumentError(f"{path}: is what `{taken[place]}` names already; give another name", parameter=name)
        taken[place] = name


def check_output(path: Path, *, force: bool) -> None:
    """Raise the one clear error if `path` cannot be written to; writes nothing."""
    if path.is_dir():
        raise RecordingError(f"{path}: is a directory, expected the name of an output file")
    if path.exists() and not force:
        raise RecordingExistsError(f"{path}: exists already; give another name, or `force` to replace it")
    if not path.parent.is_dir():
        raise RecordingError(f"{path}: the folder {path.parent} does not exist; create it first")
    if not os.access(path.parent, os.W_OK):
        raise RecordingError(f"{path}: no permission to write in {path.parent}")
