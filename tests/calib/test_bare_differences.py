"""Differences of arrival without stamps, from a table to a calibration and a track.

NumPy alone, without the packages, makes the table: a tag flies among eight anchors with planted delays, and logs the
difference of its distances to two anchors.
"""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import calib
import uwblink
from calib.evaluation import Settings, summarize
from tests import processes
from tests.calib.evaluation.inertial import table

ANCHORS = np.array([(-4.0, -3.5, 0.3), (4.0, -3.5, 2.8), (4.0, 3.5, 0.4), (-4.0, 3.5, 2.9), (0.0, -3.5, 2.6),
                    (4.0, 0.0, 0.2), (0.0, 3.5, 2.4), (-4.0, 0.0, 0.5)])  # fmt: skip
DELAYS_NS = np.array([0.31, -0.42, 0.12, -0.25, 0.48, -0.06, -0.33, 0.22])
METRES_A_NS = 0.299702547
TAG = 20
NOISE_M = 0.1
FIT = ("--use", "receptions", "--delays-only")


def place_m(time_s):
    return np.column_stack([2.5 * np.sin(0.5 * time_s), 2.2 * np.cos(0.37 * time_s), 1.4 + 0.7 * np.sin(0.29 * time_s)])


def flown(seed, seconds, *, reflected=0.05):
    """Return times, ids from 1 and differences: distance to the second anchor minus that to the first, with noise and
    reflections.
    """
    random, time_s = np.random.default_rng(seed), np.arange(0, seconds, 1 / 160)
    row = np.arange(len(time_s))
    first, second = row % 8, (row + 1 + row // 8 % 7) % 8
    to_first, to_second = (np.linalg.norm(ANCHORS[k] - place_m(time_s), axis=1) for k in (first, second))
    noise = NOISE_M * random.normal(size=len(row)) - METRES_A_NS * (DELAYS_NS[second] - DELAYS_NS[first]) / 2
    late = random.exponential(0.5, len(row)) * random.choice([-1, 1], len(row))
    late *= random.random(len(row)) < reflected
    return time_s, first + 1, second + 1, to_second - to_first + noise + late


def imported(folder, rows, *, swapped=False, mocap=True):
    """Return the path of a recording of a flight, from a table of differences, poses of the tag and positions of the
    anchors; `swapped` by a map with the other sign.
    """
    folder.mkdir(exist_ok=True)
    lines = [f"{t:.6f},{TAG},{a},{b},{d:.12g}" for t, a, b, d in zip(*rows, strict=True)]
    (folder / "d.csv").write_text("\n".join(["time_s,tag,anchor_a,anchor_b,difference_m", *lines, ""]))
    around = np.arange(rows[0][0] - 0.5, rows[0][-1] + 0.5, 0.01)
    poses = np.column_stack([around, place_m(around)]).tolist()
    lines = [f"{t:.6f},tag20,{x:.6f},{y:.6f},{z:.6f},0,0,0,1" for t, x, y, z in poses]
    (folder / "poses.csv").write_text("\n".join(["time_s,body,x,y,z,qx,qy,qz,qw", *lines, ""]))
    places = [f"[[anchors]]\nid = {k}\nposition_m = {at.tolist()}\n" for k, at in enumerate(ANCHORS, 1)]
    (folder / "tags.toml").write_text(f'[[tags]]\nid = {TAG}\nbody = "tag20"\n{"".join(places)}')

    def run(words):
        processes.succeed("uwblink", *words.split(), cwd=folder)

    run("import guess d.csv -o map.toml")
    if swapped:
        text = (folder / "map.toml").read_text()
        (folder / "map.toml").write_text(re.sub("(?<=anchor_)[ab]", lambda end: {"a": "b", "b": "a"}[end[0]], text))
    run("import csv d.csv -o d.uwb --map map.toml")
    run(f"poses d.uwb --tags tags.toml {'--from poses.csv' if mocap else ''}")
    return folder / "d.uwb"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two recordings, fit/d.uwb and fly/d.uwb, and a fit of the first: fit.json, and fit.out and fit.err as printed."""
    found = tmp_path_factory.mktemp("differences")
    imported(found / "fit", flown(1, 60.0))
    imported(found / "fly", flown(2, 20.0))
    done = processes.succeed("calib", "fit", "fit/d.uwb", "-o", "fit.json", *FIT, cwd=found)
    (found / "fit.out").write_text(done.stdout)
    (found / "fit.err").write_text(done.stderr)
    return found


@pytest.fixture(scope="module")
def fly(folder):
    return uwblink.load(folder / "fly/d.uwb")


def test_differences_determine_delays_minus_their_mean(folder):
    known = calib.load_calibration(folder / "fit.json")
    found, std = np.array([(known.delays_ns[tag], known.std_of_sum_ns([tag])) for tag in range(1, 9)]).T
    # Each anchor is in a quarter of 9600 rows, with half of its delay: 0.1 m/sqrt(2400)/0.15 m/ns = 0.0136 ns; the
    # delays of partners, the loss and 5 % of reflections increase this by at most a half.
    assert np.all((std > 0.012) & (std < 0.022))
    scores = (found - (DELAYS_NS - DELAYS_NS.mean())) / std
    assert np.all(np.abs(scores) < 4)
    assert np.sqrt(np.mean(scores**2)) < 1.8, "99.9 % of the roots of chi-square over seven"
    assert (set(known.delays_std_ns.values()), known.undetermined_splits) == ({np.inf}, (((), tuple(range(1, 9))),))
    # The noise is that of a difference.
    assert known.sigma_curve(np.ones(1))[0] == pytest.approx(NOISE_M, rel=0.05)


def test_the_fit_names_undetermined_delays(folder):
    printed, warned = ((folder / name).read_text() for name in ("fit.out", "fit.err"))
    assert "0 exchanges, 9600 differences of arrival" in printed
    assert printed.count("less the mean of all") == 8
    assert re.search(r"(?s)only differences of arrival from tags 1, 2, 3.*a common shift of", warned)
    pinned = calib.fit(folder / "fit/d.uwb", use="receptions", delays_only=True, fixed_ns={1: DELAYS_NS[0]}).calibration
    assert not pinned.undetermined_splits
    found, std = np.array([(pinned.delays_ns[tag], pinned.delays_std_ns[tag]) for tag in range(2, 9)]).T
    assert np.all(np.abs(found - DELAYS_NS[1:]) < 4 * std)
    assert 4 * std.max() < 0.13


def test_differences_are_shown_and_not_streamed(folder):
    assert re.search(
        r"d\.uwb: 9600 differences in (59\.9|60\.0) s\n",
        processes.succeed("uwblink", "show", folder / "fit/d.uwb").stdout,
    )
    processes.refuse("uwblink", "stream", folder / "fit/d.uwb", naming=["d.uwb", "9600 differences", "no ranges"])
    said = processes.succeed("calib", "doctor", folder / "fit/d.uwb").stdout
    assert re.search(r"(?s)alone.*9600 differences of arrival and no exchanges.*calib fit --use receptions", said)


def test_antenna_delays_are_not_invented(folder, fly):
    fly.save(folder / "written.uwb", force=True)
    for name in ("fly/d.uwb", "written.uwb"):
        assert "antenna_delay" not in processes.succeed("uwblink", "show", folder / name).stdout


def test_undetermined_differences_are_not_corrected(folder):
    ranges = calib.Ranges.from_arrays([3.0] * 5, initiator=1, target=2)
    with pytest.raises(calib.CalibError, match="only differences of arrival"):
        calib.load_calibration(folder / "fit.json").apply(ranges)


@pytest.mark.slow
def test_a_tag_is_localized_by_differences(folder):
    words = "calib localize fly/d.uwb -c fit.json --use receptions --seeds 1 --json"
    (one,) = json.loads(processes.succeed(*words.split(), cwd=folder).stdout)["scenarios"]
    assert one["arrivals"] == 3200
    assert one["rmse_m"]["robust"] < 0.04
    assert one["rmse_m"]["variance"] < 0.045 < 0.08 < one["rmse_m"]["raw"]


@pytest.mark.slow
@pytest.mark.parametrize(("model", "used", "most_m"), [("constant-velocity", "", 0.1), ("imu", ", imu", 0.06)])
def test_the_tag_is_tracked_on_board(folder, fly, model, used, most_m):
    time_s, step_s = np.arange(0, 20.0, 0.01), 1e-3
    bend = (place_m(time_s + step_s) - 2 * place_m(time_s) + place_m(time_s - step_s)) / step_s**2
    read = np.hstack([0 * bend, bend + np.array([0.0, 0.0, 9.80665])])
    imu = table(np.rint(time_s * 1e9).astype(np.int64), ["tag20"], read)
    settings = calib.OnboardSettings(model=model, use="receptions")
    (found,) = calib.localize_onboard(replace(fly.select(stop_s=6.0), imu=imu), folder / "fit.json", settings)
    assert (found.used, found.restarts_s) == (f"differences of arrival{used}", ())
    assert found.rmse_m < most_m


@pytest.mark.slow
def test_a_calibration_of_ranges_corrects_differences(folder):
    """Its noise is that of a range; a difference has five times the variance."""
    time_s = np.arange(0, 60.0, 1 / 80)
    anchor = np.arange(len(time_s)) % 8
    truth = np.linalg.norm(ANCHORS[anchor] - place_m(time_s), axis=1)
    noise = np.random.default_rng(5).normal(size=len(time_s)) * NOISE_M / 5**0.5
    ranges = calib.Ranges.from_arrays(
        truth - METRES_A_NS * (DELAYS_NS[anchor] + 0.1) / 2 + noise, initiator=TAG, target=anchor + 1, truth_m=truth,
        time_ns=np.rint(time_s * 1e9).astype(np.int64),
    )  # fmt: skip
    known = calib.fit(ranges, delays_only=True, fixed_ns={TAG: 0.1}, between_m=0.0).calibration
    total = summarize(calib.localize(folder / "fly/d.uwb", known, Settings(use="receptions", seeds=1)))
    assert total.rmse_m["variance"] < 0.045 < 0.08 < total.rmse_m["raw"]
    # The bounds, 2.5 and 3.5, contain 95 %: 0.9 is 3.5 standard deviations. With half of the variance it would be 6.
    assert total.nees == pytest.approx(3.0, abs=0.9)


@pytest.fixture(scope="module")
def swapped(folder):
    return imported(folder / "swapped", flown(3, 8.0), swapped=True).parent


@pytest.mark.parametrize(
    "words", [("fit", "-o", "x.json", *FIT), ("localize", "-c", "../fit.json", "--use", "receptions")]
)
def test_the_wrong_sign_is_detected_with_poses(swapped, words):
    naming = ["d.uwb", "the wrong sign", "from_id", "to_id"]
    processes.refuse("calib", words[0], "d.uwb", *words[1:], cwd=swapped, naming=naming)
    assert not (swapped / "x.json").exists()


@pytest.mark.parametrize(
    ("factor", "blind", "words"),
    [
        (-1.0, False, "the wrong sign"),
        (1 / METRES_A_NS, False, "nanoseconds"),
        (100.0, False, "centimetres"),
        (100.0, True, "longer than the distances of their anchors"),
    ],
)
def test_another_unit_or_sign_is_found_before_a_fit(fly, factor, blind, words):
    some = replace(fly, poses=fly.poses[fly.poses.body != "tag20"]) if blind else fly
    assert [one.fault for one in calib.examine(some)] == ["differences alone"]
    other = {**some.differences, "difference_m": factor * some.differences["difference_m"]}
    (found,) = calib.examine(replace(some, differences=other))
    assert found.fault == "wrong differences of arrival"
    assert re.match(f"by its poses .*{words}", found.evidence)
    with pytest.raises(calib.CalibError, match=words):
        calib.load_ranges(replace(some, differences=other), need_power=False, use="receptions")


def test_numbers_that_are_no_differences_are_left_out_and_counted(fly):
    other = fly.differences["difference_m"].copy()
    other[::50] = np.resize([1e300, -1e300, np.nan], len(other[::50]))
    changed = replace(fly, differences={**fly.differences, "difference_m": other})
    found = calib.load_ranges(changed, need_power=False, use="receptions")
    assert found.excluded["no range within 10 km"] == 64


@pytest.mark.slow
def test_the_wrong_sign_has_a_warning_without_poses(folder):
    rows = flown(4, 4.0)
    words = ("-c", folder / "fit.json", "--use", "receptions", "--model", "constant-velocity")
    for name, swapped in (("blind", True), ("right", False)):
        path = imported(folder / name, rows, swapped=swapped, mocap=False)
        assert ("wrong unit or sign" in processes.succeed("calib", "localize", path, *words).stdout) == swapped


@pytest.mark.parametrize(
    ("words", "naming", "status"),
    [
        (("fit", "d.uwb", "-o", "x.json", "--use", "receptions"), ["d.uwb", "powers", "--delays-only"], 1),
        (("fit", "d.uwb", "-o", "x.json", "--delays-only"), ["d.uwb", "3200 differences", "--use receptions"], 1),
        (("evaluate", "d.uwb", "-c", "../fit.json"), ["d.uwb", "3200 differences", "no exchanges"], 1),
        (("localize", "d.uwb", "-c", "../fit.json"), ["d.uwb", "3200 differences", "--use receptions"], 1),
        (("apply", "d.uwb", "-c", "../fit.json", "-o", "x.uwb"), ["d.uwb", "3200 differences", "--use receptions"], 2),
    ],
)
def test_options_that_exclude_differences_are_refused(folder, words, naming, status):
    processes.refuse("calib", *words, cwd=folder / "fly", naming=naming, status=status)
    assert [path.name for path in (folder / "fly").glob("x.*")] == []


@pytest.mark.parametrize(
    ("words", "plus", "naming"),
    [
        (("fit", "-o", "x.json", *FIT), 77, ["anchor 77", "no position"]),
        (("localize", "-c", "fit.json", "--use", "receptions"), 77, ["anchor 77", "no position"]),
        (("fit", "-o", "x.json", *FIT), None, ["at both ends"]),
    ],
)
def test_an_anchor_without_a_place_or_with_itself_is_named(folder, fly, words, plus, naming):
    wrong = {name: column.copy() for name, column in fly.differences.items()}
    wrong["plus"][7] = wrong["minus"][7] if plus is None else plus
    replace(fly, differences=wrong).save(folder / "wrong.uwb", force=True)
    processes.refuse("calib", words[0], "wrong.uwb", *words[1:], cwd=folder, naming=["wrong.uwb", *naming], status=2)


@pytest.mark.slow
def test_ranges_and_differences_are_used_together_and_fitted_apart(folder, fly):
    time_s = np.arange(0.1, 19.0, 0.1)
    truth = np.linalg.norm(ANCHORS[0] - place_m(time_s), axis=1)
    ranges = uwblink.Exchanges.from_arrays(TAG, 1, time_ns=np.rint(time_s * 1e9).astype(np.int64), range_m=truth)
    both = replace(fly, exchanges=ranges)
    with pytest.raises(calib.CalibError, match="fit them separately"):
        calib.fit(both, use="receptions", delays_only=True)
    delays_ns = dict(zip((*range(1, 9), TAG), (*DELAYS_NS, -DELAYS_NS[0]), strict=True))
    known = replace(calib.load_calibration(folder / "fit.json"), delays_ns=delays_ns, undetermined_splits=())
    (found,) = calib.localize(both, known, Settings(use="receptions"))
    both.save(folder / "both.uwb", force=True)
    with pytest.warns(calib.errors.LeftOutWarning, match="3200 differences of arrival"):
        assert calib.apply(folder / "both.uwb", known, folder / "both-corrected.uwb", force=True).count == len(time_s)
    assert (found.arrivals, len(found.tracks["raw"].time_ns)) == (3200, 3200 + len(time_s))
    assert found.rmse_m["variance"].mean() < 0.045


def test_a_recording_keeps_bare_differences(folder, fly):
    for words in ("export fly/d.uwb --to csv -o exported", "import exported exported -o again.uwb"):
        processes.succeed("uwblink", *words.split(), cwd=folder)
    again = uwblink.load(folder / "again.uwb").differences
    assert all(np.array_equal(again[name], column) for name, column in fly.differences.items())
    some = fly.select(start_s=5.0, stop_s=6.0).differences
    assert (len(some["time_ns"]), some["time_ns"][0]) == (160, fly.differences["time_ns"][0] + 5 * 10**9)
    assert "also: differences 3200" in processes.succeed("uwblink", "show", "fly/d.uwb", cwd=folder).stdout


def test_delays_less_their_mean_are_drawn_with_their_intervals(folder):
    found = calib.fit(folder / "fly/d.uwb", use="receptions", delays_only=True)
    axes = found.plot_delays()
    assert [label.get_text() for label in axes.get_xticklabels()] == [str(tag) for tag in range(1, 9)]
    assert np.allclose(axes.get_lines()[0].get_ydata(), [found.calibration.delays_ns[tag] for tag in range(1, 9)])
