"""Reference pages of files whose readers have their keys in a table."""

from __future__ import annotations

from collections.abc import Iterable

from uwblink.text_files import FileKey


def reference(keys: Iterable[FileKey]) -> str:
    """Return the Markdown of a table of keys: a definition list with kind, default and meaning of each."""
    return "\n".join(_entry(key) for key in keys)


def _entry(key: FileKey) -> str:
    default = key.default if key.default == "needed" else f"default: {key.default}"
    return f"`{key.name}`\n: {key.meaning}\n\n  *{_plain(key.kind)}; {_plain(default)}*\n"


def _plain(text: str) -> str:
    """Escape what Markdown would read as a link or a table's edge."""
    return text.replace("[", "\\[").replace("|", "\\|")
