"""Fields of settings that are shared by Python and the command line."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import field, fields
from typing import Any


def setting(
    default: Any,
    help: str,  # noqa: A002 - as in argparse
    *,
    flag: str | None = None,
    kind: Any = None,
    parse: Callable[[Any], Any] | None = None,
    names: tuple[str, ...] = (),
    more: Callable[[], Iterable[str]] | None = None,
    tags: str | None = None,
    **shown: Any,
) -> Any:
    """Return a field of a dataclass of settings.

    `help` is the help text of the option. `flag` is the option if it differs from the field's name with dashes. `kind`
    is the type of the option if it differs from the field's, and `parse` converts it. `names` are the possible values,
    to which `more` adds some for completion; `tags` is the format ("{}=") in which a shell completes tags of the
    recordings on the command line. `shown` is passed to `typer.Option`: `metavar`, `min`, `max`, `rich_help_panel`; but
    for `bounds`, the least and the largest value that checks of settings allow.
    """
    metadata = {
        "help": help, "flag": flag, "kind": kind, "parse": parse, "names": names, "more": more, "tags": tags,
        "bounds": shown.pop("bounds", None), "shown": shown,
    }  # fmt: skip
    if isinstance(default, dict):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


def flags_of(settings: Any) -> Mapping[str, str]:
    """Return the options of fields whose option differs from their name with dashes."""
    return {one.name: one.metadata["flag"] for one in fields(settings) if one.metadata.get("flag")}
