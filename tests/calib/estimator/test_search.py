"""Sparse and dense linear algebra of the estimator give equal results."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize, sparse

import calib
from benchmarks.worlds import FIRST_REPORTED, Recipe, make
from calib.estimator import grouped_errors, inverse, known_distances, rows, unknowns
from calib.estimator.optimize import maximize
from calib.estimator.range_rows import RESIDUAL, Mixture, Part, RangeRows
from calib.estimator.rows import NormalRows, sum_rows
from tests.calib.overhearing import flight


def test_an_arrow_is_inverted_as_the_dense_matrix_is():
    rng = np.random.default_rng(0)
    columns = np.column_stack([np.arange(600)[:, None] // 6 + np.arange(4), rng.integers(103, 107, (600, 2))])
    entries = sparse.csr_matrix((rng.normal(size=3600), columns.ravel(), np.arange(601) * 6), shape=(600, 107))
    matrix = sparse.csc_matrix(entries.T @ entries)
    free = np.flatnonzero(np.arange(107) != 50)
    found, dense = inverse.inverse_of(matrix, free), inverse.inverse_of(matrix.toarray(), free)
    assert isinstance(found, inverse.SparseInverse)
    right = rng.normal(size=(107, 2))
    for one, other in ((found[:, :], dense), (found[3:9, 3:9], dense[3:9, 3:9]), (found @ right, dense @ right)):
        assert one == pytest.approx(other, rel=1e-6, abs=1e-9)
    assert inverse.trace_of_product(found, matrix) == pytest.approx(106, rel=1e-2)


@pytest.mark.parametrize("most", [0, 400])
def test_a_search_ends_at_least_squares_and_finds_the_weight_of_its_prior(most, monkeypatch):
    """A random walk of 200 steps of 0.5 m, measured with 0.1 m of noise."""
    for module in (rows, unknowns):
        monkeypatch.setattr(module, "MOST_DENSE", most)
    rng = np.random.default_rng(1)
    seen = np.cumsum(rng.normal(0, 0.5, 200)) + rng.normal(0, 0.1, 200)
    steps = sparse.csr_matrix(np.eye(199, 200, 1) - np.eye(199, 200))
    prior = unknowns.Prior(weight=1.0, structure=sparse.csc_matrix(steps.T @ steps), rows=199, bounds=(1e-3, 1e3))
    layout = unknowns.Layout((unknowns.Unknown(kind="path", names=("",) * 200, start=np.zeros(200), priors=(prior,)),))
    every = NormalRows(value=seen, std=np.full(200, 0.1), entries=np.ones((200, 1)), columns=np.arange(200)[:, None])
    priors = unknowns.Priors(layout)
    found = maximize([every], priors, layout.start(), tolerance=1e-6)
    assert found.success
    assert priors.deviation("path") == pytest.approx(0.5, rel=0.15)
    precision = priors.weights[0] * (steps.T @ steps).toarray() + np.eye(200) / 0.01
    assert found.x == pytest.approx(np.linalg.solve(precision, seen / 0.01), abs=1e-4)


@pytest.mark.parametrize("most", [0, 400])
def test_a_search_finds_the_power_of_units_of_a_prior(most, monkeypatch):
    """Standard deviations of 0.5 m times units to the power of 0.6; the values are measured with 0.1 m of noise."""
    for module in (rows, unknowns):
        monkeypatch.setattr(module, "MOST_DENSE", most)
    rng, names = np.random.default_rng(2), ("",) * 400
    unit = rng.normal(0, 1, 400)
    seen = 0.5 * np.exp(0.6 * (unit - unit.mean())) * rng.normal(size=400) + rng.normal(0, 0.1, 400)
    units = unknowns.Unknown(kind="unit", names=names, start=unit, known=np.ones(400, dtype=bool))
    layout = unknowns.Layout((units, grouped_errors.scattered("offset", names, (0.1, 1e-3, 10.0), unit="unit")))
    every = NormalRows(
        value=seen, std=np.full(400, 0.1), entries=np.ones((400, 1)), columns=400 + np.arange(400)[:, None]
    )
    priors = unknowns.Priors(layout)
    assert maximize([every], priors, layout.start(), tolerance=1e-6).success
    # 400 values determine a standard deviation and a power to 0.035 (the root of 1/800).
    assert priors.deviation("offset") == pytest.approx(0.5, rel=0.1)
    assert priors.powers.tolist() == pytest.approx([0.6], abs=0.1)


# The end of a search is the same for different starts near it.


@pytest.mark.parametrize(
    "data",
    [
        lambda: make(Recipe(seconds=60, share=(0, 0.5)), FIRST_REPORTED).ranges,
        pytest.param(lambda: flight(7100, reflected=0.15, bias_m=0.1)[0], marks=pytest.mark.slow),
    ],
    ids=["world", "listeners"],
)
def test_a_search_ends_at_one_optimum_of_unknowns_and_weights(data):
    found = known_distances.fit_known_distances(calib.load_ranges(data()), calib.FitSettings())
    search, optimum = found.searches[0], found.searches[0].optimum
    rows = [own for own in (search.rows, search.heard, *search.gauge) if own is not None]
    asked = optimum.layout.indices([unknown.kind for unknown in found.model.unknowns])
    std = np.sqrt(np.diag(found.covariances["delay"]))
    for seed in range(3):
        rng = np.random.default_rng(seed)
        known = zip(optimum.priors.weights, optimum.priors.all, strict=True)
        weights = [w if prior.bounds is None else w * np.exp(rng.normal()) for w, (_, prior) in known]
        # Starts differ by a standard error, in logarithms by a half at most: farther away, there may be other optima.
        away = np.minimum(np.sqrt(np.diag(np.asarray(optimum.covariance))), 0.5) * rng.normal(size=len(optimum.x))
        again = maximize(rows, unknowns.Priors(optimum.layout, weights), optimum.x + away, asked=asked)
        assert (again.success, again.steps < 25) == (True, True)
        # A search ends if a step gains less than 0.01 in log likelihood, at most a tenth of a standard error, for both
        # searches.
        assert np.abs((again.of("delay") - optimum.of("delay")) / std).max() < 0.2


# Errors of groups divided into noise, reflections and outliers, and the mean information of ranges by the model.


def mixed(n=40_000, share=0.12, mean_m=0.35, outlier=0.0, seed=3):
    """Return errors of two groups, about 3 cm and about a metre."""
    rng = np.random.default_rng(seed)
    sigma, centre = np.array([0.06, 0.12])[np.arange(n) % 2], np.array([0.03, 1.0])[np.arange(n) % 2]
    error = centre + rng.normal(size=n) * sigma + np.where(rng.random(n) < share, rng.exponential(mean_m, n), 0)
    error = np.where(rng.random(n) < outlier, rng.uniform(-40, 40, n), error)
    return [error[::2], error[1::2]]


@pytest.mark.parametrize(
    "planted",
    [{}, {"outlier": 0.03}, {"share": 0.0}, {"mean_m": 1.0}],
    ids=["one kind", "outliers", "no reflections", "long detours"],
)
def test_the_parts_of_errors_are_found(planted):
    found, sound = grouped_errors.fit_grouped_errors(mixed(**planted)), "outlier" not in planted
    share = planted.get("share", 0.12)
    # 20,000 errors determine the centre to 0.6 and 1.2 mm and a sigma to 0.5 %; three times that are allowed.
    np.testing.assert_allclose(found.centre_m, [0.03, 1.0], atol=0.0035)
    np.testing.assert_allclose(found.sigma_m, [0.06, 0.12], rtol=0.02)
    np.testing.assert_allclose(found.reflected, share, atol=0.012 if sound else 0.02)
    # Planted outliers are spread over 80 m, those of the model over 10 m.
    np.testing.assert_allclose(found.outliers, planted.get("outlier", 0.0), atol=0.012)
    if share and sound:
        np.testing.assert_allclose(found.detour_m, planted.get("mean_m", 0.35), rtol=0.06)
    assert (found.centre_m - [0.03, 1.0]) / found.centre_std_m == pytest.approx([0, 0], abs=3)


VALUES = {"noise": np.log(0.04), "odds": -2.0, "detour": np.log(0.3), "least": np.log(0.02), "outliers": -8.0}


@pytest.mark.parametrize("spread_m", [0.03, pytest.param(100.0, marks=pytest.mark.slow)])
def test_noise_is_that_of_restricted_likelihood_however_many_offsets_there_are(spread_m):
    # Six ranges for each of 100 offsets; without a prior this is the pooled variance, else an analysis of variance.
    rng = np.random.default_rng(4)
    offset, noise = 0.03 * rng.normal(size=(100, 1)), 0.05 * rng.normal(size=(100, 6))
    group, error = np.repeat(np.arange(100), 6), (offset + noise).ravel()
    blocks = [
        unknowns.Unknown(kind=kind, names=("",), start=np.array([at]), known=np.array([kind != "noise"]))
        for kind, at in (VALUES | {"long": -30.0, "odds": -40.0, "outliers": -40.0, "noise": -5.0}).items()
    ]
    prior = unknowns.Prior.of_deviation(spread_m)
    blocks.append(unknowns.Unknown(kind="offset", names=("",) * 100, start=np.zeros(100), priors=(prior,)))
    parts = [Part(parameter=b.kind, kind=b.kind, columns=np.zeros((1, 1), dtype=np.int64)) for b in blocks[:-1]]
    parts.append(Part(parameter=RESIDUAL, kind="offset", columns=group[:, None], values=np.full((600, 1), -1.0)))
    layout = unknowns.Layout(tuple(blocks))
    rows = RangeRows.of(error, group, parts, Mixture(restricted=True), layout)
    found = maximize([rows], unknowns.Priors(layout), layout.start(), evidence_steps=60)
    within = float(np.mean(np.var(error.reshape(100, 6), axis=1, ddof=1)))
    means = error.reshape(100, 6).mean(axis=1)

    def unlikely(log_noise):
        noise_m2 = np.exp(2 * log_noise)
        between = spread_m**2 + noise_m2 / 6
        return 500 * log_noise + 250 * within / noise_m2 + np.sum(np.log(between) + means**2 / between) / 2

    best = optimize.minimize_scalar(unlikely, bounds=(-5, -1), method="bounded").x
    assert found.of("noise")[0] == pytest.approx(best, abs=0.005)
    assert np.exp(best) == pytest.approx(0.05, rel=0.08)
    # The joint likelihood gives a smaller value, by up to a tenth.
    assert maximize([rows], unknowns.Priors(layout), layout.start(), evidence_steps=0).of("noise")[0] < best - 0.03


@pytest.mark.parametrize("spread", [0.0, 0.5])
def test_few_ranges_determine_how_much_the_noise_of_groups_differs(spread):
    """300 groups of four normal errors, whose logarithms of noise have this standard deviation."""
    rng = np.random.default_rng(6)
    noise = 0.05 * np.exp(spread * rng.normal(size=(300, 1)))
    group, names = np.repeat(np.arange(300), 4), ("",) * 300
    blocks, parts = grouped_errors.error_unknowns(0.05, names, group)
    prior = unknowns.Prior.of_deviation(1e-3)
    blocks.append(unknowns.Unknown(kind="offset", names=names, start=np.zeros(300), priors=(prior,)))
    parts.append(Part(parameter=RESIDUAL, kind="offset", columns=group[:, None], values=np.full((1200, 1), -1.0)))
    layout = unknowns.Layout(tuple(blocks))
    error = (noise * rng.normal(size=(300, 4))).ravel()
    priors = unknowns.Priors(layout)
    maximize([RangeRows.of(error, group, parts, Mixture(restricted=True), layout)], priors, layout.start())
    # Logarithms of the noise of four draws scatter by 0.35, so 300 groups determine a spread of 0.5 to 0.03, and limit
    # one of 0 to 0.1: twice this. With squares of slopes instead of expected information it is 0.58.
    assert priors.deviation("noise of pair") == pytest.approx(spread, abs=0.06 if spread else 0.14)
    # No range is reflected: the first value stays or falls; with squares of slopes it rises to its bound of 2.
    assert priors.deviation("odds of pair") < 0.75


def test_expected_information_is_the_mean_of_squared_slopes_of_drawn_errors():
    """Three groups of errors with other noise, or another share of reflections."""
    rng, count = np.random.default_rng(0), 40_000
    sigma, share = np.repeat([[0.05, 0.05, 0.1], [0.1, 0.3, 0.1]], count, axis=1)
    reflected = rng.random(3 * count) < share
    error = rng.normal(0, sigma) + reflected * (0.03 + rng.exponential(0.3, 3 * count))
    common = {"detour": np.log(0.3), "least": np.log(0.03), "outliers": -30.0, "long": -30.0}
    values = {RESIDUAL: error, "noise": np.log(sigma), "odds": np.log(share / (1 - share))}
    values |= {name: np.array([value]) for name, value in common.items()}
    drawn, known = Mixture().slopes(values)[1], Mixture(expected=True).slopes(values)[2]
    # The typical information is scaled to other groups, which is right to a sixth; for shares, noise is not in it.
    for name, tolerance in {"noise": 0.2, "detour": 0.2, "odds": 0.45}.items():
        squares = (drawn[name] ** 2).reshape(3, count).mean(axis=1)
        stated = np.sum([np.broadcast_to(one[name], 3 * count) ** 2 for one in known.directions], axis=0)
        assert stated[::count] == pytest.approx(squares, rel=tolerance)


def test_noise_accounts_for_other_unknowns():
    rng = np.random.default_rng(1)
    kinds = VALUES | {"long": -30.0, RESIDUAL: 0.0}
    layout = unknowns.Layout(
        tuple(unknowns.Unknown(kind=kind, names=("",), start=np.array([at])) for kind, at in kinds.items())
    )
    count, one = 40_000, np.zeros((1, 1), dtype=np.int64)
    reflected = rng.random(count) < 1 / (1 + np.exp(2.0))
    error = 0.04 * rng.normal(size=count) + reflected * (0.02 + rng.exponential(0.3, count))
    parts = [Part(parameter=kind, kind=kind, columns=one) for kind in kinds]
    rows = RangeRows.of(error, np.zeros(count, dtype=np.int64), parts, Mixture(), layout)
    noise = rows.values(layout.start(), ("noise",))["noise"]
    plain, used = (
        sum_rows([replace(rows, unsure_m2=share * np.exp(2 * noise))], layout.start()).gradient[
            layout.where["noise"].start
        ]
        for share in (0.0, 0.1)
    )
    assert used - plain == pytest.approx(0.1 * len(rows))
