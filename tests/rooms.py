"""The rooms of the packages by their imports, and the layer of each room.

`python -m tests.rooms` (`make rooms`) prints them.
"""

from __future__ import annotations

import ast
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("uwblink", "uwbsim", "calib")
parsed = cache(ast.parse)


Rooms = dict[str, set[str]]


@cache
def imports(source: str) -> frozenset[str]:
    """Return the dotted names that a module imports, including those under `if TYPE_CHECKING`."""
    found: set[str] = set()
    for node in ast.walk(parsed(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(found)


def room_of(path: Path, package: Path) -> str:
    """Return the room of a file: its folder in the package, or the module itself if it is in none."""
    return path.relative_to(package).parts[0].removesuffix(".py")


def rooms(package: str, root: Path = ROOT) -> Rooms:
    """Return every room of a package and the other rooms that it imports; the front door is left out."""
    folder = root / package
    names = {room_of(path, folder) for path in folder.rglob("*.py")} - {"__init__", "__main__"}
    found: Rooms = {name: set() for name in names}
    for path in folder.rglob("*.py"):
        here = room_of(path, folder)
        if here not in found:
            continue
        dotted = (name.split(".") for name in imports(path.read_text(encoding="utf-8")))
        found[here] |= {parts[1] for parts in dotted if parts[0] == package and len(parts) > 1} & names - {here}
    return found


def floors(graph: Rooms) -> list[list[str]]:
    """Return the rooms by layer, the lowest first: each is one above the highest that it imports.

    Raises `graphlib.CycleError` if rooms import each other in a circle.
    """
    found, sorter = [], TopologicalSorter(graph)
    sorter.prepare()
    while ready := sorter.get_ready():
        found.append(sorted(ready))
        sorter.done(*ready)
    return found


def drawing() -> str:
    """Return a text from the top layer down: each room with the rooms below it that it imports."""
    lines = []
    for package in PACKAGES:
        graph = rooms(package)
        lines.append(package)
        for level, names in reversed([*enumerate(floors(graph))]):
            for k, name in enumerate(names):
                below = f" imports {', '.join(sorted(graph[name]))}" if graph[name] else ""
                lines.append(f"  {'' if k else level!s:1}  {name:15}{below}".rstrip())
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    print(drawing(), end="")
