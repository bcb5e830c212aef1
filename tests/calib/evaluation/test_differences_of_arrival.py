"""Differences of arrival: corrections by hand, and localization of a robot that never sends, among eight anchors."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import BSpline

import calib
from calib.data.sources import load_flight
from calib.evaluation import IMUS, Settings, localization_json, localization_text, models, summarize, tracking
from tests import processes
from tests.calib.synthetic import calibration, track_errors
from uwbsim import Scenario, simulate

ANCHORS = [(-4.0, -3.5, 0.3), (4.0, -3.5, 2.8), (4.0, 3.5, 0.4), (-4.0, 3.5, 2.9), (0.0, -3.5, 2.6), (4.0, 0.0, 0.2),
           (0.0, 3.5, 2.4), (-4.0, 0.0, 0.5)]  # fmt: skip
# As measured: a standard deviation of 0.3 ns.
DELAYS_NS = {1: 0.31, 2: -0.42, 3: 0.12, 4: -0.25, 5: 0.48, 6: -0.06, 7: -0.33, 8: 0.22, 20: -0.4, 21: 0.15}
ROBOT = (20, 21)
BETWEEN_ANCHORS = list(itertools.combinations(range(1, 9), 2))
NOISY = {"antenna": "dipole", "shadowing_db": 1.5, "power_noise_db": 0.3, "bias": "icra2023", "sigma": "icra2023"}
LISTEN = Settings(use="receptions")


def flight(seed, duration_s, *, pairs=BETWEEN_ANCHORS, passive=ROBOT, radio=None):
    """Eight anchors and a robot with two tags; by default anchors range, and the robot listens."""
    robot = {"model": "random-flight", "box_min_m": [-3, -2.5, 0.5], "box_max_m": [3, 2.5, 2.5], "speed_mps": 0.8}
    arms = {20: [0.17, -0.17, -0.05], 21: [-0.17, 0.17, -0.05]}
    quiet = {"first_path_at_1m_dbm": -76.0, "rx_noise_ps": 0.0, "skew_noise_ppm": 0.0, "skew_bias_ppm": 0.0}
    anchors = [{"name": f"a{k}", "motion": {"model": "static", "position_m": at}} for k, at in enumerate(ANCHORS, 1)]
    tags = [
        {"id": tag, "body": "robot" if tag in ROBOT else f"a{tag}", "lever_arm_m": arms.get(tag, [0, 0, 0]),
         "delay_ns": delay, "skew_ppm": 0.8 * (tag * 37 % 11 - 5), "passive": tag in passive}
        for tag, delay in DELAYS_NS.items()
    ]  # fmt: skip
    return simulate(
        Scenario.model_validate(
            {
                "run": {"seed": seed, "duration_s": duration_s},
                "ranging": {"protocol": "ds", "rate_hz": 160.0, "pairs": pairs},
                "radio": quiet | (NOISY if radio is None else radio),
                "mocap": {"rate_hz": 100.0},
                "bodies": [*anchors, {"name": "robot", "motion": robot, "imu": {"grade": "industrial"}}],
                "tags": tags,
            }
        )
    )


@pytest.fixture(scope="module")
def known():
    """A calibration from a flight in which the robot ranges with the anchors, and these with each other."""
    return calib.fit(flight(3100, 60.0, pairs="between-bodies", passive=())).calibration


@pytest.fixture(scope="module")
def heard():
    return flight(3101, 20.0)


PLANTED = calibration(DELAYS_NS, 0.005)


def test_one_row_agrees_with_numpy(known, heard):
    x, h, row = heard.exchanges, heard.overheard, 1234
    ranges = calib.load_ranges(heard)
    found = known.correct_arrivals(ranges)
    own = {name: int(column[row]) for name, column in h.items() if column.dtype.kind == "i"}
    at = int(np.flatnonzero((x.tx1 == own["tx1_n"]) & (x.initiator == own["initiator"]))[0])
    i, j, k = own["initiator"], own["target"], own["listener"]
    mine = (ranges.arrivals.exchange == at) & (ranges.arrivals.listener == k)
    assert np.count_nonzero(mine) == 1

    def since(late, early):
        return (late - early) % 2**40

    reply, final = since(own["tx2_n"], own["rx1_n"]), since(own["tx3_n"], own["tx2_n"])
    second, third = since(own["rx2"], own["rx1"]), since(own["rx3"], own["rx2"])
    back, last = (since(int(x.rx2[at]), own["tx1_n"]), since(int(x.rx3[at]), int(x.rx2[at])))
    metres = 299702547.0 / (499.2e6 * 128)
    delay_m = {tag: 0.299702547 * ns for tag, ns in known.delays_ns.items()}
    powers = h["fpp1_n_dbm"][row], h["fpp2_n_dbm"][row], h["fpp1_dbm"][row], h["fpp2_dbm"][row]
    lifted = 10 ** ((np.array(powers) + 82) / 10)
    bias, sigma = (
        (lambda at, c=c: BSpline(c.knots, c.coefficients, c.degree)(np.clip(at, *c.range)))
        for c in (known.bias_curve, known.sigma_curve)
    )
    both = (lifted[0] + lifted[1]) / 2
    range_m = metres * (back - reply * last / final) / 2 + (delay_m[i] + delay_m[j] * last / final) / 2 - bias(both)
    difference = metres * (second * final / third - reply) - range_m + delay_m[j]
    difference -= bias(lifted[0]) + bias(lifted[3]) - bias(lifted[2])
    assert found.corrected_m[mine][0] == pytest.approx(difference, abs=1e-5)
    # The error of a reception at i has the weights 1 + s and s in the range, as that at k in the difference: s =
    # T12/T23.
    twice = (1 + second / third) ** 2 + (second / third) ** 2
    variance = sigma(both) ** 2 + 4 / (1 + twice) * (twice * sigma(lifted[3]) ** 2 + sigma(lifted[2]) ** 2)
    assert found.sigma_m[mine][0] == pytest.approx(np.sqrt(variance), rel=1e-4)
    assert found.shared_m[mine][0] == pytest.approx(sigma(both), rel=1e-9)


def test_without_noise_it_is_the_true_difference_and_the_robot_is_where_it_is():
    silent = flight(3110, 5.0, radio={"quantize": False})
    ranges = calib.load_ranges(silent)
    wrong = PLANTED.correct_arrivals(ranges).corrected_m - ranges.arrivals.truth_m
    # Stamps are whole ticks of 4.7 mm: each has an error of 1.4 mm, and a difference contains about four of them.
    assert abs(np.mean(wrong)) < 0.0005
    assert np.sqrt(np.mean(wrong**2)) < 0.004
    (found,) = calib.localize(silent, PLANTED, replace(LISTEN, velocity_std_mps=0.03, seeds=1))
    assert len(found.tracks["variance"].time_ns) == found.arrivals == len(wrong) == 1600
    assert np.sqrt(np.mean(track_errors(found.tracks["variance"], 1.0) ** 2)) < 0.004


@pytest.mark.slow
def test_a_robot_that_never_sends_is_localized(known, heard):
    flights = (heard, flight(3102, 20.0), flight(3103, 20.0))
    found = [one for each in flights for one in calib.localize(each, known, LISTEN)]
    total = summarize(found)
    assert [one.body for one in found] == ["robot"] * 3
    assert max(total.rmse_m["variance"], total.rmse_m["robust"]) < 0.045 < 0.09 < total.rmse_m["raw"]
    # The 95 % quantile of a chi-square over its degrees: three per value, for the number of independent values.
    assert total.nees_bounds[0] < total.nees < total.nees_bounds[1] < total.nees_bounds[0] + 1.0
    said = f"by 0 ranges and {3 * 6400} differences of arrival"
    assert localization_text(found, LISTEN).splitlines()[-1] == said
    assert [one["arrivals"] for one in localization_json(found)["scenarios"]] == [6400] * 3


@pytest.mark.slow
def test_constants_of_both_pairs_in_a_difference_are_followed(heard):
    (problem,), rng = tracking.problems(load_flight(heard)), np.random.default_rng(6)
    true_m, zero = problem.ranges.arrivals.truth_m[problem.rows - len(problem.ranges)], np.zeros(len(problem))
    offsets_m = np.sum(problem.sign * rng.normal(0, 0.1, problem.pair.max() + 1)[problem.pair], axis=1)
    one = models.FilterRanges(true_m + offsets_m + rng.normal(0, 0.05, len(zero)), zero + 0.05, zero, 0 * problem.sign)
    tracks = tracking.run_filters(
        problem, {"fixed": one, "own": replace(one, offset_m=0.1, rivals=1)}, replace(LISTEN, gate=1e9)
    )
    own, fixed = (np.mean([track.rmse_m for track in tracks[name]]) for name in ("own", "fixed"))
    assert own < 0.5 * fixed
    assert np.mean([track.nees.mean() for track in tracks["own"]]) < 4.5
    assert min(track.offsets[-1] for track in tracks["own"]) > 0.99


@pytest.mark.slow
def test_differences_alone_correct_a_wrong_start(known):
    settings = replace(LISTEN, initial_offset_m=(0.0, -8.0, 0.0), seeds=1)
    (found,) = calib.localize(flight(3104, 4.0), known, settings)
    for track in found.tracks.values():
        assert track_errors(track)[0] > 5
        assert track_errors(track, 2.0).max() < 0.5


@pytest.mark.slow
def test_what_is_overheard_helps_a_robot_that_ranges(known):
    """Its tags hear the anchors, the anchors hear it, and each of its tags hears the exchanges of the other."""
    all_hear = flight(3120, 15.0, pairs="between-bodies", passive=DELAYS_NS)
    ((ranging,), (both,)) = (calib.localize(all_hear, known, Settings(use=use)) for use in ("exchanges", "receptions"))
    ranges = len(ranging.tracks["raw"].time_ns)
    assert (ranging.arrivals, len(both.tracks["raw"].time_ns) - both.arrivals) == (0, ranges)
    rows = calib.load_ranges(all_hear)
    heard, own = rows.arrivals, np.isin([rows.initiator, rows.target], ROBOT).any(axis=0)
    assert both.arrivals == np.count_nonzero(np.isin(heard.listener, ROBOT) | own[heard.exchange])
    alone, total = summarize([ranging]), summarize([both])
    assert all(total.rmse_m[name] < 0.9 * alone.rmse_m[name] for name in ("variance", "robust"))
    assert total.nees_bounds[0] < total.nees < total.nees_bounds[1]


@pytest.mark.slow
def test_a_robot_on_board_is_helped_by_what_is_overheard(known):
    """Overheard by its own tags, by tags that hear it and that it hears, and by one of its tags from the other."""
    robot = flight(3121, 5.0, pairs="between-bodies", passive=DELAYS_NS)
    (alone,), (helped,) = (
        calib.localize_onboard(robot, known, calib.OnboardSettings(model="constant-velocity", use=use))
        for use in ("exchanges", "receptions")
    )
    assert [one.used for one in (alone, helped)] == ["ranges", "ranges, differences of arrival"]
    assert helped.rmse_m < 0.9 * alone.rmse_m
    # Lever arms are unknown without a heading, so innovations are smaller than stated.
    assert 0.7 < np.mean(helped.nis) < 1.1


@pytest.mark.slow
def test_a_robot_that_never_sends_is_consistent_on_board_and_needs_no_true_poses(known, heard):
    settings = calib.OnboardSettings(noise=IMUS["industrial"], use="receptions")
    (track,) = calib.localize_onboard(heard, known, settings)
    assert (track.used, track.restarts_s) == ("differences of arrival, imu", ())
    assert len(track.nis) > 6350, "all 6400 differences but those of the start"
    late, settled = (time_ns > track.time_ns[0] + 5 * 10**9 for time_ns in (track.time_ns, track.range_time_ns))
    # Errors of the state last for a second: fifteen independent values of three.
    assert 1.5 < np.mean(track.nees[late]) < 5.0
    # Two listeners of an exchange have one error in common: the mean of 4800 squares is known to a thirtieth.
    assert np.mean(track.nis[settled]) == pytest.approx(1.0, abs=0.09)
    assert np.sqrt(np.mean(track_errors(track, 5.0) ** 2)) < 0.1
    early = heard.select(stop_s=4.0)
    (seen,), (blind,) = (
        calib.localize_onboard(replace(early, poses=early.poses[rows]), known, settings)
        for rows in (early.poses.body != "", early.poses.body != "robot")
    )
    assert np.isnan(blind.truth_m).all()
    assert blind.estimate_m == pytest.approx(seen.estimate_m, abs=1e-9)


@pytest.mark.slow
def test_lasting_reflections_within_the_gate_are_in_the_covariance():
    """A gate of 3.3 standard deviations of a difference accepts errors of half a metre of both signs."""
    lasting = {"model": "two-state", "share": 0.14, "mean_excess_m": 0.35, "life_s": 0.15, "first_path_loss_db": 0.4,
               "loss_std_db": 1.0, "total_loss_db": 0.0}  # fmt: skip
    train, test = (
        flight(seed, seconds, pairs=pairs, passive=passive, radio=NOISY | {"multipath": lasting})
        for seed, seconds, pairs, passive in ((3140, 80.0, "between-bodies", ()), (3141, 30.0, BETWEEN_ANCHORS, ROBOT))
    )
    found = calib.localize(test, calib.fit(train), LISTEN)
    total = summarize(found)
    assert total.rmse_m["robust"] < 0.75 * total.rmse_m["raw"]
    # Innovations agree with their stated size to a tenth; with the noise of direct paths alone they would be a third
    # larger.
    assert 0.85 < total.nis < 1.15
    assert np.mean(found[0].tracks["robust"].nees) < 4.5


def test_delays_that_are_known_in_sums_only_correct_no_difference(heard):
    ranges, split = calib.load_ranges(heard), (((1, 2, 3, 4), (5, 6, 7, 8)),)
    with pytest.raises(calib.BadInputError, match="tags 1, 2, 3"):
        replace(PLANTED, undetermined_splits=split).correct_arrivals(ranges)
    without = {tag: delay for tag, delay in DELAYS_NS.items() if tag not in ROBOT}
    listening = replace(PLANTED, delays_ns=without).correct_arrivals(ranges)
    assert np.array_equal(listening.corrected_m, PLANTED.correct_arrivals(ranges).corrected_m)
    assert np.isnan(listening.late_share).all()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A robot that listens, one that does not, and a calibration."""
    place = tmp_path_factory.mktemp("robots")
    for name, listening in (("listens", ROBOT), ("deaf", ())):
        replace(flight(3130, 0.5, passive=listening), imu={}).save(place / f"{name}.uwb")
    PLANTED.save(place / "c.json")
    return place


@pytest.mark.parametrize(
    ("robot", "options", "status", "naming"),
    [
        ("listens", "", 1, ["listens.uwb", "--use"]),
        ("deaf", "--use receptions", 1, ["deaf.uwb", "--use"]),
        ("listens", "--model constant-velocity", 1, ["listens.uwb", "--use"]),
        ("deaf", "--use receptions --model constant-velocity", 1, ["deaf.uwb", "--use"]),
        ("listens", "--use receptions --model imu", 1, ["listens.uwb", "constant-velocity"]),
        ("listens", "--use everything", 2, ["--use", "everything", "exchanges, receptions"]),
    ],
)
def test_errors_are_one_line_with_the_remedy(folder, robot, options, status, naming):
    words = f"calib localize {robot}.uwb -c c.json --tum tum {options}".split()
    processes.refuse(*words, cwd=folder, naming=naming, status=status)
    assert not (folder / "tum").exists()
