"""The table of checks and its one budget of false alarms, real recordings, and the command."""

import csv
import json
import re
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import calib
import uwblink
import uwbsim
from benchmarks import doctor as planted
from benchmarks.flights import Flight, Plan, fly
from benchmarks.worlds import CLEAN, PLANTED, Recipe, make
from calib.checks import examined_part, recording_view
from calib.checks.examine import CHECKS, FINDING_LEVEL, IMPLIED
from calib.data.sources import RecordedSource
from calib.findings import BUDGET, CERTAIN, FIT_LEVELS, OF_A_FIT, Candidate, Check, exceeds
from docs.site import checks
from tests import processes, shared_data
from tests.calib.fitting.fields import ranges_with_field
from tests.calib.synthetic import about_their_mean, lifted
from uwblink.recording.distances import distances_m

RNG = np.random.default_rng


def save(flight, path):
    uwblink.Contents(exchanges=flight.exchanges, poses=flight.poses, tags=flight.tags).save(path)
    return path


def imported(folder, names, rows, settings):
    """Write and import a table of stamps in nanoseconds; return the recording."""
    with (folder / "t.csv").open("w", newline="") as out:
        csv.writer(out).writerows([names, *rows])
    (folder / "m.toml").write_text(f'{settings}\n[units]\nstamps = "ns"\n')
    uwblink.import_recording(folder / "t.csv", folder / "t.uwb", map_file=folder / "m.toml")
    return folder / "t.uwb"


def test_checks_that_involve_chance_share_one_budget_and_the_page_shows_them_all():
    assert sum(not check.certain for check in CHECKS) * FINDING_LEVEL + OF_A_FIT == pytest.approx(BUDGET)
    assert sum(FIT_LEVELS.values()) == pytest.approx(OF_A_FIT)
    told = Counter(fault for check in CHECKS for fault in check.remedies)
    assert max(told.values()) == 1
    assert all(f"**{fault}**: " in checks.reference() for fault in told)
    assert set(IMPLIED).union(*IMPLIED.values(), *(case.expected for case in planted.FAULTS)) <= told.keys()


def test_a_candidate_without_p_value_is_a_finding_only_if_no_chance_is_involved():
    rows = [
        Check("rows", "?", "count", sound, {"dust": "clean it"}, lambda _: iter(())) for sound in ("normal", CERTAIN)
    ]
    chance, certain = (one.findings([Candidate("dust", "grey")], BUDGET) for one in rows)
    assert chance == []
    assert [(one.fault, one.p_value) for one in certain] == [("dust", 0.0)]


def test_p_values_account_for_the_number_of_tests():
    worst = np.max(np.abs(RNG(7).standard_t(9, (2000, 60))), axis=1)
    p_values = np.array([exceeds(float(value), 1.0, 9, tried=60) for value in worst])
    assert 0.03 < np.mean(p_values < 0.05) < 0.065
    assert exceeds(0.5, 0.1, 9, tolerance=0.5) == 1


@pytest.mark.slow
def test_the_command_prints_findings_clocks_and_p_values(tmp_path):
    plan = Plan(seconds=20, per_second=60)
    save(fly(plan, 91, 5), tmp_path / "sound.uwb")
    save(planted.doubled(planted.stepped(fly(plan, 92, 5), RNG(1)), RNG(2)), tmp_path / "wrong.uwb")
    shown = processes.succeed("calib", "doctor", "sound.uwb", cwd=tmp_path).stdout
    assert [shown.count(text) for text in ("nothing found", "pair 10-20: ")] == [1, 1]
    assert "same sign" in shown
    said = processes.run("calib", "doctor", "sound.uwb", "wrong.uwb", "--json", cwd=tmp_path)
    assert said.stderr == ""
    told = json.loads(said.stdout)
    found = {one["fault"]: one["p_value"] for one in told["findings"]}
    assert 0 == found["doubled exchanges"] < found["delay changed mid-flight"] < FINDING_LEVEL
    assert all("wrong.uwb: " in one["evidence"] for one in told["findings"] if "between" not in one["fault"])
    skews, _ = told["clock_skews"].values()
    assert len(skews) == 12
    assert all(abs(one["stamps_ppm"] - one["carrier_ppm"]) < 0.1 for one in skews)


def test_the_doctor_refuses_a_recording_that_is_given_twice_under_any_name(tmp_path):
    paths = [save(fly(Plan(seconds=5, per_second=60), 94, 5), tmp_path / name) for name in ("one.uwb", "other.uwb")]
    for second in paths:
        processes.refuse("calib", "doctor", paths[0], second, naming=[f"{second.name}: contains", "as one.uwb"])


STAMPS = ("tx1", "rx1", "tx2", "rx2", "tx3", "rx3")
STARLOC = ["time_s", "from_id", "to_id", *STAMPS, "fpp1", "fpp2", "skew1", "skew2", "range"]
STARLOC_DATA = "starloc_loop-2d-fast.tar.xz"
RADIOS = {11: 10, 7: 11, 4: 12, 10: 13, 5: 15, 6: 16, 12: 6, 9: 9}
"""The marker of each radio, from the page of the data set."""


@pytest.fixture(scope="module")
def starloc():
    markers = {int(row[""]): [row[k] for k in "xyz"] for row in shared_data.rows_of(STARLOC_DATA, "uwb_markers_v1.csv")}
    return shared_data.rows_of(STARLOC_DATA, "loop-2d-fast_s1/uwb.csv"), markers


@pytest.mark.parametrize(
    ("marker_of", "expected", "wrong", "exchanged"),
    [
        pytest.param(RADIOS, "reflections that last", set(), [], marks=pytest.mark.slow),
        # Radio 11 is 1.25 m above its marker, in a direction that the rig, which keeps its height, does not determine.
        ({radio: radio for radio in RADIOS}, "anchor stands elsewhere", {"tag10", "tag12"}, []),
        # Radio 6 is at the place of 12, above 4, and 12 at that of 4, above 6.
        pytest.param(
            dict(zip(sorted(RADIOS), sorted(RADIOS.values()), strict=True)),
            "swapped tag ids",
            set(),
            [{"4": "9", "5": "11", "6": "4", "9": "5", "11": "6"}],
            marks=pytest.mark.slow,
        ),
    ],
    ids=["right", "by number", "by order"],
)
def test_exchanged_markers_of_radios_are_detected(starloc, tmp_path, marker_of, expected, wrong, exchanged):
    ranges, markers = starloc
    names = [*STARLOC[:-1], "range_m", *(f"{end}_{k}_m" for end in ("from", "to") for k in "xyz")]
    rows = [
        [row[name] for name in (*STARLOC, *(f"tag_pos_{k}" for k in "xyz"))]
        + markers.get(marker_of[int(float(row["to_id"]))], ["", "", ""])
        for row in ranges
    ]
    found = calib.examine(imported(tmp_path, names, rows, "bits = 32"))
    assert {one.fault for one in found} == {"too few pairs", expected}
    assert {one.evidence.split()[2] for one in found if one.fault == "anchor stands elsewhere"} == wrong
    assert {"and z from delays" in one.evidence for one in found if " tag12 " in one.evidence} <= {True}
    swaps = (re.findall(r"(\d+) is at the given position of (\d+)", one.evidence) for one in found)
    assert [dict(swap) for swap in swaps if swap] == exchanged


def test_equal_coarse_ranges_are_not_doubled_exchanges(tmp_path):
    """At 33 Hz per pair, with centimetres and whole decibels, one row in fifty equals the previous one of its pair."""
    numbers = RNG(1).normal((3.0, -80.0), (0.04, 1.0), (3000, 2))
    ends = ("1,2", "1,3", "2,3")
    lines = [f"{k / 100:.2f},{ends[k % 3]},{r:.2f},{p:.0f},3.0" for k, (r, p) in enumerate(numbers)]
    (tmp_path / "t.csv").write_text("\n".join(["time_s,from_id,to_id,range_m,fpp1,gt_range_m", *lines, ""]))
    uwblink.import_recording(tmp_path / "t.csv", tmp_path / "t.uwb")
    assert [finding.fault for finding in calib.examine(tmp_path / "t.uwb")] == ["static data"]


@pytest.mark.slow
def test_logs_of_both_robots_are_doubled_exchanges(tmp_path):
    logged = shared_data.rows_of("miluv_cirObstacles_3_random_0.tar.xz", "uwb_range.csv")
    names = {"time_s": "timestamp", **{name: f"{name}_raw" for name in STAMPS}, "range_m": "range_raw"}
    names |= {name: name for name in ("from_id", "to_id", "fpp1", "fpp2", "skew1", "skew2")}
    names |= {"gt_range_m": "gt_range"}
    in_time = sorted(logged, key=lambda row: float(row["timestamp"]))
    path = imported(tmp_path, names, [[row[theirs] for theirs in names.values()] for row in in_time], "bits = 40")
    # The import uses each exchange once; data that did not pass the import may have them twice.
    once = uwblink.load(path).exchanges
    assert (len(once), calib.examine(path)) == (len(logged) - 123, [])
    twice = once[np.sort(np.append(np.arange(len(once)), np.arange(123)))]
    (found,) = calib.examine(Flight(twice, fly(Plan(seconds=1), 1).poses[:0], []))
    assert found.evidence.startswith("123 of 440 rows")


def test_power_and_distance_are_not_confounded_outdoors(tmp_path):
    """Two boards on tripods, 2 to 60 m apart: distance explains 82 % of the power, which still determines a curve."""
    table = shared_data.shared("hanyang_sstwr.csv.gz")
    uwblink.import_recording(table, tmp_path / "h.uwb", map_file=shared_data.ROOT / "docs" / "maps" / "hanyang.toml")
    # A pole and a tripod do not move, so reflections last as long as they stand.
    assert {one.fault for one in calib.examine(tmp_path / "h.uwb")} == {
        "too few pairs",
        "single-sided without carrier readings",
        "reflections that last",
    }


def test_two_seconds_of_one_pair_have_no_finding_on_power_and_distance():
    """Distance explains three fifths of the power and directions the rest; 2 s count as one value, so no share is
    significant.
    """
    course, (power_noise, range_noise) = np.linspace(0, 1, 1200), np.random.default_rng(4).standard_normal((2, 1200))
    truth_m = 3 + np.sin(60 * course)
    power_dbm = -76 - 3 * truth_m + 2.5 * np.sin(37 * course) + 0.3 * power_noise
    e = uwblink.Exchanges.from_arrays(
        1, 7, range_m=truth_m + 0.05 * range_noise, truth_m=truth_m, fpp2_dbm=power_dbm, time_ns=np.arange(1200) * 10**6
    )
    assert [one.fault for one in calib.examine(uwblink.Contents(exchanges=e))] == ["too few pairs"]


@pytest.mark.slow
def test_a_fit_in_a_room_converges():
    """Steps by the information matrix alone do not converge here within a hundred iterations."""

    room = uwbsim.simulate(uwbsim.load("room/room", {"run.duration_s": 60.0, "run.seed": 50_000}))
    assert calib.fit(calib.Ranges.from_exchanges(room.exchanges, poses=room.poses, tags=room.tags).usable()).success


# Warnings of fits: no wrong delay without a warning, and no warning in sound worlds.


REFUSED = {
    "truth in millimetres": "millimetres",
    "truth in feet": "feet",
    "88 % left out": "left out",
    "all times zero": "same time",
    "transmissions and receptions swapped": "ranges change",
    "carrier with the opposite sign": "clock skew",
    "third leg longer than a wrap": "clock skew",
}
NAMED = {
    "one pair of four tags reads 45 cm long": "pair 1-2",
    "one pair of six tags off by 15 cm": "pair 2-5",
    "half of a tag's ranges reflected": "tag 2",
    "a tag 3 dB high": "tag 2",
    "a step of 0.3 ns in a tag": "tag 2",
    "a tag remounted": "tag 2",
    "a tag drifts by 0.3 ns": "tag 3",
    "a tag short by 20 cm for a tenth": "tag 4",
    "a tag's delay goes with power": "tag 1",
    "uncorrected skew": "clock skew",
    "truth 2 % short": "grow with the distance",
    "antenna delays of 514 ns not configured": "larger than differences of boards",
}
"""Faults that a warning must name; fits with other faults must be correct, or have a warning."""


def world_with(name):
    seconds = 120.0 if name in NAMED else 60.0
    tags = 4 if "four" in name else 6 if "six" in name else 5
    return PLANTED[name](make(Recipe(tags=tags, seconds=seconds), 3))


def wrong(world, found):
    """Return the errors of delays after a common shift, divided by their stated standard errors."""
    return np.divide(*about_their_mean(found.calibration, world.delays_ns))


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(REFUSED))
def test_faults_that_prevent_a_fit_are_refused(name):
    with pytest.raises(calib.UnanswerableError, match=REFUSED[name]):
        calib.fit(world_with(name).ranges)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(PLANTED) - set(REFUSED)))
def test_wrong_delays_have_a_warning(name):
    world = world_with(name)
    found = calib.fit(world.ranges)
    assert found.warnings or np.abs(wrong(world, found)).max() < 3
    assert name not in NAMED or any(NAMED[name] in warning for warning in found.warnings), found.warnings


@pytest.mark.slow
@pytest.mark.parametrize("name", ["iid", "share by pair, two kinds", "unequal noise", "share by power"])
@pytest.mark.parametrize("seed", range(2))
def test_sound_worlds_have_no_warnings(name, seed):
    world = make(CLEAN[name], seed)
    found = calib.fit(world.ranges)
    assert found.warnings == []
    assert np.abs(wrong(world, found)).max() < 4


@pytest.mark.slow
def test_shares_of_reflections_by_pair_do_not_bias_delays():
    worlds = [make(CLEAN["share by pair"], seed) for seed in range(3)]
    errors = [about_their_mean(calib.fit(one.ranges).calibration, one.delays_ns)[0] for one in worlds]
    # With one share for all pairs it is 20 ps; the bound is 15 ps, and 5 ps are found.
    assert np.sqrt(np.mean(np.square(errors))) < 0.010


@pytest.mark.slow
def test_short_recordings_with_persistent_errors_have_a_warning():
    world = make(Recipe(seconds=20, lasts_s=5, wander_m=0.04, wander_s=10), 1)
    assert [warning for warning in calib.fit(world.ranges).warnings if "20 s of data" in warning]


@pytest.mark.slow
def test_intervals_cover_the_truth_if_errors_persist():
    worlds = [make(CLEAN["persistent 1 s, 2 cm over 3 s, 90 s"], seed) for seed in range(5)]
    # Of 25 errors, 24 should be within two standard errors; with blocks of time of a fixed length it would be 16.
    assert np.mean(np.abs([wrong(world, calib.fit(world.ranges)) for world in worlds]) < 1.96) > 0.85


def distances_late_by(ranges, seconds):
    """Return ranges with true distances of an earlier time, between the same two tags."""
    truth, time_s = ranges.truth_m.copy(), ranges.time_ns * 1e-9
    pair = np.sort(ranges.ends, axis=1) @ [100, 1]
    for one in np.unique(pair):
        rows = pair == one
        truth[rows] = CubicSpline(time_s[rows], truth[rows])(time_s[rows] - seconds)
    return replace(ranges, truth_m=truth)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bodies", "planted", "named"),
    [
        # This is the only warning, and not on places.
        (
            3,
            lambda ranges: distances_late_by(ranges, 0.02),
            r"^((?!places|\n).)*distances change((?!places|\n).)*$",
        ),
        (4, lambda ranges: replace(ranges, truth_m=0.98 * ranges.truth_m), "grow with the distance.*too much over"),
    ],
    ids=["late", "another unit"],
)
def test_wrong_distances_are_named(bodies, planted, named):
    said = calib.fit(planted(ranges_with_field(60_003, bodies=bodies, seconds=60)[0])).warnings
    assert re.search(named, "\n".join(said))


@pytest.mark.slow
def test_sequential_fits_do_not_take_the_curve_for_walls():
    """The errors of all ranges between two bodies contain the curve, which is fitted after the delays."""
    ranges = ranges_with_field(60_005, bodies=3, seconds=60)[0]
    curve = 0.15 * np.exp(-lifted(ranges.fpp1_dbm, ranges.fpp2_dbm) / 0.4)
    said = calib.fit(replace(ranges, raw_m=ranges.raw_m + curve), sequential=True).warnings
    assert not any("places" in one or "with the distance" in one for one in said)


@pytest.mark.slow
@pytest.mark.parametrize(("noise_db", "seed", "place"), [(0.3, 101, False), (1.0, 5, True)])
def test_noise_of_powers_is_not_called_places_only(noise_db, seed, place):
    """No error depends on places here; with much noise in the powers, the curve is too flat, which has a similar
    effect.
    """
    radio = {"first_path_at_1m_dbm": -78.0, "shadowing_db": 0.0, "saturation_dbm": -50.0, "power_noise_db": noise_db}
    settings = {"run.duration_s": 12.0, "run.seed": seed} | {f"radio.{name}": value for name, value in radio.items()}
    warnings = calib.fit(uwbsim.simulate(uwbsim.load("broadcast", settings))).warnings
    places = [text for text in warnings if text.startswith(("errors depend", "ranges grow", "pair"))]
    assert ["or the powers are noisy" in text for text in places] == [True] * place


# A long recording is examined in stretches of time, and its faults are detected in them.


PLAN = Plan(seconds=300, per_second=80)
EXAMINED_EXCHANGES, EXAMINED_STRETCHES = 6_000, 12


@pytest.fixture
def short_stretches(monkeypatch):
    monkeypatch.setattr(recording_view, "EXAMINED_EXCHANGES", EXAMINED_EXCHANGES)
    monkeypatch.setattr(recording_view, "EXAMINED_STRETCHES", EXAMINED_STRETCHES)


@pytest.fixture(scope="module")
def flight():
    return fly(PLAN, 51)


@pytest.fixture(scope="module")
def path(flight, tmp_path_factory):
    return save(flight, tmp_path_factory.mktemp("long") / "long.uwb")


@pytest.mark.usefixtures("short_stretches")
def test_stretches_cover_the_recording_and_have_all_poses(flight, path):
    with uwblink.Recording.open(path) as recording:
        looked = recording_view.select_part(RecordedSource(recording))
    x, every = looked.exchanges, flight.exchanges
    assert len(every) == 24_000
    assert len(x) == pytest.approx(EXAMINED_EXCHANGES, rel=0.02)
    assert np.count_nonzero(np.diff(x.time_ns) > 1_000_000_000) == EXAMINED_STRETCHES - 1
    assert (x.time_ns[0], x.time_ns[-1]) == (every.time_ns[0], every.time_ns[-1])
    ends = x.initiator, x.target, x.time_ns
    np.testing.assert_array_equal(
        distances_m(looked.poses, looked.tags, *ends), distances_m(flight.poses, flight.tags, *ends)
    )


@pytest.mark.usefixtures("short_stretches")
def test_sound_recordings_have_no_finding_and_the_examined_part_is_stated(path):
    assert calib.examine(path) == []
    assert examined_part(24_000) == (
        "about 6000 of its 24000 exchanges were examined, in 12 stretches over all of its time"
    )


@pytest.mark.slow
@pytest.mark.usefixtures("short_stretches")
def test_late_poses_are_found_with_their_delay(flight, tmp_path):
    late = replace(flight.poses, time_ns=flight.poses.time_ns + 400_000_000)
    (finding,) = calib.examine(save(replace(flight, poses=late), tmp_path / "late.uwb"))
    assert (finding.fault, bool(re.search(r"-0\.(400 s|39)", finding.evidence))) == ("pose time offset", True)


@pytest.mark.usefixtures("short_stretches")
def test_short_recordings_are_examined_completely(path, monkeypatch):
    monkeypatch.setattr(recording_view, "EXAMINED_EXCHANGES", 24_000)
    with uwblink.Recording.open(path) as recording:
        assert len(recording_view.select_part(RecordedSource(recording)).exchanges) == 24_000
    assert examined_part(24_000) == ""
