"""Delays that drift from day to day: a rate where sessions tell one, and none where nothing drifts."""

import re
from dataclasses import replace

import numpy as np
import pytest

import calib
from benchmarks.worlds import Recipe, make
from tests.processes import call

RECIPE = Recipe(tags=5, seconds=20, per_second=120)


def sessions(seed, days, rate_m2=0.0, scatter_m=0.0, *, begin=20_000, wander_m=0.0):
    """Recordings on some days: what each tag adds to ranges is a random walk of a rate a day, and scatters besides."""
    steps, scatter = np.random.default_rng([seed, 77]).normal(size=(2, len(days), RECIPE.tags + 1))
    walk = np.cumsum(np.sqrt(rate_m2 * np.diff(days, prepend=days[0]))[:, None] * steps, axis=0)
    for k, adds_m in enumerate(walk + scatter_m * scatter):
        ranges = make(replace(RECIPE, wander_m=wander_m), seed, k).ranges
        time_ns = ranges.time_ns + int((begin + days[k]) * 86_400e9)
        raw_m = ranges.raw_m + adds_m[ranges.initiator] + adds_m[ranges.target]
        yield replace(ranges, source=f"day{k}", time_ns=time_ns, raw_m=raw_m)


def told(seeds, *args, **kwargs):
    """Whether sessions tell a drift, whether by age, and the rate (3,) with its interval, of each world (worlds, 5)."""
    days = [np.cumsum([0, *np.random.default_rng([seed, 5]).uniform(2, 15, 2 + seed % 4)]) for seed in seeds]
    fits = (calib.fit(sessions(seed, when, *args, **kwargs)) for seed, when in zip(seeds, days, strict=True))
    drifts = (one.calibration.provenance["drift"] for one in fits)
    return np.transpose([(one["told"], one["by_age"], *one["m2_per_day"]) for one in drifts])


@pytest.mark.parametrize(("rate_m2", "wander_m"), [(1e-5, 0.0), (1e-4, 0.04)])
def test_the_rate_of_a_drift_is_found_within_its_interval(rate_m2, wander_m):
    # Errors of pairs that last for seconds scatter between sessions, too.
    drifts, by_age, low, likeliest, high = told(range(12), rate_m2, wander_m=wander_m)
    # Of 12 intervals that hold with 90 %, 9 or more do in 97 of 100 such studies.
    assert np.sum((low <= rate_m2) & (rate_m2 <= high)) >= 9
    assert 0.4 < np.median(likeliest) / rate_m2 < 2.5
    assert drifts.mean() > 0.7
    assert by_age.mean() > 0.2


@pytest.mark.parametrize(("wander_m", "most_m2"), [(0.0, 3e-6), (0.04, 1e-4)])
def test_nothing_is_claimed_where_nothing_drifts(wander_m, most_m2):
    drifts, by_age, *_, high = told(range(20, 28), wander_m=wander_m)
    # Sessions still bound what they do not see.
    assert (drifts.any(), by_age.any(), high.max() < most_m2) == (False, False, True)


def test_what_scatters_between_sessions_is_not_called_age():
    drifts, by_age, *_ = told(range(40, 48), scatter_m=0.01)
    assert (drifts.all(), by_age.sum() <= 1) == (True, True)


@pytest.mark.parametrize(
    ("rate_m2", "days", "says"),
    [
        (
            1e-5,
            (0, 3, 10, 24),
            r"4 sessions over 24 days: delays drift, .* 2 cm for (\d+) days \((\d+) to (\d+), 95 %\)",
        ),
        (0.0, (0, 3, 10, 24), r"4 sessions over 24 days tell no drift: .* 2 cm for (\d+) days or more"),
        (1e-4, (0, 7), r"2 sessions over 7 days: delays differ, and do not tell whether by age; .*for (\d+) days"),
    ],
)
def test_show_says_how_old_a_calibration_may_get(tmp_path, rate_m2, days, says):
    result = calib.fit(sessions(10_003, days, rate_m2))
    result.save(tmp_path / "known.json")
    low, likeliest, high = result.calibration.provenance["drift"]["m2_per_day"]
    printed = re.search(f"age: {says}", call("calib", "show", tmp_path / "known.json").stdout).groups()
    rates = np.array([likeliest, high, low] if low else [high])[: len(printed)]
    # 1.96 times the root of the rate and the days is 2 cm.
    assert [*map(int, printed)] == pytest.approx(0.02**2 / 1.96**2 / rates, abs=0.6)


def test_ages_need_dates_and_several_sessions():
    for parts in ([*sessions(3, [0, 5])][:1], sessions(3, [0, 5], begin=0)):
        assert "drift" not in calib.fit(parts).calibration.provenance
    held = calib.fit(sessions(3, [0, 5, 9]), hold_out=0.34, fold="session").calibration
    assert held.provenance["drift"]["sessions"] == 3
