"""Directions that an information matrix determines: planted free directions, and their description."""

import numpy as np
import pytest
from scipy import integrate, stats

from calib.errors import BadInputError
from calib.information import InformationColumn, judge
from calib.range_errors.densities import LongDetours, densities, error_slopes
from calib.spread import radius_95

DELAYS = [InformationColumn("delay", str(tag)) for tag in range(1, 5)]


def from_rows(rows):
    rows = np.array(rows, dtype=float)
    return 1e4 * rows.T @ rows


def ring(*, closed=True):
    """Return sums of delays of neighbours, and with `closed` a triangle that determines all."""
    return [[1, 1, 0, 0], [0, 1, 1, 0], [0, 0, 1, 1], [1, 0, 0, 1]] + ([[1, 0, 1, 0]] if closed else [])


def test_a_full_matrix_gives_the_inverse():
    information = from_rows(ring())
    verdict = judge(information, DELAYS)
    assert verdict.determined.all()
    assert str(verdict) == "all unknowns are determined"
    np.testing.assert_allclose(verdict.covariance, np.linalg.inv(information), rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(verdict.std, np.sqrt(np.diag(np.linalg.inv(information))), rtol=1e-9)


SIDES = [InformationColumn("delay", t) for t in "123"] + [
    InformationColumn("distance", p) for p in ("1-2", "2-3", "1-3")
]
# Ranges are distances minus delays, and differences of distances are known.
TRIANGLE = [
    [-1, -1, 0, 1, 0, 0], [0, -1, -1, 0, 1, 0], [-1, 0, -1, 0, 0, 1], [0, 0, 0, 1, -1, 0], [0, 0, 0, 0, 1, -1]
]  # fmt: skip
BOARDS = [
    InformationColumn("position", "3"),
    InformationColumn("position", "3"),
    InformationColumn("position", "4"),
    InformationColumn("delay", "3"),
]


@pytest.mark.parametrize(
    ("rows", "unknowns", "free", "kind", "of"),
    [
        (ring(closed=False), DELAYS, ["delays of 1 and 3 against delays of 2 and 4"], "delay", ("1", "2", "3", "4")),
        (
            [[1, 1, 0, 0], [0, 0, 1, 1]],
            DELAYS,
            ["delay of 1 against delay of 2", "delay of 3 against delay of 4"],
            "delay",
            ("1", "2", "3", "4"),
        ),
        (TRIANGLE, SIDES, ["all delays together with all distances together"], "distance", ("1-2", "2-3", "1-3")),
        ([[1, 2, 0, 1], [0, 0, 1, 0], [1, -1, 0, 0]], BOARDS, ["position of 3 with delay of 3"], "delay", ("3",)),
        (np.zeros((1, 2)), DELAYS[:2], ["delay of 1", "delay of 2"], "delay", ("1", "2")),
    ],
)
def test_free_directions_are_found_and_named(rows, unknowns, free, kind, of):
    verdict = judge(from_rows(rows), unknowns)
    assert (sorted(verdict.free), verdict.named(kind)) == (free, of)
    assert np.isnan(verdict.covariance[(~verdict.determined)]).all()


def test_determined_unknowns_keep_their_variance():
    verdict = judge(from_rows([[1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1]]), DELAYS)
    assert (verdict.determined.tolist(), verdict.std[2]) == ([False, False, True, True], pytest.approx(0.01))
    assert verdict.covariance[2, 3] == pytest.approx(-1e-4)


@pytest.mark.parametrize(
    ("matrix", "settings", "message"),
    [
        (np.eye(3), {}, "shape"),
        (np.array([[1.0, np.nan], [np.nan, 1.0]]), {}, "not finite"),
        (np.array([[1.0, 0.5], [0.0, 1.0]]), {}, "not symmetric"),
        (np.diag([1.0, -1.0]), {}, "eigenvalue"),
        (np.eye(2), {"loosest": 0.0}, "loosest"),
    ],
)
def test_wrong_information_matrices_are_refused(matrix, settings, message):
    with pytest.raises(BadInputError, match=message):
        judge(matrix, DELAYS[:2], **settings)


# The model of the error of a range compared with SciPy, integrals and differences that share no code with it.


SIGMA, LEAST, DETOUR = 0.08, 0.1, 0.3


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_one_and_two_kinds_of_detour_are_exponentials(share):
    # From far below the least detour to where the noise is negligible.
    e, long = np.linspace(-0.6, 12, 500), LongDetours(share=share, factor=4.0)
    found = densities(e, np.full(500, SIGMA), LEAST, DETOUR, long)
    np.testing.assert_allclose(found.direct, stats.norm.pdf(e, scale=SIGMA), rtol=1e-12, atol=1e-300)
    first = DETOUR / (1 - share + share * 4)
    parts = [(1 - share, first), (share, 4 * first)]
    expected = sum(share * stats.exponnorm.pdf(e, mean / SIGMA, loc=LEAST, scale=SIGMA) for share, mean in parts)
    np.testing.assert_allclose(found.reflected, expected, rtol=1e-9, atol=1e-300)
    assert sum(share * mean for share, mean in parts) == pytest.approx(DETOUR)
    assert long.square * DETOUR**2 == pytest.approx(sum(share * mean**2 for share, mean in parts))
    # Mean and variance of the noise follow from slope and curvature of the density (Tweedie's formula).
    step = 1e-4
    before, here, after = (
        np.log(densities(e[:200] + k * step, np.full(200, SIGMA), LEAST, DETOUR, long).reflected) for k in (-1, 0, 1)
    )
    slope, bend = (after - before) / (2 * step), (after - 2 * here + before) / step**2
    np.testing.assert_allclose(found.noise_m()[:200], -(SIGMA**2) * slope, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(found.noise_var()[:200], 1 + SIGMA**2 * bend, rtol=1e-3, atol=1e-4)


SHAPE = {
    "noise": np.log(0.06),
    "odds": -1.5,
    "detour": np.log(0.2),
    "least": np.log(0.05),
    "outliers": -4.0,
    "long": -1.0,
}


def slopes(error, **changed):
    values = {name: np.full(1, value) for name, value in (SHAPE | changed).items()}
    return error_slopes(np.atleast_1d(np.asarray(error, dtype=float)), values)


def test_the_density_is_one():
    points = [0.0, 0.05, 0.2, 1.0]
    mass, _ = integrate.quad(lambda e: float(np.exp(slopes(e).log_density[0])), -1.0, 9.0, points=points, limit=400)
    # Outliers are spread over ten metres, from any origin.
    assert mass == pytest.approx(1.0, abs=2e-4)


@pytest.mark.parametrize("error", [-0.15, 0.0, 0.1, 0.6, 3.0])
@pytest.mark.parametrize("name", ["residual", *SHAPE])
def test_slopes_are_derivatives(error, name):
    def at(moved):
        changed = {name: SHAPE[name] + moved} if name in SHAPE else {}
        return slopes(error + moved * (name == "residual"), **changed).log_density[0]

    assert slopes(error).by[name][0] == pytest.approx((at(1e-5) - at(-1e-5)) / 2e-5, rel=1e-4, abs=1e-5)


# Radii that contain 95 % of values.


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 0), (1, 0, 0), (4, 1, 0.1), (1, 0.5)], ids=str)
def test_the_radius_of_95_percent_contains_95_percent_of_draws(shape):
    rng = np.random.default_rng(1)
    turn = np.linalg.qr(rng.normal(size=(len(shape), len(shape))))[0]
    covariance = 0.03**2 * turn @ np.diag(shape) @ turn.T
    drawn = rng.normal(size=(200_000, len(shape))) * 0.03 * np.sqrt(shape) @ turn.T
    # The share of so many draws has a standard error of 0.05 %, and the approximation an error below 0.2 %.
    assert np.mean(np.linalg.norm(drawn, axis=1) < radius_95(covariance)) == pytest.approx(0.95, abs=0.004)
    assert radius_95(0 * covariance) == 0.0
