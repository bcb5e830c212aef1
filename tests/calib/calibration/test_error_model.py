"""What errors are made of, against draws of core, tail and outliers, and in files."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import exponnorm, norm

import calib
from calib.calibration.error_model import ErrorModel, PairErrors
from calib.calibration.model import Calibration

MODEL = ErrorModel(
    lifted=(0.1, 0.5, 1.5),
    noise_m=(0.08, 0.05, 0.03),
    tail_share=(0.3, 0.2, 0.1),
    least_m=0.05,
    detour_m=0.3,
    outlier_share=0.002,
    outlier_m=0.9,
    location_m=0.02,
    pairs={"1-2": PairErrors(1.5, 3.0, 0.5)},
)
COUNT = 400_000


TWO_KINDS = replace(MODEL, long_share=0.4, long_factor=4.0)


def drawn(model, lifted, known, seed=0):
    """Draw errors of one kind of range, and which were reflected, straight from the definition."""
    rng = np.random.default_rng(seed)
    noise = np.exp(np.interp(lifted, MODEL.lifted, np.log(MODEL.noise_m))) * (1.5 if known else 1)
    odds = np.exp(np.interp(lifted, MODEL.lifted, [np.log(t / (1 - t)) for t in MODEL.tail_share]))
    share = 1 / (1 + 1 / (odds * (3.0 if known else 1.0)))
    mean = 0.3 * (0.5 if known else 1) / (0.6 + 0.4 * 4 if model is TWO_KINDS else 1)
    longer = np.where((rng.random(COUNT) < 0.4) & (model is TWO_KINDS), 4.0, 1.0)
    kind, error = rng.random(COUNT), rng.normal(0, noise, COUNT)
    reflected, wild = kind < 0.998 * share, kind > 0.998
    error += reflected * (0.05 + rng.exponential(mean * longer))
    error = np.where(wild, rng.normal(0, 0.9, COUNT), error)
    return error + 0.02, reflected


@pytest.mark.parametrize("model", [MODEL, TWO_KINDS], ids=["one kind", "two kinds"])
@pytest.mark.parametrize(("lifted", "first", "second"), [(0.1, 1, 2), (0.7, 2, 1), (0.7, 1, 3), (4.0, 7, 3)])
def test_mean_spread_quantiles_and_shares_are_those_of_draws(model, lifted, first, second):
    error, reflected = drawn(model, lifted, {first, second} == {1, 2})
    ends = np.full(1, first), np.full(1, second)
    shapes = model.shapes(np.full(1, lifted), *ends)
    # Four standard errors of each figure, from 400 000 draws.
    assert model.mean_m(shapes)[0] == pytest.approx(error.mean(), abs=4 * error.std() / np.sqrt(COUNT))
    assert model.total_m(shapes)[0] == pytest.approx(error.std(), rel=0.015)
    assert shapes.tail_share[0] == pytest.approx(np.mean(reflected) / 0.998, abs=0.003)
    shares = [0.01, 0.025, 0.3, 0.9, 0.975]
    if lifted == 0.1 or lifted > 1.5:
        found = model.quantiles(shares, np.full(1, lifted), *ends)[0]
        np.testing.assert_allclose([np.mean(error < q) for q in found], shares, atol=0.002)
    for value in (-0.1, 0.05, 0.15, 0.6):
        assert model.below(np.full(1, value), shapes)[0] == pytest.approx(np.mean(error < value), abs=0.0032)


def test_errors_beyond_everything_are_outliers():
    shapes = MODEL.shapes(np.full(3, 0.5), np.full(3, 1), np.full(3, 2))
    tail, outlier = MODEL.tail_given(np.array([-3.0, 80.0, 1e6]), shapes)
    assert outlier[0] > 0.999
    assert outlier[2] == 1.0
    assert np.isfinite(tail).all()


def test_what_an_error_was_follows_from_the_densities_of_scipy():
    model = replace(MODEL, outlier_share=0.05, outlier_m=3.0)
    error = np.linspace(-1, 4, 101)
    shapes = model.shapes(np.full(101, 0.5), np.full(101, 3), np.full(101, 7))
    core = 0.95 * 0.8 * norm.pdf(error - 0.02, scale=0.05)
    tail = 0.95 * 0.2 * exponnorm.pdf(error - 0.02, 0.3 / 0.05, loc=0.05, scale=0.05)
    wild = 0.05 * norm.pdf(error - 0.02, scale=3.0)
    found = model.tail_given(error, shapes)
    np.testing.assert_allclose(found, [tail / (core + tail + wild), wild / (core + tail + wild)], atol=1e-9)


@pytest.fixture(scope="module")
def fitted():
    return calib.fit(calib.sample_flight()).calibration


def test_a_file_gives_it_back_and_files_without_it_open(fitted):
    assert fitted.errors is not None
    again = Calibration.from_json(fitted.to_json())
    assert again.errors == fitted.errors
    flight = calib.load_ranges(calib.sample_flight(seed=2))
    np.testing.assert_array_equal(again.quantiles(flight), fitted.quantiles(flight))
    document = json.loads(fitted.to_json())
    del document["errors"]
    old = Calibration.from_json(json.dumps(document))
    applied = old.apply(flight)
    assert np.isnan(applied.sigma_total_m).all()
    assert np.isnan(applied.tail_share).all()
    assert not applied.outlier.any()
    np.testing.assert_array_equal(applied.corrected_m, fitted.apply(flight).corrected_m)
    assert json.loads(json.dumps(calib.evaluate(flight, old).to_dict()))["overall"]["total_std"] is None
    assert "-" in repr(calib.evaluate(flight, old))
    with pytest.raises(calib.UnanswerableError, match="does not say what errors are made of"):
        old.quantiles(flight)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("lifted", [0.1], "errors: lifted"),
        ("noise_m", [0.0] * 8, "errors: noise_m: 0: .*above 0"),
        ("noise_m", [1.0] * 7, "errors: lifted"),
        ("tail_share", [1.5] * 8, "errors: tail_share: 0"),
        ("pairs", {"one-two": {}}, "names of pairs"),
        ("pairs", {"1-2": {"noise": 1.0, "odds": 0.0, "detour": 1.0}}, "1-2: odds"),
        ("levels", [[0.1]], "levels"),
        ("scale", "wide", "scale"),
    ],
)
def test_a_damaged_model_is_one_clear_error(fitted, key, value, said):
    document = json.loads(fitted.to_json())
    document["errors"][key] = value
    with pytest.raises(calib.BadInputError, match=said):
        Calibration.from_json(json.dumps(document), "here")


def test_a_fit_says_how_long_errors_of_a_pair_last():
    """Half of the variance is a Gauss-Markov process of each pair that forgets in half a second."""
    flight = calib.load_ranges(calib.sample_flight(9000))
    rng, shared = np.random.default_rng(5), np.zeros(len(flight))
    for pair in range(3):
        keep = np.exp(-0.03 / 0.5)
        steps = rng.normal(0, 0.03 * np.sqrt(1 - keep**2), len(flight) // 3)
        shared[pair::3] = lfilter([1.0], [1.0, -keep], steps)
    found = calib.fit(replace(flight, raw_m=flight.raw_m + shared)).calibration
    lasting = found.errors.lasting
    assert lasting.lasting_variance == pytest.approx(0.5, abs=0.1)
    assert lasting.own_variance == pytest.approx(0.5, abs=0.1)
    assert lasting.time_s == pytest.approx(0.5, rel=0.4)
    assert abs(lasting.mean) < 0.1
    assert Calibration.from_json(found.to_json()) == found
    assert calib.fit(flight).calibration.errors.lasting.lasting_variance < 0.05


@pytest.mark.parametrize("shares", [[], [0.0], [1.2], [[0.5]]])
def test_shares_that_are_none(fitted, shares):
    with pytest.raises(calib.BadInputError, match=r"`shares`: .*between 0 and 1"):
        fitted.quantiles(calib.load_ranges(calib.sample_flight()), shares)
