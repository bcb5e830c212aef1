"""A plan of arrangements as steps in words, with pictures of letters."""

from __future__ import annotations

from calib.planning.candidates import Layout
from calib.planning.having import Having
from calib.planning.result import PlannedArrangement
from calib.surveys.network import DIMENSIONS


def named(name: str, layout: Layout, tags: tuple[int, ...]) -> PlannedArrangement:
    """Return an arrangement under a name, with boards by their ids."""
    place = {tag: (float(p[0]), float(p[1]), float(p[2])) for tag, p in zip(tags, layout.place_m, strict=True)}
    return PlannedArrangement(name, place, tuple((tags[i], tags[j]) for i, j in layout.taped))


def where(on: str, one: PlannedArrangement) -> str:
    """Return in words where boards stand."""
    if on == "line":
        return "in the order " + " ".join(map(str, one.order()))
    axes = DIMENSIONS[on]
    spots = ", ".join(f"{t} at ({', '.join(f'{v:.1f}' for v in p[:axes])})" for t, p in one.place_m.items())
    return f"with {spots}"


def steps(given: Having, made: tuple[PlannedArrangement, ...], seconds: float) -> list[str]:
    """Return what to do, a line each, pictures between."""
    held = {"line": "Stretch a string and keep it straight", "plane": "Take a flat table or floor", "": "Use the room"}
    lines = [f"1. {held[given.on]}. Places are guides: nothing but what is taped is measured, orders matter."]
    for k, one in enumerate(made, start=2):
        lines.append(f"{k}. Arrangement {one.name}: boards {where(given.on, one)}.")
        lines += picture(given.on, one)
        for i, j in one.taped:
            lines.append(f"   Tape the distance of {i} and {j}, antenna to antenna.")
        lines.append(f"   Record all pairs as arrangement {one.name} for {seconds:.0f} s.")
    shape = f", known to be on a {given.on}" if given.on else ""
    lines.append(f"{len(made) + 2}. Survey all recordings together{shape}.")
    if given.taped or given.anchors:
        lines.append("   A file says what is known beside: the taped distances, the anchors' places.")
    return lines


def picture(on: str, one: PlannedArrangement, width: int = 56, height: int = 9) -> list[str]:
    """Return the arrangement drawn with letters, seen from above: a line of text for a line, a box for others."""
    xs = [p[0] for p in one.place_m.values()]
    span = max(max(xs) - min(xs), 1e-6)
    rows = 1 if on == "line" else height
    ys = [p[1] for p in one.place_m.values()]
    tall = max(max(ys) - min(ys), 1e-6)
    cells = [["-" if on == "line" else " "] * width for _ in range(rows)]
    for tag, (x, y, _) in one.place_m.items():
        column = round((x - min(xs)) / span * (width - 3))
        row = rows - 1 - round((y - min(ys)) / tall * (rows - 1))
        for k, letter in enumerate(str(tag)):
            cells[row][min(column + k, width - 1)] = letter
    return ["     " + "".join(line).rstrip() for line in cells]
