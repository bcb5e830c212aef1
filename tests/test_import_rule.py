"""The import rule of docs/architecture.md, held by walking every import statement."""

from pathlib import Path

import pytest

from tests.rooms import DRAWN, PACKAGES, PAGE, ROOT, circle, drawing, imports, rooms

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
        "figures" in Path(path).name or path in {f"calib/report/{name}.py" for name in ("blocks", "pdf")}
    ),
    "fpdf": lambda path: path == "calib/report/pdf.py",
    "pypdf": lambda path: path == "calib/report/pdf_figures.py",
    "typer": lambda path: "/cli/" in path,
    "rich": lambda path: "/cli/" in path,
    "duckdb": lambda path: path.startswith("uwblink/") or path in {"uwbsim/sweep/results.py", "uwbsim/tables.py"},
    "pydantic": lambda path: path.startswith("uwbsim/"),
    "threadpoolctl": lambda path: (
        path
        in {
            "calib/estimation/fitting.py",
            "calib/planning/flights.py",
            "calib/surveys/surveying.py",
            "calib/trajectories/fitting.py",
            "uwbsim/twins/fitting.py",
        }
    ),
    "yaml": lambda path: path == "uwblink/importers/miluv_yaml.py",
    "mcap": lambda path: path in {"uwblink/importers/json_mcap.py", "uwblink/exporters/mcap.py"},
    "rosbags": lambda path: path in {"uwblink/importers/bags.py", "uwblink/exporters/rosbag2.py"},
    "foxglove": lambda path: path == "uwblink/streaming/foxglove_server.py",
    "distributed": lambda path: path == "uwbsim/sweep/executors.py",
}
# The rooms by floor, the ground first: a room imports only rooms of lower floors, so two on one floor never meet.
FLOORS = {
    "uwblink": (
        ("arrays", "display", "errors", "interrupts", "lazy", "text_files"),
        ("columns", "database", "output", "pages", "plugins", "ticks", "toml"),
        ("protocols",),
        ("twr",),
        ("wire",),
        ("recording",),
        ("boards", "exporters", "importers"),
        ("streaming",),
        ("cli",),
    ),
    "uwbsim": (
        ("errors", "random_streams", "units"),
        ("output", "scenario", "tables"),
        ("world",),
        ("simulation",),
        ("boards", "protocols", "twins"),
        ("sweep",),
        ("pages",),
        ("cli",),
    ),
    "calib": (
        ("carriers", "errors", "samples", "single_sided", "spread"),
        ("densities", "information", "long_columns", "planted", "range_columns"),
        ("error_mixture", "ranges"),
        ("recorded",),
        ("calibration", "sources"),
        ("evaluation",),
        ("over_power",),
        ("figures",),
        ("estimation", "surveys"),
        ("doctor", "trajectories"),
        ("planning",),
        ("report",),
        ("cli",),
    ),
}
NEVER = {"pickle", "pandas", "pyarrow"}


def violations(package: str, path: str, source: str) -> list[str]:
    names = {name.split(".")[0] for name in imports(source)}
    # A twin reads a calibration through calib's door.
    forbidden = FORBIDDEN[package] - ({"calib"} if path == "uwbsim/twins/calibration_file.py" else set())
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
        ("uwblink", "uwblink/x.py", "import calib.estimation.fitting"),
        ("calib", "calib/x.py", "def f():\n    from uwbsim import clock"),
        ("calib", "calib/x.py", "import simpy"),
        ("uwbsim", "uwbsim/x.py", "from matplotlib.figure import Figure"),
        ("uwblink", "uwblink/x.py", "import pickle"),
    ],
)
def test_the_walk_sees_a_violation(package, path, source):
    assert violations(package, path, source)


@pytest.mark.parametrize("package", PACKAGES)
def test_rooms_import_only_rooms_below_them(package):
    graph = rooms(package)
    assert circle(graph) == []
    floor = {name: k for k, names in enumerate(FLOORS[package]) for name in names}
    assert sorted(set(graph) - set(floor)) == [], "rooms without a floor"
    wrong = [f"{name} imports {other}" for name in graph for other in graph[name] if floor[other] >= floor[name]]
    assert wrong == []


def written(folder, **sources):
    for name, source in sources.items():
        path = folder / "calib" / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.with_suffix(".py").write_text(source)
    return folder


def test_a_circle_is_seen(tmp_path):
    root = written(
        tmp_path,
        __init__="from calib.fits__x import a",
        errors="",
        fits__x="import calib.errors\nfrom calib.report import y",
        report__y="def f():\n    from calib.fits.x import g",
    )
    graph = rooms("calib", root)
    assert graph == {"errors": set(), "fits": {"errors", "report"}, "report": {"fits"}}
    assert circle(graph) == ["fits", "report"]


def test_the_picture_of_rooms_is_what_the_imports_say():
    found = DRAWN.search(PAGE.read_text(encoding="utf-8"))
    assert found, "docs/architecture.md has no place for the picture of rooms"
    drawn = found[0].removeprefix(found[1]).removesuffix(found[2])
    assert drawn == drawing(), "draw the rooms anew: make rooms"
