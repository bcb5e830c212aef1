"""What each command loads: of the heavy modules those that its work takes and no other, so that it begins at once.

Every command of the three has its row here; one without it fails. Help takes `rich` alone.
"""

import json
import subprocess
import sys
import time
from dataclasses import replace
from typing import NamedTuple

import duckdb
import numpy as np
import pytest
import typer

import calib
from calib.cli.commands import app as calib_app
from docs.site.commands import leaves
from tests.boards import served
from uwblink import Arrangement, Contents, Exchanges
from uwblink.cli.commands import app as uwblink_app
from uwblink.exporters import export_recording
from uwbsim.cli.commands import app as uwbsim_app

HEAVY = {
    *("numpy", "scipy.interpolate", "scipy.linalg", "scipy.optimize", "scipy.sparse", "scipy.spatial", "scipy.special"),
    *("scipy.stats", "duckdb", "matplotlib", "simpy", "rich", "serial", "pandas", "pyarrow", "fpdf", "pypdf", "PIL"),
    *("fontTools", "distributed", "dask", "rosbags", "foxglove", "sphinx", "sklearn"),
}
NUMBERS = {"numpy"}
TABLE = {"numpy", "duckdb"}
SPECIAL = {"scipy.special"}
SEARCH = {"numpy", "scipy.linalg", "scipy.optimize", "scipy.sparse", "scipy.spatial", "scipy.special"}
"""`scipy.optimize`, and what it loads itself."""

BOARD = {"serial"}
DRAWS = None
"""Commands that draw a page take seconds, and everything that draws: they are tried with `--help` alone."""

OTHERS_FOLDER = None
"""What it reads takes a dozen files to make, and is read as `import csv` reads."""

METRES_OF_A_TICK = 299_702_547 / (128 * 499.2e6)


class Row(NamedTuple):
    """Words that follow a command in a small case of it, none where only its help is tried; and what that loads."""

    words: str | None
    loads: frozenset[str] | set[str] = frozenset()


COMMANDS = {
    "uwblink ports": Row("--json", BOARD),
    "uwblink info": Row("ports/tag1", BOARD),
    "uwblink twr": Row("ports/tag1 2 -n 1", BOARD),
    "uwblink test": Row("ports/tag1", BOARD),
    "uwblink passive": Row("ports/tag1 off", BOARD),
    "uwblink send": Row("ports/tag1 hello", BOARD),
    "uwblink cir": Row("ports/tag1 2", BOARD),
    "uwblink set-delay": Row("ports/tag1 1000", BOARD),
    "uwblink record": Row("ports/tag1 ports/tag2 -o recorded.uwb --pairs all --duration 0.1", BOARD | TABLE),
    "uwblink stream": Row("f.uwb -c c.json --speed inf", TABLE | BOARD),
    "uwblink show": Row("f.uwb", TABLE | {"rich"}),
    "uwblink export": Row("f.uwb --to mcap -o out", TABLE),
    "uwblink poses": Row("recorded.uwb --from b1=poses.tum --tags tags.toml", TABLE),
    "uwblink replay": Row("recorded.uwb -o again.uwb", TABLE),
    "uwblink import csv": Row("ranges.csv -o ranges.uwb", TABLE),
    "uwblink import bag": Row("out/recording.mcap -o bag.uwb", TABLE),
    "uwblink import exported": Row("tables -o exported.uwb", TABLE),
    "uwblink import miluv": Row(OTHERS_FOLDER),
    "uwblink import guess": Row("ranges.csv", TABLE),
    "uwbsim scenarios": Row("noiseless -o scenarios"),
    "uwbsim run": Row("scenarios/noiseless.toml -o n.uwb --set run.duration_s=1", TABLE | {"simpy"}),
    "uwbsim serve": Row("scenarios/noiseless.toml --link-dir links --duration 0.01", NUMBERS | {"simpy"}),
    "uwbsim show": Row(DRAWS),
    "uwbsim validate": Row("scenarios/noiseless.toml", NUMBERS),
    "uwbsim schema": Row("", NUMBERS),
    "uwbsim compare": Row(DRAWS),
    "uwbsim predict": Row("--protocol ds", NUMBERS),
    "uwbsim optimum": Row("scenarios/noiseless.toml --protocols ss", SEARCH),
    "uwbsim sweep": Row(DRAWS),
    "uwbsim twin": Row(DRAWS),
    "calib sample": Row("-o sample.uwb -n 10", TABLE),
    "calib fit": Row("f.uwb -o new.json", TABLE),
    "calib add-tag": Row("f.uwb -c two.json --tag 3 -o three.json", TABLE),
    "calib plan": Row("3", NUMBERS | SPECIAL),
    "calib survey": Row("standing.uwb -o delays.json", TABLE | SPECIAL),
    "calib show": Row("c.json", NUMBERS),
    "calib evaluate": Row("f.uwb -c c.json", TABLE | {"rich"}),
    "calib localize": Row("f.uwb -c c.json --seeds 1", TABLE | SPECIAL),
    "calib doctor": Row("f.uwb", TABLE),
    "calib compare": Row("c.json c.json", NUMBERS | SPECIAL),
    "calib report": Row(DRAWS),
    "calib apply": Row("f.uwb -c c.json -o corrected.uwb", TABLE),
    "calib export": Row("c.json --to miluv -o miluv.json", NUMBERS),
    "calib import miluv": Row("miluv.json -o c2.json", NUMBERS),
}
OF_IMPORTERS = "uwblink import "
IMPORTERS = {"numpy"}
"""What the table of importers loads, whose rows are these commands: they are asked for last."""

APPS = {"uwblink": uwblink_app, "uwbsim": uwbsim_app, "calib": calib_app}
EVERY = [" ".join(w) for name, app in APPS.items() for w, _ in leaves(typer.main.get_command(app), (name,))]

OF_DUCKDB = {"pandas", "pyarrow"} if duckdb.__version__.startswith("1.") else set()
"""What DuckDB before 2 loads of its own accord where it is installed, as it is for these tests."""

SPECIALS = [sys.executable, "-c", "import sys, scipy.special; print(*sys.modules)"]
OF_SCIPY = HEAVY & set(subprocess.run(SPECIALS, capture_output=True, text=True).stdout.split()) - SPECIAL - NUMBERS
"""What SciPy's special functions load themselves: in older versions linear algebra and sparse matrices."""

THEIR_OWN = OF_DUCKDB | OF_SCIPY

OURS = ("uwblink.importers", "uwblink.recording.contents", "calib.sources", "calib.calibration.model")
GIVEN: dict[frozenset[str], tuple[str, ...]] = {
    frozenset(TABLE | SPECIAL): ("duckdb", "scipy.special", *OURS),
    frozenset(TABLE): ("duckdb", *OURS),
    frozenset(NUMBERS): ("uwbsim.scenario.loading", "uwbsim.world.world", "calib.calibration.model"),
    frozenset(BOARD): ("serial", "uwblink.boards.connection"),
    frozenset(): (),
}
"""What commands find there already, by what of it is heavy: what they may load need not be loaded by each anew."""


class Asked:
    """A process of `tests.loaded_modules`; modules already there are not loaded anew by every command."""

    def __init__(self, folder, *given):
        words = [sys.executable, "-m", "tests.loaded_modules", *given]
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._folder = folder

    def __call__(self, *commands):
        request = {"commands": [c.split() for c in commands], "folder": str(self._folder), "watched": sorted(HEAVY)}
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def close(self):
        self._process.communicate()


def write_flights(folder):
    """Write what the commands take."""
    flight = calib.sample_flight()
    Contents(exchanges=flight.exchanges, poses=flight.poses, tags=flight.tags).save(folder / "f.uwb")
    export_recording(folder / "f.uwb", folder / "tables", to="csv")
    known = calib.fit(flight).calibration
    known.save(folder / "c.json")
    two = {tag: delay for tag, delay in known.delays_ns.items() if tag != 3}
    errors = {tag: known.delays_std_ns[tag] for tag in two}
    replace(known, delays_ns=two, delays_std_ns=errors, uncertainty=None).save(folder / "two.json")
    (folder / "ranges.csv").write_text("time_s,from_id,to_id,range_m\n0.1,1,2,3.0\n0.2,1,2,3.1\n")
    (folder / "tags.toml").write_text("".join(f'[[tags]]\nid = {k}\nbody = "b1"\n' for k in (1, 2)))
    now = time.time()
    (folder / "poses.tum").write_text("".join(f"{now + k} 0 0 {k / 100} 0 0 0 1\n" for k in range(-100, 900)))


def write_standing(folder):
    """Write arrangements of boards on a line."""
    r = calib.sample_arrangements(3)
    begin = np.arange(3) * 40_000_000_000
    marks = [Arrangement("ABC"[k], int(t), int(t) + 30_000_000_000, "line") for k, t in enumerate(begin)]
    start = np.zeros(len(r), dtype=np.int64)
    back = np.rint(2 * r.raw_m / METRES_OF_A_TICK).astype(np.int64) + 20_000_000
    x = Exchanges.from_arrays(
        r.initiator, r.target, tx1=start, rx1=start, tx2=start + 20_000_000, rx2=back, time_ns=r.time_ns
    )
    Contents(exchanges=x, arrangements=marks).save(folder / "standing.uwb")


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """What each command loaded, and what its help did."""
    folder = tmp_path_factory.mktemp("work")
    write_flights(folder)
    write_standing(folder)
    asked = {given: Asked(folder, *GIVEN[given]) for given in GIVEN}
    tried = {name: row for name, row in COMMANDS.items() if row.words is not None}
    of_boards = [name for name, row in tried.items() if "ports/" in str(row.words)]

    def run(name):
        given = next(given for given in GIVEN if given <= tried[name].loads)
        return asked[given](f"{name} {tried[name].words}")[0]

    with served(link_dir=folder / "ports"):
        answers = {name: run(name) for name in of_boards}
    answers |= {name: run(name) for name in tried if name not in of_boards}
    names = sorted(EVERY, key=lambda name: name.startswith(OF_IMPORTERS))
    helps = asked[frozenset()](*(f"{name} --help" for name in names))
    for given, one in asked.items():
        assert set(one("")[0]["loaded"]) - THEIR_OWN == given
        one.close()
    return answers, dict(zip(names, helps, strict=True))


def test_every_command_has_its_row():
    assert sorted(COMMANDS) == sorted(EVERY)


@pytest.mark.parametrize("command", [name for name, row in COMMANDS.items() if row.words is not None])
def test_a_command_loads_nothing_heavy_that_it_does_not_need(command, found):
    answer = found[0][command]
    assert answer["status"] == 0, answer["printed"]
    loaded = set(answer["loaded"]) - THEIR_OWN
    assert loaded <= COMMANDS[command].loads
    assert bool(loaded) == bool(COMMANDS[command].loads), "none is seen although some are needed"


def test_help_loads_nothing_heavy(found):
    # They are asked for in one process: the first to load something is the one that is at fault.
    for command, answer in found[1].items():
        assert answer["status"] == 0, answer["printed"]
        assert set(answer["loaded"]) <= {"rich"} | (IMPORTERS if command.startswith(OF_IMPORTERS) else set()), command
