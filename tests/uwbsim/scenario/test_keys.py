"""Scenarios: their keys and limits, the files and names that they come from, and what they and flights print."""

import json
import re
import tomllib
from pathlib import Path
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest

import uwbsim
from docs.site.schema import UNITS, described, reference, unit_of
from tests import processes
from tests.errors import one_line
from tests.shared_data import ROOT
from tests.uwbsim.simulation.test_protocols import calibrated_error_m
from uwblink import Recording, load
from uwblink.database import write_tables
from uwblink.ticks import METRES_PER_TICK
from uwblink.twr import COLUMNS
from uwbsim.boards.server import FaultsFile
from uwbsim.scenario import copy_scenarios, shipped_scenarios
from uwbsim.scenario.base import BY_UNIT, check_limits
from uwbsim.sweep.design import SweepFile
from uwbsim.world.world import World

SCHEMAS = {model.__name__: model.model_json_schema() for model in (uwbsim.Scenario, FaultsFile, SweepFile)}


TWO_STATE = {
    "model": "two-state",
    "share": 0.3,
    "life_s": 0.5,
    "mean_excess_m": 0.8,
    "first_path_loss_db": 9.0,
    "total_loss_db": 2.5,
}
ROOM = {"min_m": [-9.0, -9.0, 0.0], "max_m": [9.0, 9.0, 9.0]}
GEOMETRIC = {"radio.multipath": {"model": "geometric", "scatterers": 3}}


@pytest.mark.parametrize(
    ("source", "overrides", "fragment"),
    [
        ("run = {\n", (), r"^scenario: not valid TOML"),
        ({"ranging": {"rate_hz": 1.0}}, (), r"^scenario: run: missing"),
        ("nowhere.toml", (), r"nowhere\.toml: no such scenario file"),
        ("noiseless", ["run"], r"^`overrides`: found 'run' *, expected key"),
        ("noiseless", {"run.seed.x": 1}, r"^run\.seed\.x: seed is not a table"),
        *(
            ("noiseless", overrides, fragment)
            for overrides, fragment in (
                (
                    {"tags.1.pattern_db": [1.0] * 5},
                    r"tags\[1\].pattern_db: found 5 coefficients, expected 1, 4, 9, 16, 25",
                ),
                (
                    {"ranging.reply": {"model": "quantiles", "delays_us": [302.0, 301.0]}},
                    "reply.delays_us: .* must not decrease",
                ),
                (
                    {"bodies.0.temperature_c": {"model": "table", "times_s": [0, 0], "values": [1, 2]}},
                    r"bodies\[0\]\.temperature_c.*times_s: .* must increase",
                ),
                *(
                    ({"radio.multipath": TWO_STATE | change}, fragment)
                    for change, fragment in (
                        ({"share_std": 0.5}, "share_std: found 0.5, with a mean of 0.3 it is below 0.458"),
                        ({"total_loss_db": 20.0}, "total_loss_db: found 20, at most first_path_loss_db"),
                        ({"pairs": [{"tags": [1, 1]}]}, "tags: found .1, 1., give two tags"),
                        ({"pairs": [{"tags": [1, 2]}, {"tags": [2, 1]}]}, "each pair once"),
                        ({"pairs": [{"tags": [1, 9]}]}, "found tag 9, the tags are 1, 2, 3"),
                        ({"model": "three-state"}, "model"),
                        ({"life_s": 0.0}, "life_s"),
                    )
                ),
                (GEOMETRIC, "radio.multipath.scatterers: found 3 but no room"),
                (
                    GEOMETRIC | {"room": ROOM | {"reflection_loss_db": 6.0}},
                    "room.reflection_loss_db: found 6, but in the geometric model",
                ),
                (GEOMETRIC | {"room": ROOM | {"floor": "cheese"}}, "room.floor.*cheese.*known are air"),
                (["run.duration_s=1e16"], r"run\.duration_s: found 1e\+16, at most 1e\+07 is allowed \(time"),
                (["tags.0.tx_power_db=1e16"], r"tags\[0\]\.tx_power_db: found 1e\+16, at most 500"),
                (["tags.0.lever_arm_m=[1e200, 0, 0]"], r"tags\[0\]\.lever_arm_m: found 1e\+200, at most 1e\+06"),
                (["tags.0.ramp_ppm_per_s=-1e9"], r"tags\[0\]\.ramp_ppm_per_s: found -1e\+09, at most 10000 .*crystal"),
                (["bodies.0.motion.speed_mps=1e16"], r"motion\.speed_mps: found 1e\+16, at most 10000 is allowed \("),
                (["tags.9.skew_ppm=1"], "index"),
                (["tags.x.skew_ppm=1"], "index"),
                (["ranging.rate_hz.deep=1"], "rate_hz"),
                (["=1"], "key.path=value"),
                (["ranging.speed=1"], "unknown key"),
            )
        ),
    ],
)
def test_values_that_cannot_be_and_keys_that_lead_nowhere_are_named(source, overrides, fragment):
    with pytest.raises(uwbsim.ScenarioError, match=fragment):
        uwbsim.load(source, overrides)


@pytest.mark.parametrize("value", [10**400, -2e6, (0.0, 2e6), ((0.0, 1.0), (2e6, 3.0)), (1.0, 10**400)])
def test_numbers_are_limited_however_deep_and_nothing_else_is(value):
    for passes in (True, "1e99", None, (), ((), ()), 10**5, (1.0, 2.0)):
        check_limits("length_m", passes)
    with pytest.raises(ValueError, match="length_m: found"):
        check_limits("length_m", value)


def test_overrides_reach_any_depth_and_any_type():
    multipath = "radio.multipath={probability=0.5, mean_excess_m=1}"
    s = uwbsim.load(
        "noiseless", ["ranging.rate_hz=50", "tags.1.skew_ppm=-3.5", "ranging.protocol=ss", multipath], seed=9
    )
    assert (s.ranging.rate_hz, s.tags[1].skew_ppm, s.ranging.protocol, s.run.seed) == (50, -3.5, "ss", 9)
    assert s.radio.multipath.probability == 0.5


def test_the_printed_schema_names_every_section_and_limit():
    schema = json.loads(processes.run("uwbsim", "schema").stdout)
    assert {"run", "ranging", "radio", "bodies", "tags", "mocap"} <= set(schema["properties"])
    assert (schema["type"], schema["additionalProperties"]) == ("object", False)
    motion = schema["$defs"]["RandomFlight"]["properties"]["speed_mps"]
    assert (motion["exclusiveMinimum"], motion["maximum"]) == (0, 10_000)


@pytest.mark.parametrize("root", SCHEMAS)
def test_every_key_has_a_description_and_the_reference_has_it(root):
    keys, page = list(described(SCHEMAS[root])), reference(SCHEMAS[root], root)
    assert len(keys) > 10
    assert [f"{model}.{key}" for model, key, text in keys if len(text) < 6] == [], "give these Field(description=...)"
    assert [key for _, key, text in keys if f"`{key}`\n: {text}" not in page] == []


def test_the_reference_says_unit_default_and_range():
    page = reference(SCHEMAS["Scenario"], "Scenario")
    rate = "Exchanges per second, all pairs together; frames of all tags with plan broadcast."
    parts = (
        f"`rate_hz`\n: {rate}\n\n  *number; Hz; above 0 to 10⁶; needed*",
        "*number; ps; from 0 to 10⁶; default `116.0`*",
        "*3 × number; m; default `[0.0, 0.0, 0.0]`*",
    )
    assert [part for part in parts if part not in page] == []
    assert [suffix for suffix in BY_UNIT if not any(ours.endswith(suffix) for ours in UNITS)] == []
    assert [unit_of(key) for key in ("skew_ppm_per_sqrt_s", "duration_s", "antenna")] == ["ppm/√s", "s", ""]


# Errors in scenarios are one line; the files that they name are read.


OFFICE = ROOT / "scenarios" / "nlos_office" / "office.toml"
NOISELESS = ROOT / "scenarios" / "noiseless.toml"


def changed(tmp_path, old, new):
    path, _ = copy_scenarios(["nlos_office"], tmp_path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    return path


@pytest.mark.parametrize(
    ("old", "new", "fragments"),
    [
        (
            "position_m = [0.3, 0.3, 2.6]",
            "position_m = [0.3, 9.3, 2.6]",
            ["bodies[0].motion.position_m", "outside"],
        ),
        ("[10.5, 1.0, 0.4]", "[10.5, 1.0, -0.4]", ["bodies[2].motion.points_m[3]", "outside the room"]),
        ("box_max_m = [6.5, 7.2, 2.4]", "box_max_m = [6.5, 7.2, 3.4]", ["box_max_m", "outside the room"]),
        (
            'body = "drone"\nlever_arm_m = [0.15, 0.0, -0.05]',
            'body = "robot"\nlever_arm_m = [0.02, 0.0, 0.35]',
            ["tags 3 and 4", "closer than a wavelength"],
        ),
        ("rate_hz = 120.0", "rate_hz = 400.0", ["ranging.rate_hz", "400", "at most 329"]),
        ('material = "brick"', "", ["obstacles[1].material", "missing"]),
        ('material = "brick"', 'material = "cheese"', ["obstacles[1].material", "cheese", "concrete"]),
        (
            'bias = "aps011"',
            'bias = "magic"',
            ["radio.bias: found 'magic'", "none, icra2023, icra2023-july, miluv, aps011"],
        ),
        ("monopole.csv", "nothing.csv", ["radio.antenna.file", "no such file"]),
        ("min_separation_m = 0.3", "min_separation_m = 9.0", ["min_separation_m", "robot"]),
        ("speed_mps = 0.8\nacceleration", "times_s = [1, 2]\nspeed_mps = 0.8\nacceleration", ["times_s", "either"]),
    ],
)
def test_wrong_worlds_are_refused(tmp_path, old, new, fragments):
    with pytest.raises(uwbsim.ScenarioError, match=one_line(*fragments)):
        uwbsim.simulate(uwbsim.load(changed(tmp_path, old, new)))


def with_antennas(tmp_path, change):
    """Return a scenario whose table of an antenna has other lines."""
    scenario, table = copy_scenarios(["nlos_office"], tmp_path)
    table.write_text("\n".join(change(table.read_text().splitlines())) + "\n")
    return scenario


def trajectory(tmp_path, seconds, begin_s=0):
    rows = [f"{begin_s + t / 10},b,{np.sin(t / 30)},{t / 50},1,0,0,0,1" for t in range(int(seconds * 10) + 1)]
    (tmp_path / "path.csv").write_text("time_s,body,x,y,z,qx,qy,qz,qw\n" + "\n".join(rows) + "\n")
    moved = re.sub("motion = {.*", 'motion = { model = "recorded", file = "path.csv" }', NOISELESS.read_text(), count=1)
    (tmp_path / "s.toml").write_text(moved.replace("duration_s = 60.0", "duration_s = 10.0"))
    return tmp_path / "s.toml"


@pytest.mark.parametrize("begin_s", [0, 1000])
def test_a_recorded_trajectory_is_flown_from_its_begin_whatever_its_clock(tmp_path, begin_s):
    path = next(iter(World(uwbsim.load(trajectory(tmp_path, 12, begin_s))).trajectories.values()))
    np.testing.assert_allclose(path.position_m(np.array([3.0]))[0], [np.sin(1.0), 0.6, 1.0], atol=1e-6)


def planned(tmp_path, slots):
    (tmp_path / "plan.csv").write_text("time_s,initiator,target\n" + slots)
    text = NOISELESS.read_text().replace("rate_hz = 160.0", 'rate_hz = 160.0\nplan = { file = "plan.csv" }')
    (tmp_path / "s.toml").write_text(text)
    return tmp_path / "s.toml"


@pytest.mark.parametrize(
    ("make", "contents", "message"),
    [
        (planned, "0.1,1,99\n", "slot 1 names tag 99"),
        (planned, "0.1,1.9,3\n", r"ranging\.plan\.slots\[0\]\[1\]: found 1\.9, input should be a valid integer"),
        (planned, "0.1,1,3\n0.2,1,1\n", "slot 2 is of tag 1 with itself"),
        (planned, "-0.1,1,3\n", r"slot 1 is at -0.1 s, before the start"),
        (planned, "9,1,3\n7,3,1\n", r"first slot is at 7 s, after the end of the run \(run.duration_s = 6\)"),
        (trajectory, 5, r"lasts 5\.0 s and does not cover the run of 6 s"),
        (
            with_antennas,
            lambda lines: [*lines[:20], *lines[21:]],
            "a hole in the table: no gain_db at azimuth -150, elevation",
        ),
        (with_antennas, lambda lines: [*lines, lines[-1]], r"monopole\.csv: two rows"),
    ],
)
def test_wrong_files_of_scenarios_are_refused(tmp_path, make, contents, message):
    with pytest.raises(uwbsim.ScenarioError, match=message):
        uwbsim.load(make(tmp_path, contents), ["run.duration_s=6"])


def test_of_a_long_plan_what_the_run_lasts_is_flown(tmp_path):
    found = uwbsim.simulate(
        uwbsim.load(planned(tmp_path, "5.9,1,3\n6.1,3,1\n0.1,4,1\n"), ["run.duration_s=6"])
    ).exchanges
    assert found.initiator.tolist() == [4, 1]
    np.testing.assert_allclose(found.time_ns * 1e-9, [0.1, 5.9], atol=0.001)


def test_common_random_numbers():
    base = ["run.duration_s=10", "radio.rx_noise_ps=100", "radio.power_noise_db=0.5", "radio.skew_noise_ppm=0.2"]
    one = uwbsim.simulate(uwbsim.load(NOISELESS, base))
    other = uwbsim.simulate(uwbsim.load(NOISELESS, [*base, "tags.0.skew_ppm=5.5", "tags.0.delay_ns=0.9"]))
    # Another clock shifts exchanges by microseconds, and changes no other random value.
    np.testing.assert_array_equal(one.poses.position_m, other.poses.position_m)
    np.testing.assert_allclose(one.exchanges.fpp1_dbm, other.exchanges.fpp1_dbm, atol=1e-2)
    without = (one.exchanges.initiator != 1) & (one.exchanges.target != 1)
    np.testing.assert_array_equal(one.exchanges.rx2[without], other.exchanges.rx2[without])
    single = uwbsim.simulate(uwbsim.load(NOISELESS, [*base, "ranging.protocol=ss"]))
    np.testing.assert_array_equal(one.poses.quaternion, single.poses.quaternion)
    np.testing.assert_allclose(one.exchanges.fpp1_dbm, single.exchanges.fpp1_dbm, atol=1e-2)


def test_thirty_hours_are_as_exact_as_a_second():
    error = calibrated_error_m(uwbsim.load("wrap/wrap"))
    assert len(error) == 5400
    assert np.abs(error).max() < METRES_PER_TICK


def test_motion_capture_has_gaps_and_latency():
    base = uwbsim.simulate(uwbsim.load(NOISELESS, ["run.duration_s=30"]))
    late = uwbsim.simulate(uwbsim.load(NOISELESS, ["run.duration_s=30", "mocap.latency_ms=8", "mocap.gaps_per_min=6"]))
    assert late.poses.time_ns.min() == base.poses.time_ns.min() + 8_000_000
    assert 0.7 * len(base.poses) < len(late.poses) < 0.99 * len(base.poses)


def test_show_and_validate(tmp_path):
    processes.succeed("uwbsim", "show", OFFICE, "-o", tmp_path / "s.png")
    processes.refuse("uwbsim", "show", OFFICE, "-o", tmp_path / "s.xyz", naming=["expected .html"])
    assert (tmp_path / "s.png").stat().st_size > 20_000
    for words, told in (
        ((OFFICE,), "7200 exchanges planned among 6 pairs"),
        (("anchors_and_tag/bipartite",), "will not be determined"),
        ((OFFICE, "--json"), '"air_share"'),
    ):
        assert told in processes.succeed("uwbsim", "validate", *words).stdout


def test_listed_success_counts_failures(tmp_path):
    flight = tmp_path / "f.uwb"
    aloha = ROOT / "scenarios" / "collisions" / "aloha.toml"
    processes.succeed("uwbsim", "run", aloha, "-o", flight, "--set", "run.duration_s=5")
    shown, flown = json.loads(processes.succeed("uwblink", "show", flight, "--json").stdout), load(flight)
    assert sum(p["failed"] for p in shown["pairs"]) == len(flown.faults) > 0
    assert sum(p["exchanges"] for p in shown["pairs"]) == len(flown.exchanges)


# Scenarios of the package by name: found, listed, copied.


def test_names_of_scenarios_replace_missing_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert uwbsim.load("nlos_office/office") == uwbsim.load(shipped_scenarios()["nlos_office/office"])
    assert uwbsim.load("noiseless.toml") == uwbsim.load("noiseless")
    Path("noiseless.toml").write_text(NOISELESS.read_text().replace("seed = ", "seed = 7"))
    assert uwbsim.load("noiseless.toml").run.seed != uwbsim.load("noiseless").run.seed
    for wrong, said in (
        ("icra2024/train", r"no such scenario file \(\.toml\) or name"),
        ("icra2023/tset1", "or name, did you mean icra2023/test1 or"),
        ("hall.toml", "or name, did you mean hall_with_metal/hall or lasting"),
        ("flight.uwb", r"or name \(see uwbsim scenarios\)"),
    ):
        with pytest.raises(uwbsim.ScenarioError, match=said):
            uwbsim.load(wrong)
    with pytest.raises(uwbsim.UwbsimError, match="`source`: found int, expected a path, a name"):
        uwbsim.simulate(3)  # type: ignore[arg-type]


def test_copies_run_on_their_own(tmp_path):
    written = copy_scenarios(["nlos_office"], tmp_path / "mine")
    assert {path.relative_to(tmp_path).as_posix() for path in written} == {
        "mine/nlos_office/office.toml",
        "mine/nlos_office/monopole.csv",
    }
    assert uwbsim.load(written[0]) == uwbsim.load("nlos_office/office")
    assert len(copy_scenarios([], tmp_path / "all")) == len(shipped_scenarios()) + 2
    with pytest.raises(uwbsim.ScenarioError, match="nonsense: no such scenario; known are anchors"):
        copy_scenarios(["icra2023", "nonsense"], tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_the_command_copies_and_replaces_only_when_told(tmp_path):
    words = ("uwbsim", "scenarios", "icra2023", "-o", "s")
    assert "icra2023/train" in processes.succeed("uwbsim", "scenarios").stdout
    copied = processes.succeed(*words, cwd=tmp_path).stdout.splitlines()
    assert copied == [f"s/icra2023/{name}.toml" for name in ("test1", "test2", "train")]
    processes.refuse(*words, cwd=tmp_path, naming=["s/icra2023/test1.toml: already exists", "--force"])
    processes.succeed(*words, "--force", cwd=tmp_path)


# The front door: sources of scenarios, and what scenarios and flights print and save.


SHORT = {"run.duration_s": 2.0}


def test_a_scenario_is_a_file_a_text_tables_or_itself():
    text = NOISELESS.read_text(encoding="utf-8").replace("duration_s = 60.0", "duration_s = 2.0")
    tables = tomllib.loads(text)
    before = tomllib.loads(text)
    loaded = uwbsim.load(NOISELESS, SHORT)
    flights = [uwbsim.simulate(source) for source in (loaded, text, tables)]
    assert (tables, len(flights[0].exchanges)) == (before, 320)
    for flight in flights[1:]:
        for name in COLUMNS:
            np.testing.assert_array_equal(getattr(flight.exchanges, name), getattr(flights[0].exchanges, name))
    assert uwbsim.load(str(NOISELESS), SHORT) == uwbsim.load(NOISELESS, ["run.duration_s=2.0"]) == loaded


def test_a_notebook_shows_the_tags_of_a_scenario():
    scenario = uwbsim.load(NOISELESS, {"tags.1.skew_ppm": 1.5, "run.name": "<b>"})
    page = scenario._repr_html_()
    rows = [re.findall("<td>(.*?)</td>", row) for row in re.findall("<tr>(.*?)</tr>", page)]
    tag = scenario.tags[1]
    expected = [str(tag.id), tag.body, "random-flight", *(f"{x:g}" for x in (*tag.lever_arm_m, tag.delay_ns)), "1.5"]
    assert (rows[2], len(rows), "12 pairs" in page) == (expected, 7, True)
    assert ("&lt;b&gt;" in page, page.count("data:image/png")) == (True, 1)


def test_printed_and_saved_flights_agree(tmp_path):
    flight = uwbsim.simulate(uwbsim.load(NOISELESS, SHORT))
    lines = str(flight).splitlines()
    assert (2 <= len(lines) <= 6, max(map(len, lines)) <= 100) == (True, True)
    assert "320 exchanges (ds) of 6 tags on 3 bodies in 2 s" in lines[0]
    page = flight._repr_html_()
    assert (lines[1].strip() in page, page.count("<tr>"), page.count("data:image/png")) == (True, 8, 1)
    flight.save(tmp_path / "f.uwb")
    with Recording.open(tmp_path / "f.uwb") as recording:
        np.testing.assert_array_equal(recording.exchanges().rx2, flight.exchanges.rx2)
        assert recording.meta()["planted"] == flight.planted
    with pytest.raises(FileExistsError):
        flight.save(tmp_path / "f.uwb")
    flight.save(tmp_path / "f.uwb", force=True)


# Tables that are complete or absent; sweeps and comparisons test their content.


ROWS = [{"name": "a", "n": 1, "x": 0.5}, {"name": "b", "n": 2, "x": None}]


def test_tables_that_fail_half_way_leave_what_was_there(tmp_path):
    table, parquet = tmp_path / "t.csv", tmp_path / "t.parquet"
    write_tables(table, parquet, ROWS, force=False)
    before = table.read_bytes(), parquet.read_bytes()
    # Rows that can be read once, and the second time only partly.
    failing = MagicMock()
    failing.__iter__.side_effect = [iter(ROWS), iter(Mock(side_effect=[ROWS[0], KeyboardInterrupt]), None)]
    with pytest.raises(KeyboardInterrupt):
        write_tables(table, parquet, failing, force=True)
    assert (table.read_bytes(), parquet.read_bytes()) == before
    assert sorted(file.name for file in tmp_path.iterdir()) == ["t.csv", "t.parquet"]
