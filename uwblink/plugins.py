"""Tables to which programs add rows at run time, and other distributions by entry points.

An entry point of the table's group names one row, or a list of rows:

```toml
[project.entry-points."uwbcal.protocols"]
my-protocol = "my_package.ranging:MY_PROTOCOL"
```
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Final, Generic, Protocol, TypeVar

from uwblink.errors import ArgumentError, PluginWarning, UwblinkError, warn

NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9-]{0,40}")
"""Names of rows, which are typed on command lines and stored in files."""


def check_row(kind: str, of: type[Any], fields: Mapping[str, tuple[Callable[[Any], object], str]], row: Any) -> None:
    """Raise `ArgumentError` for a row that is not `of` a class, or has a field that is not as it must be.

    `fields` has a test of each field and what is expected, beside the name, which must be a word.
    """
    if not isinstance(row, of):
        raise ArgumentError(f"{kind}: found {row!r:.60}, expected a {of.__name__}")
    named = {"name": (lambda name: isinstance(name, str) and NAME.fullmatch(name), "a word such as 'ds-alt'")}
    for field, (is_good, expected) in (named | dict(fields)).items():
        value = getattr(row, field)
        if not is_good(value):
            raise ArgumentError(f"{kind} {row.name!r:.60}: {field}: found {value!r:.60}, expected {expected}")


def is_text(value: Any) -> bool:
    """Whether a value is text that is not empty."""
    return isinstance(value, str) and bool(value)


class Named(Protocol):
    """A row of a table has a name."""

    @property
    def name(self) -> str:
        """The name."""


Row = TypeVar("Row", bound=Named)


class Registry(Mapping[str, Row], Generic[Row]):
    """Rows by name: the project's own, those that programs add, and those of installed distributions.

    Entry points of `group` are loaded once: on the first unknown name, or when all rows are listed. Entry points that
    cannot be loaded cause a `PluginWarning`. `check` raises `ArgumentError` for a row that cannot be used.
    """

    def __init__(self, kind: str, group: str, rows: Iterable[Row], check: Callable[[Any], None]) -> None:
        """Start with the project's own `rows`; `kind` is the word for a row in messages."""
        self._kind, self._group, self._check = kind, group, check
        self._rows = {row.name: row for row in rows}
        self._own = frozenset(self._rows)
        self._loaded = False

    def register(self, row: Row, *, replace: bool = False) -> None:
        """Add a row; with `replace` it may replace one that was added before.

        Raises `ArgumentError` for a row that cannot be used, a name that is taken, and for every name of the project.
        """
        self._check(row)
        if row.name in self._own:
            raise ArgumentError(f"{self._kind} {row.name!r}: this name is reserved; choose another one")
        if row.name in self._rows and not replace:
            raise ArgumentError(
                f"{self._kind} {row.name!r}: is already registered; choose another name, or use replace=True"
            )
        self._rows[row.name] = row

    def adopt(self, rows: Iterable[Row]) -> None:
        """Add the rows of another process that are not known here."""
        for row in rows:
            if row.name not in self:
                self.register(row)

    def remove(self, name: str) -> None:
        """Remove a row that was added; raises `ArgumentError` for other names."""
        if name in self._own or name not in self._rows:
            raise ArgumentError(f"{self._kind} {name!r}: was not registered, so it cannot be removed")
        del self._rows[name]

    def known(self) -> list[Row]:
        """Return the loaded rows, without loading entry points."""
        return list(self._rows.values())

    def added(self) -> list[Row]:
        """Return the rows that are not the project's own."""
        self._load()
        return [row for name, row in self._rows.items() if name not in self._own]

    @contextmanager
    def calling(self, name: str, error: type[Exception]) -> Iterator[None]:
        """Convert exceptions of rows that are not the project's own into `error`, with the name of the row."""
        try:
            yield
        except UwblinkError:
            raise
        except Exception as problem:
            if name in self._own:
                raise
            raise error(f"{self._kind} {name!r}: failed with {_line(problem)}") from problem

    def __getitem__(self, name: str) -> Row:
        """Return a row by its name; raises `KeyError`."""
        if name not in self._rows:
            self._load()
        return self._rows[name]

    def __iter__(self) -> Iterator[str]:
        """Iterate over all names, the project's own first."""
        self._load()
        return iter(self._rows)

    def __len__(self) -> int:
        """Return the number of rows."""
        self._load()
        return len(self._rows)

    def __repr__(self) -> str:
        """Return the names."""
        return f"<{self._kind}s: {', '.join(self)}>"

    def _load(self) -> None:
        if self._loaded:
            return
        # Set first: a plug-in may use the table while it is loaded.
        self._loaded = True
        from importlib.metadata import entry_points

        for entry in sorted(entry_points(group=self._group), key=lambda e: e.name):
            try:
                found = entry.load()
                for row in found if isinstance(found, list | tuple) else (found,):
                    self.register(row)
            except Exception as error:  # a plug-in must not stop the project
                origin = entry.dist.name if entry.dist else "an unnamed distribution"
                warn(
                    f"plug-in {entry.name!r} of {origin} (group {self._group}) is left out: {_line(error)}",
                    PluginWarning,
                )


def _line(error: Exception) -> str:
    text = " ".join(str(error).split()) or "no reason given"
    return text if isinstance(error, ArgumentError) else f"{type(error).__name__}: {text}"
