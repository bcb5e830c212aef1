"""The recording: one DuckDB file (`.uwb`), which simulator, recorder and importers write.

Column meanings are those of `uwblink.twr.Exchanges`; the tables are listed in docs/architecture.md.

Only one process can open a DuckDB file for writing, and no other can open it meanwhile. The writer appends what it
commits to a log beside the file. A reader of a recording in use copies the two and opens the copy, whose names it
removes at once.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from uwblink.database import log_of
from uwblink.errors import RecordingError, RecordingInUseError, RecordingMissingError, raising
from uwblink.output import check_output, place_beside
from uwblink.recording.schema import FORMAT_VERSION, SUFFIX, TABLES, standard_meta
from uwblink.recording.store import is_locked
from uwblink.recording.summary import Summary, summarize
from uwblink.recording.tables import Tables, known_tables
from uwblink.text_files import require_regular


class Recording(Tables):
    """An open recording. Use `create` to write and `open` to read; both are context managers.

    >>> import pathlib, tempfile
    >>> from uwblink import Exchanges, Recording, Tag
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "mine.uwb"
    >>> with Recording.create(path, meta={"place": "roof"}) as recording:
    ...     recording.append_tags([Tag(1, "mast", (0.0, 0.0, 2.0)), Tag(2, "drone", (0.1, 0.0, 0.0))])
    ...     recording.append_exchanges(Exchanges.from_arrays([1], [2], tx1=[0], rx1=[5], tx2=[1005], rx2=[3000]))
    >>> with Recording.open(path) as recording:
    ...     print(recording.show())
    mine.uwb: 1 exchanges in 0.0 s, protocols ss 1
      tags: 1 on mast, 2 on drone
      poses: none
      faults: none
          1 -> 2             1 exchanges
    """

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        *,
        meta: Mapping[str, Any] | None = None,
        force: bool = False,
        live: bool = False,
        memory_mb: int | None = None,
    ) -> Self:
        """Start a recording beside `path`; it takes that name at the end of the `with` block without an error.

        A `live` recording has its name from the start, and keeps all appended rows after an error; otherwise nothing
        remains. At most `memory_mb` of the written data is kept in memory. Raises `RecordingExistsError` if `path`
        exists and not `force`, and `RecordingError` if it cannot be written.
        """
        final = Path(path)
        check_output(final, force=force, recording=True)
        if final.exists() and is_locked(final, update=False):
            raise RecordingInUseError(f"{final}: another process is writing it; give another name")
        with raising(RecordingError, f"{final}: cannot be written"):
            with ExitStack() as place:
                recording = cls._open_to_write(final, place.enter_context(place_beside(final)), memory_mb)
                # A recording that is written again has all of it.
                given = dict(meta or {})
                recording.append_meta(given if "format_version" in given else standard_meta() | given)
                if not live:
                    recording._place = place.pop_all()
                    return recording
                # So that the tables are in the file itself, and only rows ever in the log beside it.
                recording._complete()
            return cls._open_to_write(final, None, memory_mb)

    @classmethod
    def open(cls, path: str | os.PathLike[str], *, update: bool = False, memory_mb: int | None = None) -> Self:
        """Open a recording for reading, or to `update` it in place.

        At most `memory_mb` of the read data is kept in memory; sorting can take more.

        A recording in progress is opened as a copy of everything until now. Raises `RecordingMissingError` or
        `RecordingError` (a directory, not a recording, truncated, tables or columns missing, a newer format, in use).
        """
        source = Path(path)
        if not source.exists():
            raise RecordingMissingError(f"{source}: no such recording")
        require_regular(source, RecordingError, f"{SUFFIX} recording")
        try:
            return cls._open_to_read(source, update=update, memory_mb=memory_mb)
        except RecordingInUseError:
            if update:
                raise
            return cls._open_copy(source, memory_mb)

    def _check_tables(self) -> None:
        """Check the version of the format, too."""
        super()._check_tables()
        version = self.meta().get("format_version")
        if not isinstance(version, int):
            raise RecordingError(f"{self.path}: not a {SUFFIX} recording (no format_version in meta)")
        if version > FORMAT_VERSION:
            raise RecordingError(
                f"{self.path}: format version {version} is newer than this uwbcal reads ({FORMAT_VERSION}); "
                "update uwbcal"
            )

    def __enter__(self) -> Self:
        """Return the recording itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close; a written file takes its name, or is removed if the block raised.

        Raises `RecordingError` if it cannot be written completely.
        """
        with self._place, closing(self._db), raising(RecordingError, f"{self.path}: cannot be written"):
            if kind is None and self._writes:
                self._complete()

    def _complete(self) -> None:
        """Write everything into the file, close it, and give it its name."""
        self.shorten_log()
        self._db.close()
        if self._partial:
            log_of(self.path).unlink(missing_ok=True)  # of the file that had the name before
            self._partial.replace(self.path)

    def show(self) -> Summary:
        """Return the summary of the recording, which has a text form."""
        return summarize(self)

    def copy(
        self,
        path: str | os.PathLike[str],
        *,
        replacing: Mapping[str, Any] | None = None,
        meta: Mapping[str, Any] | None = None,
        force: bool = False,
    ) -> None:
        """Write this recording again at `path`: every row of every table, in its order, except what is replaced.

        `replacing` maps names of `TABLES` to their new content, in the form in which it is read
        (`{"exchanges": corrected}`; an empty list for an empty table). `meta` adds entries, or replaces those
        with the same keys. Raises what `create` raises, and `RecordingError` for an unknown table.
        """
        instead = dict(replacing or {})
        entries = dict(instead.get("meta", {})) | dict(meta or {})
        with self.copying(path, without=instead, meta=entries, force=force) as written:
            for table in instead.keys() - {"meta"}:
                written.append(table, instead[table])

    @contextmanager
    def copying(
        self,
        path: str | os.PathLike[str],
        *,
        without: Collection[str],
        meta: Mapping[str, Any] | None = None,
        force: bool = False,
    ) -> Iterator[Self]:
        """Yield an incomplete copy: all tables except those in `without`, which the block appends.

        These do not need to be in memory at once. Raises what `copy` raises.
        """
        known_tables(without)
        entries = {} if "meta" in without else self.meta()
        entries |= dict(meta or {})
        # Without a limit of memory, it would be the size of the file.
        with type(self).create(path, meta=entries, force=force, memory_mb=300) as written:
            for table in TABLES:
                if table != "meta" and table not in without:
                    written._take(self, table)
            yield written

    @classmethod
    def _open_copy(cls, source: Path, memory_mb: int | None) -> Self:
        """Open a copy of a recording that another process is writing: all that it has committed.

        File and log belong together if the file did not change while both were copied. What is incomplete at the end of
        the log was not committed, and DuckDB leaves it out. Raises `RecordingInUseError` if no copy can be made.
        """
        file, why = source.resolve(), "changes faster than it can be copied"
        try:
            with place_beside(file) as copy:
                # The file changes once in hours: when its log is put into it.
                for _ in range(20):
                    before = file.stat()
                    shutil.copyfile(file, copy)
                    log_of(copy).unlink(missing_ok=True)
                    with suppress(FileNotFoundError):
                        shutil.copyfile(log_of(file), log_of(copy))
                    after = file.stat()
                    if (before.st_mtime_ns, before.st_size) == (after.st_mtime_ns, after.st_size):
                        recording = cls._open_to_read(copy, update=False, memory_mb=memory_mb)
                        recording.path = source
                        return recording
        except OSError as error:
            why = f"cannot be copied ({error.strerror})"
        raise RecordingInUseError(f"{source}: another process is writing it, and it {why}; wait until that ends")
