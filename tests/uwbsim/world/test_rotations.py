"""Rotations of quaternions, bit for bit those of scipy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwbsim.world import rotations

RANDOM = np.random.default_rng(1)
FIRST, SECOND = RANDOM.normal(size=(2, 5000, 4))
VECTORS = RANDOM.normal(size=(5000, 3)) * RANDOM.choice([0.0, 1e-4, 1e-2, 1.0], 5000)[:, None]


def test_matrices_and_lengths_are_scipys():
    np.testing.assert_array_equal(rotations.matrices(FIRST), Rotation.from_quat(FIRST).as_matrix())
    np.testing.assert_array_equal(rotations.normalized(FIRST), Rotation.from_quat(FIRST).as_quat())


@pytest.mark.parametrize("vector", [np.array([0.1, -0.2, 0.05]), VECTORS], ids=["one", "many"])
def test_turned_vectors_are_scipys(vector):
    np.testing.assert_array_equal(rotations.turned(FIRST, vector), Rotation.from_quat(FIRST).apply(vector))


def test_products_and_small_turns_are_scipys():
    expected = Rotation.from_rotvec(VECTORS)
    np.testing.assert_array_equal(rotations.of_vectors(VECTORS), expected.as_quat())
    product = rotations.product(rotations.normalized(SECOND), rotations.of_vectors(VECTORS))
    np.testing.assert_array_equal(product, (Rotation.from_quat(SECOND) * expected).as_quat())
