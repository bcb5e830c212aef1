"""Every scenario in the tree runs, at a few seconds' length, and its recording opens."""

from pathlib import Path

import pytest

from tests import processes
from uwblink.recording.file import Recording

ROOT = Path(__file__).parents[1]
BITING = (
    *("warm_up", "bench", "mounted_differently", "lasting_reflections"),
    *("office", "hall_with_metal", "six_robots"),
)
SCENARIOS = sorted((ROOT / "scenarios").rglob("*.toml"))


def test_the_scenarios_that_the_readme_promises_are_there():
    names = {p.relative_to(ROOT / "scenarios").as_posix() for p in SCENARIOS}
    expected = {"noiseless.toml", "room/room.toml", *(f"icra2023/{n}.toml" for n in ("train", "test1", "test2"))}
    expected |= {"anchors_and_tag/anchors_and_tag.toml", "anchors_and_tag/bipartite.toml", "new_tag/new_tag.toml"}
    expected |= {"day30/train.toml", "collisions/aloha.toml", "nlos_office/office.toml", "wrap/wrap.toml"}
    expected |= {"two_boards_on_a_bench/bench.toml", "lasting_reflections/hall.toml"}
    expected |= {
        "warm_up/warm_up.toml",
        "bench/bench.toml",
        *(f"mounted_differently/{n}.toml" for n in ("before", "after")),
    }
    expected |= {"office/office.toml", "hall_with_metal/hall.toml", "six_robots/six_robots.toml"}
    assert expected <= names


@pytest.mark.parametrize("name", BITING)
def test_scenarios_that_bite_say_what_they_test(name):
    for path in (ROOT / "scenarios" / name).glob("*.toml"):
        head = "".join(line[2:] for line in path.read_text().splitlines(keepends=True) if line.startswith("# "))
        assert "Tests " in head, path


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_scenario_runs(scenario, tmp_path):
    output = tmp_path / "out.uwb"
    # Thirty hours of an exchange every twenty seconds have none in the first three seconds.
    seconds = 300 if scenario.parent.name == "wrap" else 3
    done = processes.run("uwbsim", "run", scenario, "-o", output, "--set", f"run.duration_s={seconds}")
    assert done.returncode == 0, done.stderr
    with Recording.open(output) as recording:
        assert len(recording.exchanges()) > 0
        assert len(recording.poses()) > 0
        assert recording.tags()
