"""The recording: one DuckDB file (`.uwb`) that simulator, recorder and importers write alike.

Column meanings are those of `uwblink.twr.Exchanges`; the tables are listed in
docs/architecture.md.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

from uwblink.database import log_of
from uwblink.errors import RecordingError, RecordingInUseError, RecordingMissingError
from uwblink.output import check_output, place_beside
from uwblink.recording.readers import TableReaders, known_tables
from uwblink.recording.schema import (
    FORMAT_VERSION,
    SUFFIX,
    TABLES,
    standard_meta,
)
from uwblink.recording.snapshots import open_snapshot
from uwblink.recording.soundness import is_locked
from uwblink.recording.store import Store
from uwblink.recording.writers import TableWriters
from uwblink.text_files import require_regular

if TYPE_CHECKING:
    from uwblink.recording.summary import Summary

COPYING_MB: Final = 300
"""Of a file that is written again so much is kept in memory; without a limit, all of it."""


class Recording(TableWriters, TableReaders):
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

    def __init__(self, store: Store, partial: Path | None = None) -> None:
        """Wrap an open store; `partial` is the file that takes the store's name when writing went well."""
        self._store = store
        self.path = store.path
        self._partial = partial
        self._place = ExitStack()
        """The folder of `partial`, which goes when this is closed."""

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
        """Start a recording beside `path`; it takes that name when the `with` block ends well.

        A `live` one has its name from the start, and what was appended stays whatever happens. Of what was
        written no more than `memory_mb` is kept in memory, for those who write a long one some rows at a time. Raises
        `RecordingExistsError` if `path` is there and not `force`, `RecordingError` where it cannot be written. When
        the block raises, nothing is left behind of one that is not live.
        """
        final = Path(path)
        check_output(final, force=force, recording=True)
        if final.exists() and is_locked(final, update=False):
            raise RecordingInUseError(f"{final}: another process is writing it; give another name")
        try:
            with ExitStack() as place:
                partial = place.enter_context(place_beside(final))
                recording = cls(Store.create(partial, final, memory_mb), partial)
                recording.append_meta(standard_meta() | dict(meta or {}))
                if not live:
                    recording._place = place.pop_all()
                    return recording
                # So that the tables are in the file itself, and only rows ever in the log beside it.
                recording._complete()
            return cls(Store.grow(final, memory_mb))
        except OSError as error:
            raise RecordingError(f"{final}: cannot be written ({error.strerror or error})") from error

    @classmethod
    def open(cls, path: str | os.PathLike[str], *, update: bool = False, memory_mb: int | None = None) -> Self:
        """Open a recording for reading, or to `update` it in place.

        Of what was read from the file no more than `memory_mb` is kept in memory, for those who read a long one some
        rows at a time; sorting more than that takes more.

        Of one that is being recorded a snapshot is opened, which its recorder makes: everything until now. Raises
        `RecordingMissingError` or `RecordingError` (a directory, not a recording, truncated, tables or columns missing,
        a newer format, in use by something that makes no snapshots).
        """
        source = Path(path)
        if not source.exists():
            raise RecordingMissingError(f"{source}: no such recording")
        require_regular(source, RecordingError, f"{SUFFIX} recording")
        try:
            store = Store.open(source, update=update, memory_mb=memory_mb)
        except RecordingInUseError:
            if update:
                raise
            store = open_snapshot(source, partial(Store.open, update=False, memory_mb=memory_mb))
            store.path = source
        recording = cls(store)
        try:
            recording._check_version()
        except RecordingError:
            recording._store.close()
            raise
        return recording

    def __enter__(self) -> Self:
        """Return the recording itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close; a written file takes its name, or vanishes if the block raised.

        Raises `RecordingError` where the disk does not take all of it.
        """
        with self._place:
            try:
                if kind is None and self._store.writes:
                    self._complete()
            except OSError as error:
                raise RecordingError(f"{self.path}: cannot be written ({error.strerror})") from error
            finally:
                self._store.close()

    def _complete(self) -> None:
        """Put everything into the file, close it, and give it its name."""
        self._store.finish()
        self._store.close()
        if self._partial:
            log_of(self.path).unlink(missing_ok=True)  # of the file that had the name before
            self._partial.replace(self.path)

    def snapshot(self, place: str | os.PathLike[str]) -> None:
        """Write everything committed so far to a new file, while others go on appending; raises `RecordingError`."""
        self._store.copy_to(Path(place))

    def shorten_log(self) -> None:
        """Put the log beside the file into the file, while others go on appending; raises `RecordingError`."""
        self._store.shorten_log()

    def show(self) -> Summary:
        """Return what the recording holds, as a summary that prints itself."""
        from uwblink.recording.summary import summarize

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

        `replacing` maps names of `TABLES` to what stands there instead: what the method of that name returns
        (`{"exchanges": corrected}`; an empty list empties a table of rows). `meta` adds entries, or replaces those
        with the same keys. Raises what `create` raises, and `RecordingError` for a table that recordings do not have.
        """
        instead = dict(replacing or {})
        known_tables(instead)
        entries = instead.pop("meta", None)
        entries = self.meta() if entries is None else entries
        with self._copying(path, entries | dict(meta or {}), instead, force=force) as written:
            for table in instead:
                _APPENDERS[table](written, instead[table])

    @contextmanager
    def copying(
        self,
        path: str | os.PathLike[str],
        *,
        without: Collection[str],
        meta: Mapping[str, Any] | None = None,
        force: bool = False,
    ) -> Iterator[Self]:
        """Yield a copy in the making: all tables but those `without`, to which the block appends what it likes.

        What the block appends need not be in memory at once. Raises what `copy` raises.
        """
        known_tables(without)
        with self._copying(path, self.meta() | dict(meta or {}), without, force=force) as written:
            yield written

    @contextmanager
    def _copying(
        self, path: str | os.PathLike[str], meta: Mapping[str, Any], without: Collection[str], *, force: bool
    ) -> Iterator[Self]:
        with type(self).create(path, meta=meta, force=force, memory_mb=COPYING_MB) as written:
            for table in TABLES:
                if table != "meta" and table not in without:
                    written._store.take(self._store, table)
            yield written

    def _check_version(self) -> None:
        version = self.meta().get("format_version")
        if not isinstance(version, int):
            raise RecordingError(f"{self.path}: not a {SUFFIX} recording (no format_version in meta)")
        if version > FORMAT_VERSION:
            raise RecordingError(
                f"{self.path}: format version {version} is newer than this uwbcal reads "
                f"({FORMAT_VERSION}); update uwbcal"
            )


_APPENDERS: Final[dict[str, Callable[[Recording, Any], None]]] = {
    "tags": Recording.append_tags,
    "poses": Recording.append_poses,
    "exchanges": Recording.append_exchanges,
    "overheard": lambda recording, columns: recording.append_columns("overheard", columns),
    "cirs": Recording.append_cirs,
    "frames": Recording.append_frames,
    "faults": Recording.append_faults,
    "imu": lambda recording, columns: recording.append_columns("imu", columns),
    "height": lambda recording, columns: recording.append_columns("height", columns),
    "powers": lambda recording, columns: recording.append_columns("powers", columns),
    "temperature": lambda recording, columns: recording.append_columns("temperature", columns),
    "corrected": lambda recording, columns: recording.append_columns("corrected", columns),
    "arrangements": Recording.append_arrangements,
    "distances": Recording.append_distances,
}
