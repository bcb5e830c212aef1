"""Every check shares one budget of false alarms, and what strangers brought is found, through the front doors."""

import json
import re
import tarfile
from collections import Counter
from csv import DictReader, DictWriter
from dataclasses import replace
from io import TextIOWrapper

import numpy as np
import pytest

import calib
import uwbsim
from benchmarks import doctor as planted
from benchmarks.flights import Flight, Plan, fly
from calib.checks.examine import CHECKS, LEVEL
from calib.findings import BUDGET, OF_A_FIT, exceeds
from docs.site import checks
from tests import processes
from tests.shared_data import shared
from uwblink.importers import import_recording
from uwblink.recording.file import Recording

SHORT = Plan(seconds=40, per_second=80)
BRIEF = Plan(seconds=20, per_second=40)
RIG = replace(SHORT, bodies=1, anchors=6)
RNG = np.random.default_rng


def rows_of(tar, name):
    """The rows of a table in an archive, by its headers."""
    file = tar.extractfile(name)
    assert file is not None
    return list(DictReader(TextIOWrapper(file)))


def faults(*flights):
    return [finding.fault for finding in calib.examine(flights if len(flights) > 1 else flights[0])]


def only(flight, fault):
    (found,) = [one for one in calib.examine(flight) if one.fault == fault]
    return found


def test_checks_that_involve_chance_share_one_budget_and_the_page_shows_them_all():
    assert sum(not check.certain for check in CHECKS) * LEVEL + OF_A_FIT == pytest.approx(BUDGET)
    told = Counter(fault for check in CHECKS for fault in check.remedies)
    assert max(told.values()) == 1
    page = checks.reference()
    assert all(f"**{fault}**: " in page for fault in told)
    for case in planted.FAULTS:
        assert case.expected <= told.keys()


@pytest.mark.parametrize(("many", "unit"), [(1000, "mm"), (100, "cm"), (1 / 0.0254, "in"), (1 / 0.3048, "ft")])
def test_poses_in_another_unit_are_asked_about(many, unit):
    flight = fly(BRIEF, 92)
    wrong = replace(flight, poses=replace(flight.poses, position_m=flight.poses.position_m * many))
    (found,) = calib.examine(wrong)
    assert found.fault == "unit of the poses"
    assert f'distance = "{unit}"' in found.remedy


def test_lever_arms_in_mm_are_asked_about():
    flight = fly(SHORT, 93)
    found = only(planted.arms_in_mm(flight, RNG(0)), "lever arm unit")
    assert "0.001" in found.remedy


@pytest.mark.parametrize(("many", "unit"), [(1000.0, "mm"), (100.0, "cm")])
def test_ranges_in_another_unit_are_asked_about(many, unit):
    bare = planted.without_stamps(fly(BRIEF, 94), RNG(0), many=many)
    found = only(bare, "unit of the ranges")
    assert f'distance = "{unit}"' in found.remedy
    beside = fly(BRIEF, 94)
    beside = planted.changed(beside, range_m=beside.exchanges.range_m * many)
    assert f'distance = "{unit}"' in only(beside, "unit of the reported ranges").remedy
    assert faults(beside) == ["unit of the reported ranges"]


def test_ranges_that_no_radio_measures_are_asked_about_without_any_truth():
    bare = planted.without_stamps(fly(BRIEF, 94), RNG(0), many=1000.0)
    assert faults(replace(bare, poses=bare.poses[:0])) == ["unit of the ranges"]


@pytest.mark.parametrize(("factor", "back"), [(-1, "-1"), (100, "0.01"), (256, "0.00390625")])
def test_powers_that_are_no_dbm_are_asked_about_and_nothing_is_told_of_their_lack(factor, back):
    flight = fly(BRIEF, 95)
    e = flight.exchanges
    loud = planted.changed(flight, fpp1_dbm=e.fpp1_dbm * factor, fpp2_dbm=e.fpp2_dbm * factor)
    (found,) = calib.examine(loud)
    assert found.fault == "unit of the powers"
    assert f"by {back}," in found.remedy


@pytest.mark.parametrize("stamps", [True, False])
def test_rows_that_stand_twice_are_counted(stamps):
    flight = fly(BRIEF, 96)
    if not stamps:
        flight = planted.without_stamps(flight, RNG(0), many=1.0)
    e = flight.exchanges
    twice = replace(flight, exchanges=e[np.sort(np.concatenate([np.arange(len(e)), np.arange(123)]))])
    found = only(twice, "doubled exchanges")
    assert found.evidence.startswith(f"123 of {len(e) + 123} rows")
    assert "doubled exchanges" not in faults(flight)


def test_anchors_that_were_exchanged_are_named_with_each_other():
    flight = fly(replace(RIG, seconds=60), 97)
    body = flight.poses.body
    other = np.where(body == "anchor1", "anchor4", np.where(body == "anchor4", "anchor1", body))
    found = [
        one for one in calib.examine(replace(flight, poses=replace(flight.poses, body=other)))
        if one.fault == "anchor stands elsewhere"
    ]  # fmt: skip
    assert [one.evidence.split()[2] for one in found] == ["anchor1", "anchor4"]
    assert [one.evidence.split("there the recording has ")[1].split(":")[0] for one in found] == ["anchor4", "anchor1"]


def test_what_does_not_close_is_told_where_nothing_moves():
    open_ = planted.still_open(fly(SHORT, 98), RNG(3))
    assert set(faults(open_)) == {"pairs that do not close", "static data"}
    size_cm = float(only(open_, "pairs that do not close").evidence.split(" are ")[1].split(" cm")[0])
    assert size_cm == pytest.approx(45, abs=1.5)
    assert faults(planted.still(fly(SHORT, 98), RNG(3))) == ["static data"]


def test_power_that_follows_distance_is_seen_through_noise():
    assert faults(planted.noisy_powers(fly(SHORT, 99), RNG(3))) == ["power confounded with distance"]


@pytest.mark.parametrize("gap", [True, False])
def test_an_anchor_whose_delay_changed_between_sessions_is_named(gap):
    made = planted.other_anchor(fly(SHORT, 1), RNG(4), plan=RIG, gap=gap)
    rng = RNG(4)
    rng.integers(0, 2**31)
    anchor = 100 + rng.integers(0, RIG.anchors)
    fault = "delay changed mid-flight" if gap else "delay changed between recordings"
    (found,) = [one for one in calib.examine(made) if one.fault != "too few pairs"]
    assert found.fault == fault
    assert f"tag {anchor} " in found.evidence


def test_boards_at_one_distance_are_asked_about_the_unit_of_the_tape():
    flight = fly(SHORT, 98)
    e = flight.exchanges[(flight.exchanges.initiator == 10) & (flight.exchanges.target == 20)]
    tape = np.full(len(e), 3000.0)
    known = calib.Ranges.from_exchanges(e, poses=flight.poses, tags=flight.tags).truth_m
    near = planted.longer(replace(flight, exchanges=e), 3.0 - known)
    (found,) = calib.examine(replace(planted.changed(near, truth_m=tape), poses=flight.poses[:0]))
    assert found.fault == "unit of the true distances"
    assert 'distance = "mm"' in found.remedy


def test_one_exchange_is_no_traceback():
    flight = fly(SHORT, 98)
    assert faults(replace(flight, exchanges=flight.exchanges[:1])) == ["too few pairs", "static data"]


def test_what_all_tags_do_is_no_delay_of_one():
    flight = fly(replace(SHORT, tags_a_body=1, bodies=4), 98)
    late = planted.seconds(flight) > 20
    assert "delay changed mid-flight" not in faults(planted.longer(flight, np.where(late, 0.15, 0.0)))


def test_a_change_among_changes_of_others_is_no_delay_of_one():
    plan = replace(SHORT, tags_a_body=1, bodies=5)
    first, second = (planted.named(fly(plan, 98 + k, 1), str(k)) for k in range(2))
    e = second.exchanges
    pair = np.minimum(e.initiator, e.target) * 100 + np.maximum(e.initiator, e.target)
    by_others = np.where(np.isin(pair, [2030, 2040, 3050]), 0.2, -0.2)
    changed = planted.longer(second, np.where(planted.of_tag(second, 10), 0.12, by_others))
    assert "delay changed between recordings" not in faults(first, changed)


def test_the_worst_of_many_is_no_surer_than_one_of_one():
    rng = RNG(7)
    worst = np.max(np.abs(rng.standard_t(9, (2000, 60))), axis=1)
    p_values = np.array([exceeds(float(value), 1.0, 9, tried=60) for value in worst])
    assert 0.03 < np.mean(p_values < 0.05) < 0.065
    assert exceeds(0.5, 0.1, 9, tolerance=0.5) == 1


def test_a_tag_of_many_reflected_ranges_is_named_where_pairs_have_few():
    flight = fly(replace(SHORT, per_second=7, share=0.0), 98)
    assert faults(flight) == []
    some = planted.of_tag(flight, 20) & (RNG(1).random(len(flight.exchanges)) < 0.4)
    found = only(planted.longer(flight, np.where(some, 0.6, 0.0)), "reflections")
    assert "tag 20: " in found.evidence
    assert found.evidence.count("tag ") == 1


def test_the_command_asks_for_units_and_prints_p_values(tmp_path):
    flight = planted.doubled(planted.stepped(fly(SHORT, 91), RNG(1)), RNG(2))
    with Recording.create(tmp_path / "f.uwb") as recording:
        recording.append_tags(flight.tags)
        recording.append_poses(flight.poses)
        recording.append_exchanges(flight.exchanges)
    said = processes.run("calib", "doctor", tmp_path / "f.uwb", "--json")
    found = {one["fault"]: one["p_value"] for one in json.loads(said.stdout)["findings"]}
    assert found["doubled exchanges"] == 0
    assert 0 < found["delay changed mid-flight"] < LEVEL
    assert said.stderr == ""


STARLOC = [
    "time_s",
    "from_id",
    "to_id",
    "tx1",
    "rx1",
    "tx2",
    "rx2",
    "tx3",
    "rx3",
    "fpp1",
    "fpp2",
    "skew1",
    "skew2",
    "range",
]
RADIOS = {11: 10, 7: 11, 4: 12, 10: 13, 5: 15, 6: 16, 12: 6, 9: 9}
"""The marker of each radio, as the data's page says."""


@pytest.fixture(scope="module")
def starloc():
    with tarfile.open(shared("starloc_loop-2d-fast.tar.xz")) as tar:

        def table(name):
            (path,) = [one for one in tar.getnames() if one.endswith(name)]
            return rows_of(tar, path)

        markers = {int(row[""]): [row[k] for k in "xyz"] for row in table("uwb_markers_v1.csv")}
        return table("loop-2d-fast_s1/uwb.csv"), markers


@pytest.mark.parametrize(
    ("marker_of", "wrong"),
    [
        (RADIOS, set()),
        # Radio 11 is 1.25 m above its marker then, which the rig, which keeps its height, does not determine.
        ({radio: radio for radio in RADIOS}, {"tag10", "tag12"}),
        (dict(zip(sorted(RADIOS), sorted(RADIOS.values()), strict=True)), {"tag4", "tag5", "tag6", "tag9", "tag11"}),
    ],
    ids=["right", "by number", "by order"],
)
def test_markers_that_are_other_radios_are_seen(starloc, tmp_path, marker_of, wrong):
    ranges, markers = starloc
    names = [*STARLOC, *(f"{end}_{k}_m" for end in ("from", "to") for k in "xyz")]
    with (tmp_path / "t.csv").open("w") as out:
        table = DictWriter(out, ["range_m" if name == "range" else name for name in names])
        table.writeheader()
        for row in ranges:
            here = [row[f"tag_pos_{k}"] for k in "xyz"]
            there = markers.get(marker_of[int(float(row["to_id"]))], ["", "", ""])
            cells = [*(row[name] for name in STARLOC), *here, *there]
            table.writerow(dict(zip(table.fieldnames, cells, strict=True)))
    (tmp_path / "m.toml").write_text('bits = 32\n[units]\nstamps = "ns"\n')
    import_recording(tmp_path / "t.csv", tmp_path / "t.uwb", map_file=tmp_path / "m.toml")
    found = calib.examine(tmp_path / "t.uwb")
    assert {one.evidence.split()[2] for one in found if one.fault == "anchor stands elsewhere"} == wrong
    assert {one.fault for one in found} == {
        "too few pairs",
        "anchor stands elsewhere" if wrong else "reflections that last",
    }


def test_logs_of_both_robots_are_doubled_exchanges(tmp_path):
    with tarfile.open(shared("miluv_cirObstacles_3_random_0.tar.xz")) as tar:
        logs = [one for one in tar.getnames() if one.endswith("uwb_range.csv")]
        logged = [row for one in logs for row in rows_of(tar, one)]
    stamps = [f"{way}{k}" for k in (1, 2, 3) for way in ("tx", "rx")]
    names = {"time_s": "timestamp", **{name: f"{name}_raw" for name in stamps}, "range_m": "range_raw"}
    names |= {name: name for name in ("from_id", "to_id", "fpp1", "fpp2", "skew1", "skew2", "gt_range")}
    with (tmp_path / "t.csv").open("w") as out:
        table = DictWriter(out, [{"gt_range": "gt_range_m"}.get(name, name) for name in names])
        table.writeheader()
        for row in sorted(logged, key=lambda row: float(row["timestamp"])):
            table.writerow(dict(zip(table.fieldnames, (row[theirs] for theirs in names.values()), strict=True)))
    (tmp_path / "m.toml").write_text('bits = 40\n[units]\nstamps = "ns"\n')
    import_recording(tmp_path / "t.csv", tmp_path / "t.uwb", map_file=tmp_path / "m.toml")
    # The import takes each exchange once; what is made without it is not so careful.
    with Recording.open(tmp_path / "t.uwb") as recording:
        once = recording.exchanges()
    assert len(once) == len(logged) - 123
    assert calib.examine(tmp_path / "t.uwb") == []
    twice = once[np.sort(np.concatenate([np.arange(len(once)), np.arange(123)]))]
    (found,) = calib.examine(Flight(twice, fly(SHORT, 1).poses[:0], []))
    assert found.evidence.startswith("123 of 440 rows")


def test_a_sound_recording_among_anchors_has_no_finding():
    """Anchors keep one power for each pair, and distance explains up to 83 % of it."""
    scenario = uwbsim.load("anchors_and_tag/anchors_and_tag", {"run.duration_s": 60.0, "run.seed": 50_000})
    assert faults(uwbsim.simulate(scenario)) == []


@pytest.mark.parametrize(("plan", "seed"), [(Plan(seconds=60), 60_017), (replace(planted.ONE, seconds=60), 60_003)])
def test_reflections_in_the_last_seconds_are_no_change_of_a_delay(plan, seed):
    assert faults(fly(plan, seed)) == []


def test_pairs_that_a_cabinet_hides_are_named():
    """Tag 1 sees the third quadcopter through metal: medians of its two pairs are 25 and 17 cm too long."""
    room = uwbsim.simulate(uwbsim.load("room/room", {"run.duration_s": 60.0, "run.seed": 50_004}))
    named = [one.evidence.split()[3] for one in calib.examine(room) if one.fault == "pairs that do not close"]
    assert sorted(named) == ["1-30", "1-31"]


def test_a_fit_in_a_room_settles():
    """Steps by the information alone do not settle here in a hundred."""
    room = uwbsim.simulate(uwbsim.load("room/room", {"run.duration_s": 60.0, "run.seed": 50_000}))
    ranges = calib.Ranges.from_exchanges(room.exchanges, poses=room.poses, tags=room.tags)
    assert calib.fit(ranges.usable()).success


def test_where_an_anchor_stands_is_told_with_an_interval_and_as_a_line_of_a_map():
    seeds, scores = range(90_100, 90_104), []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        away = rng.normal(size=3)
        away *= 0.3 / np.linalg.norm(away)
        flight = fly(planted.ANCHORS, seed, 1, (2, away))
        (found,) = [one for one in calib.examine(flight) if one.fault == "anchor stands elsewhere"]
        axes = np.array(re.findall(r"([-+][\d.]+) ± ([\d.]+)", found.evidence), dtype=float)
        scores.append((axes[:, 0] - away) / axes[:, 1])
        stated = np.median(flight.poses.position_m[flight.poses.body == "anchor2"], axis=0)
        place = json.loads(found.remedy.split("position_m = ")[1])
        np.testing.assert_allclose(place, stated + axes[:, 0], atol=0.011)
    # Of twelve 95 % intervals at least ten hold in 98 % of such trials.
    assert np.count_nonzero(np.abs(scores) < 1) >= 10
