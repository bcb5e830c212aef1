"""What an information matrix determines: planted free directions, and the words for them."""

import numpy as np
import pytest

from calib.errors import BadInputError
from calib.information import Unknown, judge, reduced

DELAYS = [Unknown("delay", str(tag)) for tag in range(1, 5)]


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


def test_an_even_ring_leaves_one_direction_free_and_says_which():
    verdict = judge(from_rows(ring(closed=False)), DELAYS)
    assert list(verdict.free) == ["delays of 1 and 3 against delays of 2 and 4"]
    assert np.isinf(verdict.std).all()
    assert np.isnan(verdict.covariance).all()
    assert verdict.named("delay") == ("1", "2", "3", "4")


def test_two_free_directions_are_told_apart_whatever_basis_rounding_chose():
    """Two pairs that range with each other alone: each shifts within itself."""
    verdict = judge(from_rows([[1, 1, 0, 0], [0, 0, 1, 1]]), DELAYS)
    assert sorted(verdict.free) == ["delay of 1 against delay of 2", "delay of 3 against delay of 4"]


def test_a_common_shift_with_distances_is_called_so():
    """Three delays and a distance each: ranges are distances less delays, and differences of distances are known."""
    unknowns = [Unknown("delay", t) for t in "123"] + [Unknown("distance", p) for p in ("1-2", "2-3", "1-3")]
    rows = [[-1, -1, 0, 1, 0, 0], [0, -1, -1, 0, 1, 0], [-1, 0, -1, 0, 0, 1], [0, 0, 0, 1, -1, 0], [0, 0, 0, 0, 1, -1]]
    verdict = judge(from_rows(rows), unknowns)
    assert list(verdict.free) == ["all delays together with all distances together"]
    assert verdict.named("distance") == ("1-2", "2-3", "1-3")


def test_what_is_hardly_known_counts_as_free_by_the_scale_of_an_unknown():
    information = np.diag([1e4, 1.0])
    delays = [Unknown("delay", "1"), Unknown("delay", "2")]
    assert judge(information, delays).named("delay") == ("2",)
    assert not judge(information, delays, loosest=1.5).free
    wide = [Unknown("delay", "1"), Unknown("delay", "2", scale=10.0)]
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


def test_coordinates_of_one_thing_are_named_once():
    unknowns = [Unknown("position", "3"), Unknown("position", "3"), Unknown("position", "4"), Unknown("delay", "3")]
    verdict = judge(from_rows([[1, 2, 0, 1], [0, 0, 1, 0], [1, -1, 0, 0]]), unknowns)
    assert list(verdict.free) == ["position of 3 with delay of 3"]


def test_nothing_measured_leaves_everything_free():
    verdict = judge(np.zeros((2, 2)), DELAYS[:2])
    assert len(verdict.free) == 2
    assert np.isinf(verdict.std).all()


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
