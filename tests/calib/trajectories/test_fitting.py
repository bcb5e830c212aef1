"""Delays planted in flights without true distances: sums of sines, with positions known at the start only."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import calib
from benchmarks.trajectories import scenario
from calib.estimator import range_rows, unknowns
from calib.estimator import rows as sums
from calib.settings import FlightSettings
from calib.trajectories.motion import Distances, Motion, known_rows
from calib.trajectories.scene import scene_from
from tests.calib.evaluation.inertial import table
from tests.calib.trajectories.sines import CEILING, CORNERS, DELAYS_NS, distance_errors, flight, scores
from uwblink import KnownDistance


@pytest.fixture(scope="module")
def flown():
    return flight(seconds=14.0, wander_deg=3.0)


@pytest.fixture(scope="module")
def known():
    """The calibration of another flight, whose headings are known."""
    return calib.fit_from_ranges(flight(seconds=10.0), poses_until_s=6.0, heading_std_deg=0.0).calibration


@pytest.mark.slow
def test_planted_delays_are_found_from_a_known_start(flown):
    shares: list[float] = []
    result = calib.fit_from_ranges(flown, poses_until_s=8.0, progress=shares.append)
    std = np.array(list(result.calibration.delays_std_ns.values()))
    assert result.success
    # 36 steps; 95 without the second derivatives of distances.
    assert int(re.fullmatch(r"converged after (\d+) steps", result.message)[1]) < 70
    # A sound flight has only the warning that it is short.
    assert [warning[:12] for warning in result.warnings] == ["only 14 s of"]
    # One flight of 14 s: a fit with all distances known has an error of 18 ps.
    assert np.abs(scores(result)).max() < 3.5
    assert 0.015 < std.max() < 0.06
    away, known = distance_errors(result, flown), result.calibration.provenance
    assert np.std(away) < 0.02
    assert abs(np.mean(away)) < 0.01
    assert (known["truth"], known["geometry"]["known_s"]) == ("ranges", pytest.approx(7.9, abs=0.11))
    assert known["geometry"]["moving"] == ["robot0", "robot1", "robot2"]
    # The stated standard error agrees with the errors.
    assert known["distance_std_m"] == pytest.approx(np.std(away), rel=0.5)
    assert (shares, shares[-1]) == (sorted(shares), 1.0)


@pytest.mark.slow
def test_ranges_of_a_flight_that_are_worked_on_in_several_pieces_give_the_same_delays(monkeypatch):
    flown = flight(seconds=8.0, seed=3)
    whole = calib.fit_from_ranges(flown, poses_until_s=5.0).calibration
    monkeypatch.setattr("calib.estimator.range_rows.ROWS_AT_ONCE", 250)
    pieces = calib.fit_from_ranges(flown, poses_until_s=5.0).calibration
    # The mean information of a range is that of its piece, which only changes the steps of a search.
    assert pieces.delays_ns == pytest.approx(whole.delays_ns, abs=0.01 * min(whole.delays_std_ns.values()))


def test_calibrations_without_distances_correct_other_flights(known):
    other = flight(seed=9)
    applied = known.apply(calib.load_ranges(other))
    corrected, raw = (abs(np.median(one - other.distance_m)) for one in (applied.corrected_m, applied.raw_m))
    # Without reflected ranges, the remaining bias is far below that of raw ranges.
    assert corrected < 0.012 < raw


@pytest.mark.slow
def test_a_curve_is_taken_from_another_calibration_with_its_uncertainty(known):
    flown = flight(seconds=8.0, seed=3)
    given: dict[str, Any] = {"poses_until_s": 5.0, "heading_std_deg": 0.0}
    result = calib.fit_from_ranges(flown, **given, curve_from=known)
    found = result.calibration
    assert found.bias_curve == known.bias_curve
    assert (found.lift, found.alpha_dbm) == (known.lift, known.alpha_dbm)
    assert np.abs(scores(result)).max() < 3.5
    surer = calib.fit_from_ranges(flown, **given, curve_from=replace(known, uncertainty=None)).calibration
    assert all(surer.delays_std_ns[tag] < found.delays_std_ns[tag] for tag in DELAYS_NS)


def test_a_bad_parameter_is_named(flown, known):
    wrong: list[tuple[str, dict[str, Any]]] = [
        ("attitudes", {"attitudes": "guess"}),
        ("anchors", {"anchors": "moved"}),
        ("poses_until_s", {"poses_until_s": -1.0}),
        ("heading_std_deg", {"heading_std_deg": np.nan}),
        ("sequential", {"sequential": True}),
        ("curve_from", {"curve_from": known, "delays_only": True}),
        ("curve_from", {"curve_from": known, "groups": {"all": (1, 2, 3, 4, 5, 6)}}),
        ("curve_from", {"curve_from": replace(known, power_at="reception")}),
    ]
    for parameter, given in wrong:
        with pytest.raises(calib.BadInputError, match=f"^`{parameter}`"):
            calib.fit_from_ranges(flown, **given)


def test_nearly_exact_ranges_give_nearly_exact_delays():
    flown = flight(seconds=10.0, noise_m=0.0, reflected=0.0)
    found = calib.fit_from_ranges(flown, poses_until_s=6.0, heading_std_deg=0.0).calibration
    # Stamps are whole ticks, 2.3 mm of range; control points every 0.4 s follow these sines to millimetres.
    assert max(abs(found.delays_ns[tag] - delay) for tag, delay in DELAYS_NS.items()) < 0.02


@pytest.mark.slow
def test_positions_of_anchors_replace_a_known_start():
    flown = flight(seconds=10.0, rate=120, anchors=CORNERS)
    result = calib.fit_from_ranges(flown, poses_until_s=0.0)
    # Lever arms of anchors are 37 cm long, each with another direction.
    assert np.std(distance_errors(result, flown)) < 0.03
    assert result.calibration.provenance["geometry"]["known_s"] == 0
    assert np.abs(scores(result)).max() < 3.5
    assert np.sqrt(np.diag(result.calibration.uncertainty.delays_ns2))[:6].max() < 0.15


@pytest.mark.slow
def test_estimated_anchors_do_not_spoil_a_known_start():
    flown = flight(seconds=10.0, rate=120, anchors=CORNERS, seed=2)
    result = calib.fit_from_ranges(flown, poses_until_s=6.0, anchors="sought")
    assert np.abs(scores(result)).max() < 3.5
    # In a flight in the middle of the room, an anchor's position and its delay have nearly the same effect.
    assert all(np.isinf(result.calibration.delays_std_ns[tag]) for tag in (11, 12, 13, 14))
    assert "tags 11, 12, 13, 14" in result.warnings[0]
    assert result.calibration.provenance["geometry"]["anchors_sought"] == [f"anchor{tag}" for tag in (11, 12, 13, 14)]


@pytest.mark.slow
def test_noise_accounts_for_the_unknowns_of_paths():
    # 960 ranges, of whose degrees of freedom paths use an eighth: noise has a standard error of 2.5 %, the mean of
    # three one of 1.4 %. By residuals alone it would be 6 % too small.
    found = [
        calib.fit_from_ranges(flight(seed=seed, rate=40), minimum_norm=True, poses_until_s=8.0, between_m=0.0)
        for seed in (61, 62, 63)
    ]
    assert 0.96 < np.mean([np.median(one.calibration.errors.noise_m) for one in found]) / 0.04 < 1.08


@pytest.mark.slow
def test_the_fit_does_not_stop_at_a_lower_maximum_of_the_likelihood():
    """Estimating motion and errors alternately ends in one, with delays that are wrong by 147 ps (rms)."""
    flown = scenario("lasting_reflections/hall.toml", 8, 40.0)
    known = calib.fit_from_ranges(flown, poses_until_s=10.0).calibration
    error_ns = [known.delays_ns[tag] - flown.planted["delays_ns"][str(tag)] for tag in known.delays_ns]
    # The limit is twice the standard error of 30 ps. The delays have a common constant, which is removed.
    assert np.std(error_ns) < 0.06
    assert max(known.delays_std_ns.values()) < 0.1


# Motion as unknowns: derivatives of distances and known facts, compared with finite differences.


@pytest.fixture(scope="module")
def laid_out():
    flown, time_s = flight(seconds=3.0, anchors=CEILING, height_off_m=0.1), np.arange(0.0, 4.0, 0.01)
    # Inertial readings of robot0, which is at rest except for a sine.
    read = np.sin(5 * time_s)[:, None] * [0.1, 0.1, 0.1, 1.0, 0.5, 0.0] + [0, 0, 0, 0, 0, 9.81]
    flown.imu = table(np.rint(time_s * 1e9).astype(np.int64), ["robot0"], read)
    tapes = (
        KnownDistance(11, 12, 7.0, 0.01),
        KnownDistance(1, 12, 3.0, 0.01, "0..1"),
        KnownDistance(3, 6, 2.0, 0.01, "1..2"),
    )
    scene = scene_from(flown, FlightSettings(poses_until_s=1.0, anchors="sought", distances=tapes))
    motion = Motion.of(scene)
    layout = unknowns.Layout(motion.unknowns({}, 8.0))
    x = 3 * np.random.default_rng(2).normal(size=layout.size)
    # Rotations are linear to first order only: at 1e-4 rad to a ten-thousandth of a lever arm.
    x[layout.where["turn"]] *= 1e-4
    return scene, motion, layout, x


def mixture_rows(scene, motion):
    """Return a layout of motion, delays of ten pairs and errors, and rows of a mixture with expected information."""
    levels = {"noise": -3.0, "odds": -2.0, "detour": -0.5, "least": -3.0, "outliers": -4.0, "long": -3.0}
    blocks = [unknowns.Unknown(kind=kind, names=("",), start=np.full(1, level)) for kind, level in levels.items()]
    delays = unknowns.Unknown(kind="delay", names=("",) * 10, start=np.linspace(-0.1, 0.1, 10))
    layout = unknowns.Layout((*motion.unknowns({}, 8.0), delays, *blocks))
    key = np.arange(len(scene.time_s)) % 10
    parts = [
        range_rows.Part(parameter=kind, kind=kind, columns=np.zeros((len(key), 1), dtype=np.int64)) for kind in levels
    ]
    parts.append(range_rows.Part(parameter=range_rows.RESIDUAL, kind="delay", columns=key[:, None]))
    geometry = Distances.of_ranges(motion, layout)
    return layout, range_rows.RangeRows.of(
        scene.ranges.raw_m, key, parts, range_rows.Mixture(expected=True), layout, geometry
    )


@pytest.mark.parametrize("most", [0, 4000])
def test_sums_over_ranges_of_moving_bodies_are_those_of_all_rows_one_by_one(laid_out, most, monkeypatch):
    monkeypatch.setattr(sums, "MOST_DENSE", most)
    scene, motion, *_ = laid_out
    layout, rows = mixture_rows(scene, motion)
    rng = np.random.default_rng(5)
    x, step = layout.start() + 1e-3 * rng.normal(size=layout.size), rng.normal(size=layout.size)
    # Bodies at rest some metres from each other: errors of ranges are up to 2 m.
    x[layout.where["path"]] += np.tile(rng.uniform(-2, 2, 9), motion.places.count)
    found = sums.sum_rows([rows], x)
    ahead, behind = (sums.sum_rows([rows], x + far * step).value for far in (1e-6, -1e-6))
    assert found.gradient @ step == pytest.approx((ahead - behind) / 2e-6, rel=1e-4)
    # The outer squares of whole rows of derivatives, by the information of each residual and the error parameters.
    expected = np.zeros((layout.size, layout.size))
    for terms in rows.terms(x):
        for part in terms.squares:
            every = terms.as_matrix(part.entries, part.residual, layout.size).toarray()
            expected += every.T @ (every * np.broadcast_to(part.weight, len(every))[:, None])
    information = found.information if most else found.information.toarray()
    assert information == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())
    assert expected[layout.where["delay"], layout.where["path"]].any()
    # Movements of the antennas, by differences of their positions, times slope over distance.
    along = np.zeros(layout.size)
    for kind in ("path", "stand"):
        along[layout.where[kind]] = step[layout.where[kind]]
    vectors = [second - first for far in (1, 0, -1) for first, second, *_ in [rows.geometry.antennas(x + far * along)]]
    moved, distance = (vectors[0] - vectors[2]) / 2, np.linalg.norm(vectors[1], axis=1)
    slope = rows.errors.slopes(rows.values(x))[1][range_rows.RESIDUAL]
    bends = np.abs(slope) / distance * np.sum(moved**2, axis=1)
    assert along @ (found.curvature - found.information) @ along == pytest.approx(bends.sum(), rel=1e-6)


def test_doubled_control_points_give_the_same_paths(laid_out):
    scene, motion, layout, x = laid_out
    state = motion.state(layout, x)
    finer, again = motion.refined(state)
    time = np.linspace(scene.time_s[0], scene.time_s[-1], 200)
    assert finer.places.step_s == motion.places.step_s / 2
    assert np.allclose(finer.positions(again["path"], time), motion.positions(state["path"], time))


def test_distances_and_rows_have_the_derivatives_of_finite_differences(laid_out):
    scene, motion, layout, x = laid_out
    geometry = Distances.of(motion, layout, (scene.ranges.initiator, scene.ranges.target), scene.time_s)
    rows = known_rows(motion, layout)
    step = np.random.default_rng(3).normal(size=layout.size)
    ahead, behind = x + 1e-6 * step, x - 1e-6 * step
    moved = geometry.derivatives(x, np.arange(len(scene.time_s))) @ step
    assert np.allclose(moved, (geometry.distances(ahead)[0] - geometry.distances(behind)[0]) / 2e-6, atol=1e-3)
    assert rows.keys() == {"place", "force robot0", "height", "tape"}
    for kind in rows.values():
        value = [sum(terms.value for terms in kind.terms(at)) for at in (ahead, behind)]
        slope = sum(float(np.sum(terms.slopes * step[terms.columns].T)) for terms in kind.terms(x))
        assert slope == pytest.approx((value[0] - value[1]) / 2e-6, rel=1e-3)
