"""Plans of flights, compared with counting and with fits of flights; and plans that are refused."""

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import calib
from calib.planning import FlightPlanSettings, flights
from calib.planning.reference_motion import reference_motion
from tests import processes
from tests.calib.trajectories.sines import CORNERS, flight

ANCHORS = (11, 12, 13, 14)
C_M_PER_NS = 0.299702547


def rehearsed(**other: Any) -> Any:
    given: Any = {"robots": ((1, 2), (3, 4)), "anchors": ANCHORS, "seconds": 6.0, "rate_hz": 50.0}
    return reference_motion(FlightPlanSettings(**(given | other)))


def planned(seen, *, noise_m=0.04, reflected=0.08, curve=True, force=None, **usable):
    errors = flights.ExpectedErrors(noise_m=noise_m, reflected=reflected)
    return flights.Information(
        flights.flight_of(seen, calib.FlightSettings(**usable), errors, curve=curve, force_std_m_s2=force)
    )


def mean_ns(seen, **given):
    """Return the root mean variance of the delays."""
    return math.sqrt(np.mean(np.diag(planned(seen, **given).covariance_ns2)))


def test_noise_alone_informs_by_its_inverse_variance_and_reflected_ranges_by_less():
    plain = flights.ExpectedErrors(noise_m=0.05, reflected=0.0).informed()
    assert plain == pytest.approx(0.05**-2, rel=1e-3)
    # A reflected range has nearly no information; a few that look direct reduce the information of the direct ones.
    assert 0.6 * 0.7 * plain < flights.ExpectedErrors(noise_m=0.05, reflected=0.3).informed() < 0.7 * plain


def test_with_everything_known_a_plan_is_a_fit_with_known_distances():
    """If all positions are known exactly, the covariance is that of least squares on delays alone."""
    exact = planned(flight(seconds=8.0), heading_std_deg=0.0, reflected=0.0, curve=False).flight
    object.__setattr__(exact.scene.places, "std_m", np.full(len(exact.scene.places.std_m), 1e-5))
    found = flights.Information(exact)
    rows = 0.5 * C_M_PER_NS * (exact.scene.ranges.ends[:, :, None] == np.array(found.tags)).sum(axis=1)
    assert found.covariance_ns2 == pytest.approx(np.linalg.inv(rows.T @ rows / 0.04**2), rel=0.02, abs=1e-7)


@pytest.mark.slow
def test_plans_agree_with_fits_of_flights():
    """One flight: the intervals of the fit, which also estimates errors and smoothness, agree within a fifth."""
    seen = flight(seconds=12.0, seed=1, wander_deg=3.0, tilt_deg=1.0, place_noise_m=0.02)
    found = planned(seen, poses_until_s=6.0)
    fitted = calib.fit_from_ranges(seen, poses_until_s=6.0).calibration.delays_std_ns
    assert found.verdict.named("delay") == ()
    stated, expected = (np.sqrt(np.mean(np.square(std))) for std in ([*fitted.values()], found.verdict.std))
    assert stated == pytest.approx(expected, rel=0.2)


def test_plans_of_similar_flights_agree():
    like = rehearsed(robots=3, anchors=(), rate_hz=80.0, seconds=16.0, apart_m=0.68, speed_m_s=0.7)
    seen = mean_ns(flight(seconds=16.0), poses_until_s=6.0)
    assert mean_ns(like, poses_until_s=6.0) == pytest.approx(seen, rel=0.2)


def test_undetermined_delays_are_named_and_measurements_ranked():
    short: Any = {"seconds": 11.0, "rate_hz": 40.0}
    plan, seen = calib.plan_flight(3, poses_until_s=0.0, **short), rehearsed(robots=3, anchors=(), **short)
    assert (plan.undetermined, set(plan.half_ns.values())) == ((1, 2, 3, 4, 5, 6), {math.inf})
    told = {best.what: best.mean_ns for best in plan.next_best}
    assert [*told.values()] == sorted(told.values())
    best_ns = 1.96 * mean_ns(seen, poses_until_s=10.0)
    assert next(iter(told)) == "positions known for the first 10 s"
    assert plan.next_best[0].mean_ns == pytest.approx(best_ns, rel=0.01)
    elsewhere = next(what for what in told if what.startswith("the delay of tag"))
    # Every delay is known to 1.5 ns beforehand, and this one to 0.05 ns.
    known = np.eye(6) / 1.5**2
    known[int(elsewhere.split()[4]) - 1] *= 1 + 1.5**2 / 0.05**2
    left = np.trace(np.linalg.inv(np.linalg.inv(planned(seen, poses_until_s=0.0).covariance_ns2) + known)) / 6
    assert told[elsewhere] == pytest.approx(1.96 * math.sqrt(left), rel=1e-3)


@pytest.mark.parametrize("until_s", [4.0, None])
def test_two_sides_stay_open_as_in_a_fit(until_s):
    """Ranges between two robots determine sums of delays, also where all positions are known."""
    plan = calib.plan_flight(2, seconds=6.0, poses_until_s=until_s)
    assert plan.undetermined == (1, 2, 3, 4)
    assert plan.verdict.free == ("delays of 1 and 2 against delays of 3 and 4",)


def test_sought_anchors_stay_open_and_given_ones_do_not():
    seen = flight(seconds=8.0, anchors=CORNERS, rate=60)
    sought = calib.plan_flight(seen, poses_until_s=3.0, anchor_places="sought")
    assert (sought.undetermined, sought.next_best[0].what) == (ANCHORS, "measured positions of the anchors")
    assert 1.96 * mean_ns(seen, poses_until_s=3.0) == pytest.approx(sought.next_best[0].mean_ns, rel=0.02)


@pytest.fixture(scope="module")
def base_ns():
    """Result for a flight of six seconds, of which positions are known for two."""
    return mean_ns(rehearsed(), poses_until_s=2.0)


@pytest.mark.parametrize(
    ("flown", "changes", "least", "most"),
    [
        ({}, {"noise_m": 0.02}, 0.5, 0.9),
        ({}, {"reflected": 0.0}, 0.5, 1.0),
        ({}, {"heading_std_deg": 0.5}, 0.3, 1.0),
        ({}, {"poses_until_s": 4.0}, 0.3, 1.0),
        ({}, {"anchors": "sought"}, 1.0, 100.0),
        ({"seconds": 12.0}, {}, 0.3, 1.0),
    ],
)
def test_better_known_facts_never_widen_intervals(base_ns, flown, changes, least, most):
    assert least < mean_ns(rehearsed(**flown), **({"poses_until_s": 2.0} | changes)) / base_ns < most


def test_accelerometers_bridge_few_ranges():
    few: Any = {"rate_hz": 12.0, "seconds": 10.0}
    plan = calib.plan_flight(2, anchors=ANCHORS, imu="consumer", poses_until_s=4.0, **few)
    seen = rehearsed(**few, imu="consumer")
    # A grade states the noise over a tenth of a second, and the effect of propellers.
    graded = 3 * math.hypot(3e-3 / math.sqrt(0.1), 0.2)
    good, poor, none = (mean_ns(seen, poses_until_s=4.0, force=force) for force in (0.02, graded, None))
    assert np.sqrt(np.mean(np.square(list(plan.open_ns.values())))) == pytest.approx(1.96 * poor, rel=1e-4)
    assert good < 0.97 * none
    assert good < poor < 1.05 * none


def test_planned_roughness_of_trajectories_is_that_of_the_motion(monkeypatch):
    """Compared with third differences of the poses."""
    seen = rehearsed(robots=3, anchors=(), rate_hz=20.0, seconds=16.0)
    time = seen.poses.time_ns[seen.poses.body == "robot1"] * 1e-9
    jerks = [
        np.diff(seen.poses.position_m[seen.poses.body == f"robot{k}"], n=3, axis=0) / np.diff(time)[0] ** 3
        for k in (1, 2, 3)
    ]
    inside = (time[:-3] > 1.0) & (time[:-3] < 15.0)
    # A spline with points 0.4 s apart removes some of the fastest part.
    expected = math.sqrt(np.mean([j[inside] ** 2 for j in jerks]))
    assert planned(seen, poses_until_s=8.0).jerk_m_s3 == pytest.approx(expected, rel=0.15)
    # Trajectories without other constraints have less information from few ranges; a curve that so few ranges do not
    # determine is fixed by a weight of 1e15, and rounding must not spoil the rest.
    few = rehearsed(rate_hz=8.0, seconds=20.0)
    held = mean_ns(few, poses_until_s=5.0)
    monkeypatch.setattr(flights, "_jerk", lambda *_: 50.0)
    assert 1.1 * held < mean_ns(few, poses_until_s=5.0) < 2 * held


def test_a_distance_of_robots_at_rest_determines_the_common_delay():
    given: Any = {"seconds": 8.0, "rate_hz": 30.0, "poses_until_s": 0.0, "still_s": 4.0, "delays_only": True}
    free, taped = calib.plan_flight(2, **given), calib.plan_flight(2, taped=1, **given)
    assert free.common_ns > max(0.7, taped.common_ns / 0.3)
    said = next(best for best in free.next_best if best.what.startswith("a measured distance"))
    (pair,) = taped.taped
    assert said.what == f"a measured distance of tags {pair[0]} and {pair[1]}"
    assert said.mean_ns == pytest.approx(taped.next_best[0].instead_of_ns, rel=1e-6)
    assert f"--distance {pair[0]}-{pair[1]}=METRES@0..4" in "\n".join(taped.commands("PORTS"))


@pytest.mark.slow
def test_the_best_measured_distance_is_the_best_of_all():
    seen = planned(rehearsed(), poses_until_s=4.0, anchors="sought")
    pairs = [(a, b) for a in ANCHORS for b in ANCHORS if a < b]
    spread = [np.trace(flights.Information(seen.flight.taped([pair], 0.0, 0.01)).covariance_ns2) for pair in pairs]
    assert seen.best_tape(0.0, 0.01) == pairs[int(np.argmin(spread))]


def test_ranges_readings_and_poses_of_a_plan_are_one_motion():
    """Ranges are those of poses and lever arms; readings are the second derivative of the poses."""
    seen = rehearsed(robots=((1, 2), (7,)), anchors=(9,), imu="consumer", seconds=8.0, still_s=2.0, seed=3)
    ranges = calib.load_ranges(seen)
    assert np.unique(np.sort(ranges.ends), axis=0).tolist() == [[1, 7], [1, 9], [2, 7], [2, 9], [7, 9]]
    # A tick of the clock is 2 mm of range, and poses are interpolated.
    assert np.abs(ranges.raw_m - ranges.truth_m).max() < 0.01
    mine, read = seen.poses[seen.poses.body == "robot1"], seen.imu["body"] == "robot1"
    time = mine.time_ns * 1e-9
    bend = np.gradient(np.gradient(mine.position_m[:, 2], time), time)
    force = np.interp(time, seen.imu["time_ns"][read] * 1e-9, seen.imu["az"][read]) - 9.81
    inside = (time > -0.9) & (time < 7)
    assert np.ptp(mine.position_m[time < 2.0], axis=0).max() < 1e-9
    assert force[inside] == pytest.approx(bend[inside], abs=0.02)
    assert np.ptp(mine.position_m, axis=0).max() < 6.0


def test_the_command_prints_steps_and_options_of_the_fit():
    words = ["plan", "flight", "1,2/5", "--duration", "5", "--anchor-tags", "11,12,13,14", "--rate", "30"]
    printed = processes.succeed("calib", *words, "--poses-until", "0", "--heading-std", "1").stdout
    fit = "calib fit flight.uwb --truth ranges --poses-until 0 --heading-std 1 --anchors given -o calibration.json\n"
    assert ("tags 1 and 2 on robot 1, 5 on robot 2." in printed, printed.endswith(fit)) == (True, True)
    told = json.loads(processes.succeed("calib", *words, "--json").stdout)
    assert sorted(told["half_interval_ns"], key=int) == ["1", "2", "5", "11", "12", "13", "14"]
    assert told["next_best"][0]["mean_ns"] < told["next_best"][0]["instead_of_ns"]


@pytest.mark.parametrize(
    ("plan", "count", "settings", "message"),
    [
        (calib.plan, 1, {}, "boards"),
        *((calib.plan, wrong, {}, "boards") for wrong in ([1, 1], [-1, 2], [1, 70000], [1.5, 2], "abc", 3.5)),
        *((calib.plan, 4, {"seed": wrong}, "seed") for wrong in (-1, 1.5)),
        (calib.plan, 4, {"on": "ring"}, "on"),
        (calib.plan, 4, {"arrangements": 0}, "arrangements"),
        *((calib.plan, 4, {"size_m": wrong}, "size_m") for wrong in ((1.0, 2.0), 3.0)),
        (calib.plan, 4, {"taped": -1}, "taped"),
        (calib.plan, 4, {"tape_sigma_m": 0.0}, "tape_sigma_m"),
        (calib.plan, 4, {"pair_error_m": math.nan}, "pair_error_m"),
        (calib.plan, 4, {"reflected": 0.4}, "reflected"),
        (calib.plan, 4, {"on": "plane", "anchors": [9]}, "anchors"),
        (calib.plan, 4, {"on": "line", "anchors": [1]}, "anchors"),
        (calib.plan, 4, {"on": "plane", "anchors": [1, 2, 1]}, "anchors"),
        (calib.plan, 4, {"on": "plane", "anchors": 3}, "`anchors`"),
        (calib.plan, 4, {"rate_hz": 0.0}, "rate_hz"),
        (calib.plan, 30, {"on": "plane", "size_m": (0.5, 0.5)}, "there is no room"),
        (calib.plan_flight, 0, {}, "robots"),
        (calib.plan_flight, 1, {}, "has no partner for ranges"),
        (calib.plan_flight, [[1, 2], [2]], {}, "robots"),
        (calib.plan_flight, [[1], []], {}, "robots"),
        (calib.plan_flight, [[-1], [2]], {}, "robots"),
        (calib.plan_flight, ["ab", "c"], {}, "`robots`"),
        (calib.plan_flight, 3, {"anchors": [1]}, "anchors"),
        (calib.plan_flight, 3, {"anchors": "11"}, "`anchors`"),
        (calib.plan_flight, 3, {"seconds": 1.0}, "seconds"),
        (calib.plan_flight, 3, {"seconds": 3600.0}, "too many for a plan"),
        (calib.plan_flight, 3, {"rate_hz": math.nan}, "rate_hz"),
        (calib.plan_flight, 3, {"speed_m_s": 0.0}, "speed_m_s"),
        (calib.plan_flight, 3, {"apart_m": -1.0}, "apart_m"),
        (calib.plan_flight, 3, {"size_m": (3.0, 2.0)}, "size_m"),
        (calib.plan_flight, 3, {"noise_m": 0.0}, "noise_m"),
        (calib.plan_flight, 3, {"taped": -1}, "taped"),
        (calib.plan_flight, 3, {"taped": 1, "seconds": 8.0}, "only 0 distances can be measured"),
        (calib.plan_flight, 3, {"still_s": -1.0}, "still_s"),
        (calib.plan_flight, 3, {"still_s": 40.0}, "still_s"),
        (calib.plan_flight, 3, {"tape_sigma_m": 0.0}, "tape_sigma_m"),
        (calib.plan_flight, 3, {"reflected": 1.0}, "reflected"),
        (calib.plan_flight, 3, {"imu": "good"}, "imu"),
        (calib.plan_flight, 3, {"attitudes": "eyes"}, "attitudes"),
        (calib.plan_flight, 3, {"anchor_places": "lost"}, "anchor_places"),
        (calib.plan_flight, 3, {"poses_until_s": -1.0}, "poses_until_s"),
        (calib.plan_flight, 3, {"seconds": 5.0, "rate_hz": 1.0}, "too few"),
    ],
)
def test_what_cannot_be_planned_is_refused(plan, count, settings, message):
    with pytest.raises(ValueError, match=message):
        plan(count, **settings)


def test_a_flight_whose_poses_lack_is_refused_in_one_line():
    seen = flight(seconds=6.0)
    with pytest.raises(calib.UnanswerableError, match="no positions of body robot1"):
        calib.plan_flight(replace(seen, poses=seen.poses[seen.poses.body != "robot1"]))


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("flight a.uwb --duration 60", "--duration"),
        ("flight three", "COUNT"),
        ("flight 1,2/", "COUNT"),
        ("survey 1.5,2", "COUNT"),
        ("survey nan", "COUNT"),
        ("survey 4 --on sky", "--on"),
        ("survey flight.uwb", "COUNT"),
        ("survey 4 --size x", "--size"),
        ("survey 4 --on plane --anchor-tags 9", "--anchor-tags"),
        ("flight 3 --range-noise -1", "--range-noise"),
        ("flight 3 --anchors lost", "--anchors"),
    ],
)
def test_wrong_plans_name_the_option(words, named):
    processes.refuse("calib", "plan", *words.split(), naming=[named])


def test_four_anchors_more_are_at_known_places_whatever_is_said_of_anchors_that_there_are_not():
    short: Any = {"seconds": 6.0, "rate_hz": 20.0, "poses_until_s": 0.0}
    plans = (calib.plan_flight(2, **short, anchor_places=places) for places in ("given", "sought"))
    told = [{best.what: best.mean_ns for best in plan.next_best}["4 anchors at known positions"] for plan in plans]
    assert told[0] == pytest.approx(told[1], rel=1e-9)
