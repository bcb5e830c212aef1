"""Records of many fields are made by name: nobody can tell seven numbers apart by their place."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("uwblink", "uwbsim", "calib")
MOST = 6

# Records of more fields that may be made by position, each with its reason.
BY_POSITION = {
    "RangeReport": "a wire message: its fields are the parts of a line, in the order of the line",
    "Overheard": "a wire message: its fields are the parts of a line, in the order of the line",
}


def words(call):
    """Return the keywords of a decorator as text."""
    return {word.arg: ast.unparse(word.value) for word in getattr(call, "keywords", ())}


def wide_records(source):
    """Yield the names of dataclasses and messages of more than `MOST` fields that can be made by position."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.ClassDef):
            continue
        made = [d for d in node.decorator_list if ast.unparse(d).split("(")[0] in ("dataclass", "message")]
        fields = [
            part
            for part in node.body
            if isinstance(part, ast.AnnAssign) and not ast.unparse(part.annotation).startswith("ClassVar")
        ]
        marks = [k for k, part in enumerate(fields) if ast.unparse(part.annotation) == "KW_ONLY"]
        if made and len(fields[: min(marks, default=None)]) > MOST and words(made[0]).get("kw_only") != "True":
            yield node.name


def found():
    files = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    return [name for path in files for name in wide_records(path.read_text(encoding="utf-8"))]


def test_records_of_many_fields_are_made_by_name():
    assert sorted(found()) == sorted(BY_POSITION)


@pytest.mark.parametrize(
    ("settings", "names"), [("(frozen=True)", ["A"]), ("(frozen=True, kw_only=True)", []), ("", ["A"])]
)
def test_the_walk_sees_a_wide_record(settings, names):
    fields = "".join(f"    x{k}: int\n" for k in range(MOST + 1))
    assert list(wide_records(f"@dataclass{settings}\nclass A:\n{fields}")) == names
