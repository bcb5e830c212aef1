"""Objects that are closed at the end of a `with` block."""

from __future__ import annotations

from typing import Self


class Closing:
    """Base of classes with a method `close`: leaving a `with` block calls it."""

    __slots__ = ()

    def close(self) -> None:
        """Close; a derived class says what."""

    def __enter__(self) -> Self:
        """Return the object itself."""
        return self

    def __exit__(self, *_error: object) -> None:
        """Close."""
        self.close()
