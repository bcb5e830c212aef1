"""What an information matrix determines: planted free directions, and the words for them."""

import numpy as np
import pytest

from calib.errors import BadInputError
from calib.information import InformationColumn, judge, reduced

DELAYS = [InformationColumn("delay", str(tag)) for tag in range(1, 5)]


def from_rows(rows, weight=1e4):
    rows = np.array(rows, dtype=float)
    return weight * rows.T @ rows


def ring(*, closed=True):
    """Sums of delays of neighbours, and with `closed` a triangle that settles everything."""
    rows = [[1, 1, 0, 0], [0, 1, 1, 0], [0, 0, 1, 1], [1, 0, 0, 1]]
    return rows + ([[1, 0, 1, 0]] if closed else [])


def test_a_full_matrix_gives_the_inverse():
    information = from_rows(ring())
    verdict = judge(information, DELAYS)
    assert verdict.determined.all()
    assert str(verdict) == "everything is determined"
    np.testing.assert_allclose(verdict.covariance, np.linalg.inv(information), rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(verdict.std, np.sqrt(np.diag(np.linalg.inv(information))), rtol=1e-9)


SIDES = [InformationColumn("delay", t) for t in "123"] + [
    InformationColumn("distance", p) for p in ("1-2", "2-3", "1-3")
]
# Ranges are distances less delays, and differences of distances are known.
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
    assert sorted(verdict.free) == free
    assert verdict.named(kind) == of
    loose = ~verdict.determined
    assert np.isnan(verdict.covariance[loose]).all()


def test_what_is_hardly_known_counts_as_free_by_the_scale_of_an_unknown():
    information = np.diag([1e4, 1.0])
    delays = [InformationColumn("delay", "1"), InformationColumn("delay", "2")]
    assert judge(information, delays).named("delay") == ("2",)
    assert not judge(information, delays, loosest=1.5).free
    wide = [InformationColumn("delay", "1"), InformationColumn("delay", "2", scale=10.0)]
    verdict = judge(information, wide)
    assert not verdict.free
    assert verdict.std[1] == pytest.approx(1.0)
    loose = judge(np.diag([1e4, 0.0025]), wide)
    assert loose.named("delay") == ("2",)


def test_a_known_unknown_beside_free_ones_keeps_its_variance():
    verdict = judge(from_rows([[1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1]]), DELAYS)
    assert verdict.determined.tolist() == [False, False, True, True]
    assert verdict.std[2] == pytest.approx(0.01)
    assert verdict.covariance[2, 3] == pytest.approx(-1e-4)


def test_reducing_is_what_the_inverse_says_and_leaves_free_what_was():
    rng = np.random.default_rng(3)
    rows = rng.normal(size=(9, 6))
    information = rows.T @ rows
    inner = np.linalg.inv(np.linalg.inv(information)[:3, :3])
    np.testing.assert_allclose(reduced(information, [0, 1, 2]), inner, rtol=1e-8)
    rows[:, 5] = rows[:, 0]  # a nuisance that cannot be told from the first
    lost = judge(reduced(rows.T @ rows, np.arange(6) < 3), DELAYS[:3], loosest=10.0)
    assert lost.named("delay") == ("1",)


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
def test_what_is_no_information_matrix_is_refused(matrix, settings, message):
    with pytest.raises(BadInputError, match=message):
        judge(matrix, DELAYS[:2], **settings)
