"""The import rule of docs/architecture.md, held by walking every import statement."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("uwblink", "uwbsim", "calib")

FORBIDDEN = {
    "uwblink": {"uwbsim", "calib"},
    "uwbsim": {"calib"},
    "calib": {"uwbsim"},
}
# A library that belongs to certain files only.
CONFINED = {
    "serial": lambda path: path == "uwblink/boards/ports.py",
    "simpy": lambda path: path.startswith("uwbsim/"),
    "matplotlib": lambda path: (
        "figures" in Path(path).name or path in {f"calib/report/{name}.py" for name in ("blocks", "html", "pdf")}
    ),
    "fpdf": lambda path: path == "calib/report/pdf.py",
    "typer": lambda path: "/cli/" in path,
    "rich": lambda path: "/cli/" in path,
    "duckdb": lambda path: path.startswith("uwblink/") or path == "uwbsim/sweep/results.py",
    "pydantic": lambda path: path.startswith("uwbsim/"),
    "rosbags": lambda path: path == "uwblink/importers/poses.py",
    "distributed": lambda path: path == "uwbsim/sweep/executors.py",
}
NEVER = {"pickle", "pandas", "pyarrow"}


def imported(source: str) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module.split(".")[0])
    return names


def violations(package: str, path: str, source: str) -> list[str]:
    names = imported(source)
    wrong = names & (FORBIDDEN[package] | NEVER)
    wrong |= {lib for lib, allowed in CONFINED.items() if lib in names and not allowed(path)}
    return [f"{path} imports {name}" for name in sorted(wrong)]


@pytest.mark.parametrize("package", PACKAGES)
def test_package_keeps_the_import_rule(package):
    files = sorted((ROOT / package).rglob("*.py"))
    assert files, f"no modules found in {package}"
    found = [
        line for file in files for line in violations(package, file.relative_to(ROOT).as_posix(), file.read_text())
    ]
    assert found == []


@pytest.mark.parametrize(
    ("package", "path", "source"),
    [
        ("uwblink", "uwblink/x.py", "import calib.estimation.fitting"),
        ("calib", "calib/x.py", "def f():\n    from uwbsim import clock"),
        ("calib", "calib/x.py", "import simpy"),
        ("uwbsim", "uwbsim/x.py", "from matplotlib.figure import Figure"),
        ("uwblink", "uwblink/x.py", "import pickle"),
    ],
)
def test_the_walk_sees_a_violation(package, path, source):
    assert violations(package, path, source)
