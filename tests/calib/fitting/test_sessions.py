"""Several recordings in one fit: gaps between them have no effect, and differences between them are named."""

import re
from dataclasses import replace

import numpy as np
import pytest

import calib
from benchmarks.worlds import LIGHT_M_PER_NS, Recipe, make, sigma_m
from tests.calib.synthetic import about_their_mean
from tests.processes import run

HOUR_NS = 3_600_000_000_000
RECIPE = Recipe(tags=4, seconds=20, per_second=120)


def moved(ranges, tag, by_ns):
    """Return ranges with another antenna delay of a tag."""
    weight = (ranges.initiator == tag) * ranges.weight_initiator + (ranges.target == tag) * ranges.weight_target
    return replace(ranges, raw_m=ranges.raw_m - weight * by_ns * LIGHT_M_PER_NS)


def sessions(hours, *, seed=20_001, moved_ns=0.0, recipe=RECIPE):
    """Return the delays of a world, and two recordings of it, the second some hours after the first."""
    world, later = make(recipe, seed), make(recipe, seed, flight=1)
    begin = int(world.ranges.time_ns[-1] - later.ranges.time_ns[0]) + int(hours * HOUR_NS)
    second = replace(later.ranges, time_ns=later.ranges.time_ns + begin, source="tuesday.uwb")
    return world.delays_ns, [replace(world.ranges, source="monday.uwb"), moved(second, 3, moved_ns)]


def between(found):
    """Return the warnings on differences between recordings."""
    return [said for said in found.warnings if "monday.uwb" in said or "tuesday.uwb" in said]


def numbers(found):
    calibration = found.calibration
    return [*calibration.delays_ns.values(), *calibration.delays_std_ns.values(), *calibration.bias_curve.coefficients]


def test_gaps_and_origins_of_time_between_sessions_have_no_effect():
    adjacent, (monday, tuesday) = calib.fit(sessions(1e-5)[1]), sessions(72)[1]
    at_zero = [replace(part, time_ns=part.time_ns - part.time_ns[0]) for part in (monday, tuesday)]
    assert between(adjacent) == []
    for apart in (calib.fit([monday, tuesday]), calib.fit(at_zero)):
        np.testing.assert_allclose(numbers(apart), numbers(adjacent), rtol=1e-6, atol=1e-9)
        assert apart.warnings == adjacent.warnings


def test_five_short_recordings_of_many_tags_are_one_fit():
    # 66 pairs in five recordings have more offsets than there are ranges; the noise must not become zero.
    worlds = [make(Recipe(tags=12, seconds=6, per_second=10), 20_003, flight) for flight in range(5)]
    parts = [
        replace(one.ranges, time_ns=one.ranges.time_ns + k * HOUR_NS, source=f"{k}.uwb") for k, one in enumerate(worlds)
    ]
    found = calib.fit(parts)
    assert found.warnings == []
    known, lifted = found.calibration, np.median(np.concatenate([found.calibration.lifted(part) for part in parts]))
    # 300 ranges, half of whose degrees of freedom the unknowns use, determine their noise to 6 %; power has a part in
    # it.
    assert known.sigma_curve(lifted) == pytest.approx(sigma_m(lifted, Recipe().noise_m), rel=0.25)
    assert np.abs(np.divide(*about_their_mean(known, worlds[0].delays_ns))).max() < 3


@pytest.mark.parametrize(("by_ns", "hours"), [(0.3, 72), (1.5, 1e-5)])
def test_a_tag_whose_delay_changed_between_sessions_is_named_and_intervals_hold(by_ns, hours):
    known, parts = sessions(hours, moved_ns=by_ns)
    found = calib.fit(parts)
    (said,) = between(found)
    assert float(re.match(r"tag 3.*tuesday\.uwb.*monday\.uwb.*p = ([^)]*)", said)[1]) < 1e-6
    others = np.array([-1 / 3, -1 / 3, 1, -1 / 3])
    error = others @ [found.calibration.delays_ns[tag] - known[tag] for tag in known]
    reach = 1.96 * np.sqrt(others @ found.calibration.covariance_ns2(list(known)) @ others)
    assert abs(error) < reach
    assert abs(error - by_ns) < reach < 3 * by_ns


def test_a_pair_with_another_offset_in_one_session_is_named():
    _, (monday, tuesday) = sessions(72)
    longer = np.isin(tuesday.initiator, (1, 2)) & np.isin(tuesday.target, (1, 2))
    found = calib.fit([monday, replace(tuesday, raw_m=tuesday.raw_m + 0.08 * longer)])
    assert [said.split(":")[0].split(" or ")[0] for said in between(found)] == ["pair 1-2"]


def test_the_one_of_three_sessions_in_which_a_tag_differs_is_named():
    parts = [replace(make(RECIPE, 8, k).ranges, source=f"day{k}.uwb") for k in range(3)]
    found = calib.fit([parts[0], moved(parts[1], 2, 0.4), parts[2]])
    assert [said for said in found.warnings if said.startswith("tag 2") and "day1.uwb" in said]
    assert not [said for said in found.warnings if "day0.uwb" in said or "day2.uwb" in said]


def test_scatter_between_sessions_is_in_the_intervals():
    rng, sound = np.random.default_rng(1), [make(RECIPE, 9, k).ranges for k in range(2)]
    offset_m = rng.normal(0, 0.02, (2, 5, 5))
    lower, upper = ([np.sort((one.initiator, one.target), axis=0)[end] for one in sound] for end in (0, 1))
    scattered = [replace(one, raw_m=one.raw_m + offset_m[k, lower[k], upper[k]]) for k, one in enumerate(sound)]
    std_ns = [np.mean(list(calib.fit(parts).calibration.delays_std_ns.values())) for parts in (sound, scattered)]
    # Two centimetres in each of three pairs of a tag, in each of two sessions, are about 50 ps of its delay.
    assert std_ns[0] < 0.03 < std_ns[1] < 0.15


def test_sessions_without_times_are_refused():
    frozen = [replace(part, time_ns=np.full_like(part.time_ns, k)) for k, part in enumerate(sessions(6)[1])]
    with pytest.raises(calib.UnanswerableError, match="same time"):
        calib.fit(frozen)


def test_intervals_hold_the_delay_of_a_session_that_is_short():
    known, (monday, tuesday) = sessions(72, moved_ns=0.4)
    found = calib.fit([monday, tuesday[: len(tuesday) // 4]])
    assert between(found)
    delays = found.calibration.delays_ns
    error = delays[3] - known[3] - np.mean([delays[tag] - known[tag] for tag in (1, 2, 4)])
    # With an offset in each session, the delay is at most their mean: halfway.
    assert error < 0.2
    # Wide enough for the delay of the short session, 0.34 ns away, and not much wider.
    assert abs(error - 0.4) < 1.96 * found.calibration.delays_std_ns[3] < 0.47


def test_the_p_value_counts_all_tests():
    # The difference is just large enough to be named: by its own test alone, of more than fifty, p would be more than
    # fifty times smaller.
    _, parts = sessions(6, moved_ns=0.22, recipe=replace(RECIPE, seconds=10, per_second=60))
    (said,) = between(calib.fit(parts))
    assert 2e-4 < float(said.split("p = ")[1].split(")")[0]) <= 5e-3


# Delays that drift from day to day: a rate is found if sessions show one, and none if nothing drifts.


DRIFTING = Recipe(tags=5, seconds=20, per_second=120)


def drifting(seed, days, rate_m2=0.0, scatter_m=0.0, *, begin=20_000, wander_m=0.0):
    """Return recordings on some days: ranges of each tag have a random walk with a variance per day, and a scatter."""
    steps, scatter = np.random.default_rng([seed, 77]).normal(size=(2, len(days), DRIFTING.tags + 1))
    walk = np.cumsum(np.sqrt(rate_m2 * np.diff(days, prepend=days[0]))[:, None] * steps, axis=0)
    for k, adds_m in enumerate(walk + scatter_m * scatter):
        ranges = make(replace(DRIFTING, wander_m=wander_m), seed, k).ranges
        time_ns = ranges.time_ns + int((begin + days[k]) * 86_400e9)
        raw_m = ranges.raw_m + adds_m[ranges.initiator] + adds_m[ranges.target]
        yield replace(ranges, source=f"day{k}", time_ns=time_ns, raw_m=raw_m)


def told(seeds, *args, **kwargs):
    """Return whether sessions show a drift, whether by age, and the rate (3,) with its interval, of each world (worlds,
    5).
    """
    days = [np.cumsum([0, *np.random.default_rng([seed, 5]).uniform(2, 15, 2 + seed % 4)]) for seed in seeds]
    fits = (calib.fit(drifting(seed, when, *args, **kwargs)) for seed, when in zip(seeds, days, strict=True))
    drifts = (one.calibration.provenance["drift"] for one in fits)
    return np.transpose([(one["told"], one["by_age"], *one["m2_per_day"]) for one in drifts])


@pytest.mark.slow
@pytest.mark.parametrize(("rate_m2", "wander_m"), [(1e-5, 0.0), (1e-4, 0.04)])
def test_the_rate_of_a_drift_is_found_within_its_interval(rate_m2, wander_m):
    # Errors of pairs that last for seconds also scatter between sessions.
    drifts, by_age, low, likeliest, high = told(range(12), rate_m2, wander_m=wander_m)
    # Of 12 intervals that hold with 90 %, 9 or more do in 97 of 100 such studies.
    assert np.sum((low <= rate_m2) & (rate_m2 <= high)) >= 9
    assert 0.4 < np.median(likeliest) / rate_m2 < 2.5
    assert (drifts.mean() > 0.7, by_age.mean() > 0.2) == (True, True)


@pytest.mark.slow
@pytest.mark.parametrize(("wander_m", "most_m2"), [(0.0, 3e-6), (0.04, 1e-4)])
def test_without_drifts_no_rate_is_stated(wander_m, most_m2):
    drifts, by_age, *_, high = told(range(20, 28), wander_m=wander_m)
    # Sessions still give an upper bound.
    assert (drifts.any(), by_age.any(), high.max() < most_m2) == (False, False, True)


@pytest.mark.parametrize(("worlds", "most"), [(2, 0), pytest.param(8, 1, marks=pytest.mark.slow)])
def test_scatter_between_sessions_is_not_called_a_drift(worlds, most):
    drifts, by_age, *_ = told(range(40, 40 + worlds), scatter_m=0.01)
    assert (drifts.all(), by_age.sum() <= most) == (True, True)


@pytest.mark.parametrize(
    ("rate_m2", "days", "says"),
    [
        (
            1e-5,
            (0, 3, 10, 24),
            r"4 sessions over 24 days: delays drift, .* 2 cm for (\d+) days \((\d+) to (\d+), 95 %\)",
        ),
        (0.0, (0, 3, 10, 24), r"4 sessions over 24 days show no drift: .* 2 cm for (\d+) days or more"),
        (1e-4, (0, 7), r"2 sessions over 7 days: delays differ, but not significantly by age; .*for (\d+) days"),
    ],
)
def test_show_states_the_useful_age_of_a_calibration(tmp_path, rate_m2, days, says):
    result = calib.fit(drifting(10_003, days, rate_m2))
    result.save(tmp_path / "known.json")
    low, likeliest, high = result.calibration.provenance["drift"]["m2_per_day"]
    printed = re.search(f"age: {says}", run("calib", "show", tmp_path / "known.json").stdout).groups()
    rates = np.array([likeliest, high, low] if low else [high])[: len(printed)]
    # 1.96 times the root of the rate times the days is 2 cm.
    assert [*map(int, printed)] == pytest.approx(0.02**2 / 1.96**2 / rates, abs=0.6)


def test_ages_need_dates_and_several_sessions():
    for parts in ([*drifting(3, [0, 5])][:1], drifting(3, [0, 5], begin=0)):
        assert "drift" not in calib.fit(parts).calibration.provenance
    held = calib.fit(drifting(3, [0, 5, 9]), hold_out=0.34, fold="session").calibration
    assert held.provenance["drift"]["sessions"] == 3
