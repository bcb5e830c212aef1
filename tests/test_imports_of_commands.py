"""What each command loads: of the heavy modules only those that its work takes, so that it begins at once."""

import json
import subprocess
import sys

import duckdb
import pytest

import calib
from uwblink import Contents

HEAVY = {
    *("numpy", "scipy.interpolate", "scipy.linalg", "scipy.optimize", "scipy.sparse", "scipy.spatial", "scipy.special"),
    *("scipy.stats", "duckdb", "matplotlib", "simpy", "rich", "serial", "pandas", "pyarrow", "fpdf", "PIL"),
    *("fontTools", "distributed", "rosbags", "sphinx", "sklearn"),
}
CODE = (
    "import sys, json\n"
    "from {package}.cli import main\n"
    "try:\n    main()\n"
    "finally:\n    print('LOADED' + json.dumps(sorted(set({heavy!r}) & set(sys.modules))), file=sys.stderr)\n"
)
TABLE = {"numpy", "duckdb"}
FIT = TABLE | {"scipy.linalg", "scipy.sparse", "scipy.special"}
SPLINES = {"scipy.interpolate", "scipy.linalg", "scipy.optimize", "scipy.sparse", "scipy.spatial", "scipy.special"}
"""`scipy.interpolate`, of which flights on splines and curves over power are made, and what it loads itself."""

COMMANDS = {
    "calib show c.json": {"numpy"},
    "calib fit f.uwb -o new.json": FIT,
    "uwblink show f.uwb": TABLE | {"rich"},
    "uwblink import csv ranges.csv -o r.uwb": TABLE,
    "uwbsim scenarios --json": set(),
    "uwbsim run noiseless -o n.uwb --set run.duration_s=1": TABLE | SPLINES | {"simpy"},
}

OF_DUCKDB = {"pandas", "pyarrow"} if duckdb.__version__.startswith("1.") else set()
"""What DuckDB before 2 loads of its own accord where it is installed, as it is for these tests."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("work")
    flight = calib.sample_flight()
    Contents(exchanges=flight.exchanges, poses=flight.poses, tags=flight.tags).save(folder / "f.uwb")
    calib.fit(flight).save(folder / "c.json")
    (folder / "ranges.csv").write_text("time_s,from_id,to_id,range_m\n0.1,1,2,3.0\n0.2,1,2,3.1\n")
    return folder


def loaded(words, folder):
    package, *rest = words
    code = CODE.format(package=package, heavy=sorted(HEAVY))
    done = subprocess.run([sys.executable, "-c", code, *rest], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stderr.rpartition("LOADED")[2]))


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_loads_nothing_heavy_that_it_does_not_need(command, folder):
    found = loaded(command.split(), folder)
    assert found - OF_DUCKDB <= COMMANDS[command]
    assert bool(found) == bool(COMMANDS[command]), "none is seen although some are needed"
