"""Errors of pairs that differ between flights: filters follow constants of pairs."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from calib import fit, localize, localize_team
from calib.calibration.error_model import ErrorModel
from calib.data.samples import stamped
from calib.evaluation import Settings
from calib.evaluation.localization import consistency
from calib.evaluation.models import FilterRanges, ModelAverage
from calib.evaluation.tracking import Track
from tests.calib.evaluation import test_team
from tests.calib.evaluation.drifting_flight import flight
from tests.calib.evaluation.test_team import CLOSE, NOISE_M, PLANTED, ranging
from tests.processes import succeed

OFFSET_M = 0.05
ONE = Settings(seeds=1)


@pytest.fixture(scope="module")
def known():
    found = fit(flight(100, 60.0)[0]).calibration
    assert found.errors.between_m == OFFSET_M, "the default of one flight, as planted here"
    return found


def without(known):
    """The calibration with errors that are equal in all flights."""
    errors = known.errors
    return replace(known, errors=replace(errors, noise_m=tuple(errors.within_m(np.array(errors.noise_m))), between_m=0))


def robust(contents, known) -> Track:
    return localize(contents, known, ONE)[0].tracks["robust"]


@pytest.mark.slow
def test_constants_of_pairs_are_followed(known):
    flights = [flight(seed, 40.0, offset_m=OFFSET_M)[0] for seed in (21, 22, 23, 24)]
    own, fixed = ([robust(one, by) for one in flights] for by in (known, without(known)))
    # One prior for both: 14 constants are determined from 40 s of ranges to about 2 cm.
    assert np.mean([one.rmse_m for one in own]) < 0.75 * np.mean([one.rmse_m for one in fixed])
    assert min(one.offsets[-1] for one in own) > 0.99
    nees, (low, high), _ = consistency(own)
    # Within the 99 % bounds of a consistent filter: 1.31 times as far away as those of 95 %.
    assert 3 - 1.31 * (3 - low) < nees < 3 + 1.31 * (high - 3)
    assert consistency(fixed)[0] > 6


@pytest.mark.slow
def test_without_constants_of_pairs_the_filter_is_as_accurate(known):
    flights = [flight(seed, 40.0)[0] for seed in (31, 32, 33, 34)]
    own, fixed = ([robust(one, by) for one in flights] for by in (known, without(known)))
    assert np.mean([one.rmse_m for one in own]) < 1.005 * np.mean([one.rmse_m for one in fixed])
    assert np.mean([one.offsets.mean() for one in own]) < 0.2


@pytest.mark.slow
def test_the_command_reports_that_pairs_differ(known, tmp_path):
    known.save(tmp_path / "known.json")
    for name, offset_m in (("same", 0.0), ("differs", OFFSET_M)):
        flight(41, 4.0, offset_m=offset_m)[0].save(tmp_path / f"{name}.uwb")
    words = ("calib", "localize", tmp_path / "same.uwb", tmp_path / "differs.uwb", "-c", tmp_path / "known.json")
    text = succeed(*words, "--seeds", 1).stdout
    same, differs = json.loads(succeed(*words, "--seeds", 1, "--json").stdout)["scenarios"]
    line = r"pairs of differs.uwb robot have constant differences from the calibration .* of (9\d|100) % at the"
    assert re.search(line, text)
    assert "pairs of same.uwb" not in text
    assert same["pair_offsets"] < 0.3 < 0.7 < differs["pair_offsets"]


def test_the_average_over_models_has_the_moments_of_their_mixture():
    rng, nothing = np.random.default_rng(3), np.zeros(1)
    one = FilterRanges(measured_m=nothing, std_m=nothing, common_m=nothing, shared_m=nothing[:, None])
    models = [one, replace(one, shown=False), replace(one, rivals=1)]
    average, densities = ModelAverage(models, (1,)), np.log([[[7.0], [0.3], [0.5]], [[9.0], [0.8], [0.1]]])
    for density in densities:
        average.learn(density)
    odds = np.array([0.3 * 0.8, 0.5 * 0.1])
    np.testing.assert_allclose(average.weights[:, :, 0], [[1, 0, 0], [0, *(odds / odds.sum())]])
    states, roots = rng.normal(size=(3, 1, 2)), rng.normal(size=(3, 1, 2, 2))
    means, covariances = average.moments(states, roots @ roots.swapaxes(-1, -2))
    which = 1 + (rng.random(400_000) < odds[1] / odds.sum())
    draws = states[which, 0] + np.einsum("nij,nj->ni", roots[which, 0], rng.normal(size=(len(which), 2)))
    np.testing.assert_allclose(means[:, 0], [states[0, 0], draws.mean(axis=0)], atol=0.01)
    np.testing.assert_allclose(covariances[1, 0], np.cov(draws.T), atol=0.03)
    # All models keep a probability, so each can become the most likely one.
    for _ in range(40):
        average.learn(densities[1])
    assert average.weights[1, 2, 0] == pytest.approx(1e-3, rel=0.01)


@pytest.mark.slow
def test_a_team_follows_constants_of_pairs():
    noise_m = float(np.hypot(NOISE_M, OFFSET_M))
    errors = ErrorModel(lifted=(0.0,), noise_m=(noise_m,), tail_share=(1e-3,), least_m=0.0, detour_m=0.3,
                        outlier_share=0.0, outlier_m=0.0, between_m=OFFSET_M)  # fmt: skip
    known, (_, ends, measured_m) = replace(PLANTED, errors=errors), ranging(10.0, 1)
    made = test_team.flight(10.0)
    offsets_m = np.triu(np.random.default_rng(5).normal(0, OFFSET_M, (7, 7)))
    measured_m = measured_m + (offsets_m + offsets_m.T)[ends[:, 0], ends[:, 1]]
    exchanges = stamped(made.exchanges.time_ns, ends, measured_m, np.full((2, len(ends)), -85.0))
    made = replace(made, exchanges=exchanges)
    own, fixed = ([one.tracks["robust"] for one in localize_team(made, by, CLOSE)] for by in (known, without(known)))
    assert np.mean([one.rmse_m for one in own]) < 0.75 * np.mean([one.rmse_m for one in fixed])
    assert min(one.offsets[-1] for one in own) > 0.99
    assert consistency(own)[0] < 0.5 * consistency(fixed)[0]
