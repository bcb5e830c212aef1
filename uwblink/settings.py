"""Fields of settings that Python and the command line share: what each means, and how it is typed."""

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

    `help` is the sentence that the command line prints. `flag` is the option where it is not the field's name with
    dashes. `kind` is the type of the option where it is not the field's type, and `parse` makes the field's value of
    it. `names` are the values to choose from, with those that `more` returns for a shell to complete; `tags` is how a
    shell completes the tags of the recordings on the line ("{}="). `shown` is passed on to `typer.Option`: `metavar`,
    `min`, `max`, `rich_help_panel`.
    """
    typed = {"flag": flag, "kind": kind, "parse": parse, "names": names, "more": more, "tags": tags, "shown": shown}
    metadata = {"help": help, **typed}
    if isinstance(default, dict):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


def flags_of(settings: Any) -> Mapping[str, str]:
    """Return the options of the fields whose option is not their name with dashes."""
    return {one.name: one.metadata["flag"] for one in fields(settings) if one.metadata.get("flag")}
