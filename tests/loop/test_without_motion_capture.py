"""The page on calibration without motion capture: its commands run as written, and find the planted values.

Served boards are those of the scenario on ports in virtual time: a recording starts when they stand in the next
arrangement.
"""

import re
import shlex
import shutil
import tomllib

import numpy as np
import pytest
from scipy.interpolate import BSpline

import calib
import uwblink
import uwbsim
from calib.surveys.knowledge import load_knowledge
from tests import pages, processes
from tests.shared_data import ROOT
from uwblink.pages import figures
from uwbsim.boards.server import stays_s
from uwbsim.scenario.radio import BIAS

PAGE = (ROOT / "docs" / "without-motion-capture.md").read_text(encoding="utf-8")
SCENARIO = ROOT / "scenarios" / "string" / "string.toml"
AT_REFERENCE_M = float(
    BSpline(BIAS["icra2023"]["knots"], BIAS["icra2023"]["coefficients"], 3)(1.0)  # the lifted power of -82 dBm
)
PLANTED = {
    tag["id"]: tag["delay_ns"] - AT_REFERENCE_M / 0.299702547 for tag in tomllib.loads(SCENARIO.read_text())["tags"]
}
"""Delays as a survey states them: its curve is zero at -82 dBm, where that of the scenario is +3.2 cm."""


def blocks(label):
    return re.findall(rf"^```{label}\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL)


COMMANDS = [line for block in blocks("sh survey") for line in pages.lines(block)]


class Bench:
    """The boards of a scenario as served by `uwbsim serve` in a folder, in virtual time."""

    def __init__(self, scenario, link_dir):
        self.ports = uwbsim.VirtualPorts(uwbsim.load(scenario))
        self.ports.names = {tag: f"{link_dir}/tag{tag}" for tag in self.ports.names}
        self.stays = iter(stays_s(self.ports.bench.scenario))

    def record(self, words):
        """Run `uwblink record` when the boards stand in their next arrangement; patterns of names are expanded."""
        begin_s, end_s = next(self.stays)
        self.ports.bench.advance(int(begin_s * 1e9))
        names = [name for word in words for name in (self.ports.names.values() if "*" in word else [word])]
        done = processes.succeed("uwblink", *names)
        assert self.ports.now_s() < end_s
        return done


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """The folder after all commands of the tutorial, and the output of each."""
    folder = tmp_path_factory.mktemp("string")
    shutil.copytree(ROOT / "scenarios" / "string", folder / "scenarios" / "string")
    (taped,) = blocks("toml taped")
    (folder / "known.toml").write_text(taped)
    said: dict[str, str] = {}
    bench = None
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(figures, "drawn", pages.outline)
        # Six ranges per pair instead of twenty.
        for name, *words in (shlex.split(line.replace("--duration 30", "--duration 9")) for line in COMMANDS):
            if words[0] == "serve":
                bench = Bench(words[1], words[words.index("--link-dir") + 1])
                patch.setattr("uwblink.boards.record.SerialPorts", lambda ports=bench.ports: ports)
                continue
            result = bench.record(words) if name == "uwblink" else processes.succeed(name, *words)
            said.setdefault(words[0], result.stdout)
    return folder, said


def errors_ns(path):
    """Return errors of delays against planted values, and their covariance, in order of tags."""
    found = calib.load_calibration(path)
    error = np.array([found.delays_ns[tag] - planted for tag, planted in PLANTED.items()])
    return error, np.array(found.uncertainty.delays_ns2)


@pytest.mark.slow
def test_delays_about_their_mean_agree_with_the_plan(done):
    folder, _ = done
    error, spread = errors_ns(folder / "calibration.json")
    plan = calib.plan(6, on="line", size_m=(4.0,), arrangements=8, rate_hz=10.0)
    assert np.abs(error - error.mean()).max() < min(plan.half_ns.values())
    # The common part is also the constant of the curve: known much less than differences, and within its interval.
    assert 0.05 < np.sqrt(spread.mean()) < 0.3
    assert abs(error.mean()) < 2 * np.sqrt(spread.mean())


@pytest.mark.slow
def test_one_measured_distance_determines_the_common_delay(done):
    folder, _ = done
    error, spread = errors_ns(folder / "taped.json")
    # Six ranges per pair, with the noise of all pairs: from its own six, a pair would get 6 % too little.
    assert np.sqrt(spread.mean()) < 0.03
    assert np.all(np.abs(error) < 0.08)
    assert abs(error.mean()) < 2 * np.sqrt(spread.mean())
    motion = {b["name"]: b["motion"]["places_m"][0][0] for b in tomllib.loads(SCENARIO.read_text())["bodies"]}
    tape = load_knowledge(folder / "known.toml").distances[0]
    assert tape.distance_m == pytest.approx(abs(motion["stand4"] - motion["stand5"]))


@pytest.mark.slow
def test_the_survey_prints_what_the_page_shows(done):
    _, said = done
    (shown,) = blocks("text survey")
    pages.compare(said["survey"], shown)
    assert "arrangements: A, B, C, D, E, F, G, H, on a line" in said["show"]
    assert "from the geometry of boards that stood still" in said["show"]


@pytest.mark.slow
def test_the_commands_are_those_of_the_plan_and_the_boards_stand_as_planned(done):
    _, said = done
    planned = [line.strip() for line in said["plan"].splitlines() if line.startswith("  u") or "calib survey" in line]
    assert len(planned) == 9
    page = [line for line in COMMANDS if line.startswith(("uwblink record", "calib survey"))]
    assert planned == [line.replace(" --report survey.html", "") for line in page[:9]]
    bodies = tomllib.loads(SCENARIO.read_text())["bodies"]
    for k, line in enumerate(planned[:8]):
        where = {int(b["name"].removeprefix("stand")): b["motion"]["places_m"][k][0] for b in bodies}
        assert line.split("--order ")[1].split()[0] == ",".join(map(str, sorted(where, key=lambda tag: where[tag])))


@pytest.mark.slow
def test_recordings_have_the_stated_arrangement(done):
    folder, _ = done
    (mark,) = uwblink.load(folder / "B.uwb").arrangements
    assert (mark.name, mark.known, mark.order) == ("B", "line", (2, 1, 5, 4, 6, 3))
    (after,) = uwblink.load(folder / "corrected.uwb").arrangements
    assert after.order == uwblink.load(folder / "A.uwb").arrangements[0].order


def test_the_file_of_known_facts_on_the_page_is_read(tmp_path):
    (example,) = re.findall(r"^```toml\n(.*?)^```", PAGE, flags=re.MULTILINE | re.DOTALL)
    (tmp_path / "known.toml").write_text(example)
    known = load_knowledge(tmp_path / "known.toml")
    spans = {"A": (0.0, 60.0), "B": (70.0, 130.0)}
    assert (known.shape, dict(known.shapes), dict(known.spans_s)) == ("line", {"A": "plane"}, spans)
    assert (dict(known.orders), known.distances[0].distance_m) == ({"B": (3, 1, 4, 2)}, 3.06)
    assert known.positions[0].tag == 4
