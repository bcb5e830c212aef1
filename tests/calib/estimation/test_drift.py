"""Delays that drift from day to day: a rate where sessions tell one, and none where nothing drifts."""

from dataclasses import replace

import numpy as np
import pytest

import calib
from benchmarks.worlds import Recipe, make
from tests.processes import call

RECIPE = Recipe(tags=5, seconds=20, per_second=120)
DAY_NS = 86_400 * 10**9


def sessions(seed, days, rate_m2=0.0, scatter_m=0.0, *, begin=20_000, wander_m=0.0):
    """Recordings on some days: what each tag adds to ranges is a random walk of a rate a day, and scatters besides."""
    random, parts, walk = np.random.default_rng([seed, 77]), [], np.zeros(RECIPE.tags + 1)
    for k, day in enumerate(days):
        walk = walk + np.sqrt(rate_m2 * (day - days[max(k - 1, 0)])) * random.normal(size=RECIPE.tags + 1)
        adds_m = walk + scatter_m * random.normal(size=RECIPE.tags + 1)
        ranges = make(replace(RECIPE, wander_m=wander_m), seed, k).ranges
        time_ns = ranges.time_ns + int((begin + day) * DAY_NS)
        raw_m = ranges.raw_m + adds_m[ranges.initiator] + adds_m[ranges.target]
        parts.append(replace(ranges, source=f"day{k}", time_ns=time_ns, raw_m=raw_m))
    return parts


def told(seed, *args, **kwargs):
    days = np.cumsum([0, *np.random.default_rng([seed, 5]).uniform(2, 15, 2 + seed % 4)])
    return calib.fit(sessions(seed, days, *args, **kwargs)).calibration.provenance["drift"]


@pytest.mark.parametrize(("rate_m2", "wander_m"), [(1e-5, 0.0), (1e-4, 0.04)])
def test_the_rate_of_a_drift_is_found_within_its_interval(rate_m2, wander_m):
    # Errors of pairs that last for seconds scatter between sessions, too.
    found = [told(seed, rate_m2, wander_m=wander_m) for seed in range(12)]
    # Of 12 intervals of 95 %, 10 or more hold the rate in 98 of 100 such studies.
    assert sum(low <= rate_m2 <= high for low, _, high in (one["m2_per_day"] for one in found)) >= 10
    likeliest = np.array([one["m2_per_day"][1] for one in found])
    assert 0.4 < np.median(likeliest) / rate_m2 < 2.5
    assert np.mean([one["told"] for one in found]) > 0.7
    assert np.mean([one["by_age"] for one in found]) > 0.2


@pytest.mark.parametrize(("wander_m", "most_m2"), [(0.0, 3e-6), (0.04, 1e-4)])
def test_nothing_is_claimed_where_nothing_drifts(wander_m, most_m2):
    found = [told(seed, wander_m=wander_m) for seed in range(20, 28)]
    assert not any(one["told"] or one["by_age"] for one in found)
    # Sessions still bound what they do not see.
    assert max(one["m2_per_day"][2] for one in found) < most_m2


def test_what_scatters_between_sessions_is_not_called_age():
    found = [told(seed, scatter_m=0.01) for seed in range(40, 48)]
    assert all(one["told"] for one in found)
    assert sum(one["by_age"] for one in found) <= 1


def test_show_says_how_old_a_calibration_may_get(tmp_path):
    lines = []
    for rate_m2, days in ((1e-5, [0, 3, 10, 24]), (0.0, [0, 3, 10, 24]), (1e-4, [0, 7])):
        calib.fit(sessions(10_003, days, rate_m2)).save(tmp_path / "known.json")
        lines += [line for line in call("calib", "show", tmp_path / "known.json").stdout.splitlines() if "age:" in line]
        (tmp_path / "known.json").unlink()
    drifts, sound, two = lines
    assert "4 sessions over 24 days: delays drift, 95 %" in drifts
    likeliest, least, most = (
        float(word.strip("(,")) for word in np.array(drifts.split("2 cm for ")[1].split())[[0, 2, 4]]
    )
    # 1.96 times the root of the rate and the days is 2 cm.
    assert least < (0.02 / 1.96) ** 2 / 1e-5 < most
    assert least < likeliest < most < 100
    assert "tell no drift" in sound
    assert float(sound.split("2 cm for ")[1].split()[0]) > 100
    assert "2 sessions over 7 days: delays differ, and do not tell whether by age" in two


def test_ages_need_dates_and_several_sessions():
    parts = sessions(3, [0, 5], 1e-5)
    assert "drift" not in calib.fit(parts[0]).calibration.provenance
    assert "drift" not in calib.fit(sessions(3, [0, 5], 1e-5, begin=0)).calibration.provenance
    held = calib.fit(sessions(3, [0, 5, 9], 1e-5), hold_out=0.34, fold="session").calibration
    assert held.provenance["drift"]["sessions"] == 3
