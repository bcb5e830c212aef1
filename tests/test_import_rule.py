"""The import rule of docs/architecture.md, held by walking every import statement."""

from graphlib import CycleError
from pathlib import Path

import pytest

from tests.rooms import PACKAGES, ROOT, floors, imports, rooms

FORBIDDEN = {
    "uwblink": {"uwbsim", "calib"},
    "uwbsim": {"calib"},
    "calib": {"uwbsim"},
}
# A library that belongs to certain files only.
CONFINED = {
    "serial": lambda path: path == "uwblink/boards/ports.py",
    "simpy": lambda path: path.startswith("uwbsim/"),
    "matplotlib": lambda path: "figures" in Path(path).name or path == "uwblink/pages/pdf.py",
    "pypdf": lambda path: path == "uwblink/pages/pdf.py",
    "typer": lambda path: "/cli/" in path,
    "rich": lambda path: "/cli/" in path,
    "duckdb": lambda path: path.startswith("uwblink/") or path == "uwbsim/sweep/runner.py",
    "pydantic": lambda path: path.startswith(("uwbsim/", "calib/calibration/")),
    "threadpoolctl": lambda path: (
        path
        in {
            "calib/checks/examine.py",
            "calib/fitting/fitting.py",
            "calib/planning/flights.py",
            "calib/surveys/survey.py",
            "calib/trajectories/fitting.py",
            "uwbsim/sweep/executors.py",
            "uwbsim/twins/fitting.py",
        }
    ),
    "yaml": lambda path: path in {"uwblink/importers/miluv.py", "calib/calibration/formats.py"},
    "mcap": lambda path: path in {"uwblink/importers/bags.py", "uwblink/exporters/mcap.py"},
    "rosbags": lambda path: path in {"uwblink/importers/bags.py", "uwblink/exporters/mcap.py"},
    "foxglove": lambda path: path == "uwblink/streaming/senders.py",
    "gtsam": lambda path: path == "calib/factors.py",
    "pandas": lambda path: path == "uwblink/arrays.py",
    "distributed": lambda path: path == "uwbsim/sweep/executors.py",
}
NEVER = {"pickle", "pyarrow"}


def violations(package: str, path: str, source: str) -> list[str]:
    names = {name.split(".")[0] for name in imports(source)}
    # A twin reads a calibration through calib's door.
    forbidden = FORBIDDEN[package] - ({"calib"} if path == "uwbsim/twins/range_errors.py" else set())
    wrong = names & (forbidden | NEVER)
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
        ("uwblink", "uwblink/x.py", "import calib.fitting.fitting"),
        ("calib", "calib/x.py", "def f():\n    from uwbsim import clock"),
        ("calib", "calib/x.py", "import simpy"),
        ("uwbsim", "uwbsim/x.py", "from matplotlib.figure import Figure"),
        ("uwblink", "uwblink/x.py", "import pickle"),
    ],
)
def test_the_walk_sees_a_violation(package, path, source):
    assert violations(package, path, source)


@pytest.mark.parametrize("package", PACKAGES)
def test_no_rooms_import_each_other_in_a_circle(package):
    assert floors(rooms(package))


def test_a_circle_is_seen(tmp_path):
    sources = {
        "__init__": "from calib.fits.x import a",
        "errors": "",
        "fits/x": "import calib.errors\nfrom calib.report import y",
        "report/y": "def f():\n    from calib.fits.x import g",
    }
    for name, source in sources.items():
        path = tmp_path / "calib" / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(source)
    graph = rooms("calib", tmp_path)
    assert graph == {"errors": set(), "fits": {"errors", "report"}, "report": {"fits"}}
    with pytest.raises(CycleError, match="fits"):
        floors(graph)
