"""The reference of a package: its front door, the doors of its rooms, and classes that come and go through them."""

from __future__ import annotations

import dataclasses
import inspect
import pkgutil
import re
import typing
from collections.abc import Iterator
from importlib import import_module
from types import ModuleType
from typing import Any, Final

PACKAGES: Final = ("uwblink", "uwbsim", "calib")
ALIAS: Final = re.compile(r"TypeAliasForwardRef\('(\w+)'\)")
HOME: Final = re.compile(r"~[\w.]+\.(?=\w)")
FACTORY: Final = "<factory>"


def reference(package: str) -> str:
    """Return the Markdown of a package: its front door, doors of rooms, and what these take and return."""
    rooms = [room for room in _rooms(package) if _own(package, room)]
    seldom = "Names that are seldom needed are imported from the rooms of the package."
    parts = [_module(package), "## Rooms", seldom]
    for room in rooms:
        parts += [f"### {room}", _module(room, ", ".join(_own(package, room)))]
    parts += ["## Arguments and results", "Classes that the functions above take and return."]
    parts += [_class(cls) for cls in _returned(package, rooms)]
    return "\n\n".join(parts)


def plain_aliases(*event: Any) -> tuple[str | None, str | None]:
    """Return signature and return annotation with the names of aliases as they stand in the code.

    Models of files have none: the pages of files have their keys.
    """
    signature, returned = event[-2:]
    if hasattr(event[3], "model_fields"):
        return "", None
    return _by_names(signature), _by_names(returned)


def _by_names(text: str | None) -> str | None:
    return HOME.sub("", ALIAS.sub(r"\1", text)).replace(FACTORY, "...") if text else text


def _module(name: str, members: str = "") -> str:
    parts = _of_parts(name)
    apart = f"   :exclude-members: {', '.join(parts)}\n" if parts else ""
    whole = [f".. autoclass:: {name}.{part}\n   :members:\n   :inherited-members:\n" for part in parts]
    module = f".. automodule:: {name}\n   :members: {members}\n   :imported-members:\n{apart}"
    return "```{eval-rst}\n" + "\n".join([module, *whole]) + "```"


def _of_parts(name: str) -> list[str]:
    """Return the classes of a module that consist of others, whose methods are theirs: a recording's, by table."""
    module = import_module(name)
    return [word for word in module.__all__ if len(_own_bases(getattr(module, word))) > 1]


def _own_bases(thing: Any) -> list[type]:
    bases = thing.__bases__ if inspect.isclass(thing) else ()
    return [base for base in bases if base.__module__.split(".")[0] in PACKAGES and not issubclass(base, Exception)]


def _class(cls: type) -> str:
    # Fields stand in the signature of a dataclass.
    return f"```{{eval-rst}}\n.. autoclass:: {cls.__module__}.{cls.__qualname__}\n```"


def _rooms(package: str) -> list[str]:
    """Return the modules of the first level that have `__all__`."""
    found = [f"{package}.{info.name}" for info in pkgutil.iter_modules(import_module(package).__path__) if info.ispkg]
    return [name for name in found if not name.endswith(".cli") and hasattr(import_module(name), "__all__")]


def _own(package: str, room: str) -> list[str]:
    """Return what a room offers beside the front doors."""
    front = {name for door in PACKAGES for name in import_module(door).__all__}
    return sorted(name for name in import_module(room).__all__ if name not in front and not name.isupper())


def _returned(package: str, rooms: list[str]) -> list[type]:
    """Return the package's classes that what is offered takes, returns or has, and that are offered nowhere."""
    modules = [import_module(name) for name in (*PACKAGES, *(room for p in PACKAGES for room in _rooms(p)))]
    offered = [getattr(module, name) for module in modules for name in module.__all__]
    seen = {id(thing) for thing in offered}
    front = import_module(package)
    waiting = [getattr(front, name) for name in front.__all__]
    waiting += [getattr(import_module(room), name) for room in rooms for name in _own(package, room)]
    found: list[type] = []
    while waiting:
        for cls in _mentioned(waiting.pop()):
            if id(cls) not in seen and cls.__module__.split(".")[0] in PACKAGES and not hasattr(cls, "model_fields"):
                seen.add(id(cls))
                found.append(cls)
                waiting.append(cls)
    return sorted((cls for cls in found if cls.__module__.startswith(f"{package}.")), key=lambda cls: cls.__qualname__)


def _mentioned(thing: Any) -> Iterator[type]:
    """Yield the classes in the annotations of a function, or of a class's fields, methods and properties."""
    for function in _functions(thing):
        try:
            hints = typing.get_type_hints(function)
        except (NameError, TypeError):  # names that only type checkers import
            continue
        for hint in hints.values():
            yield from _classes(hint)


def _functions(thing: Any) -> Iterator[Any]:
    if not inspect.isclass(thing):
        yield thing
        return
    if dataclasses.is_dataclass(thing):
        yield thing
    members = [*vars(thing).items(), *(item for base in _own_bases(thing) for item in vars(base).items())]
    for name, member in members:
        if not name.startswith("_") or name == "__init__":
            yield from (one for one in (getattr(member, "fget", member),) if inspect.isfunction(one))


def _classes(hint: Any) -> Iterator[type]:
    if inspect.isclass(hint) and not isinstance(hint, ModuleType):
        yield hint
    # The parameters of a callable are a list; a generic class is the origin of its hint.
    for part in hint if isinstance(hint, list) else filter(None, (typing.get_origin(hint), *typing.get_args(hint))):
        yield from _classes(part)
