"""Measurements: shapes, finite numbers and noise are checked at the door."""

import numpy as np
import pytest

from saga_fg import InputError
from saga_fg.estimators import Measurements


def measurements(**columns):
    good = {"nodes": [7, 3], "z": np.zeros((2, 2)), "H": np.eye(2, 4), "R": np.eye(2)}
    return Measurements(**(good | columns))


def test_one_matrix_serves_all_measurements_or_each_has_its_own():
    shared = measurements()
    assert shared.H.shape == (2, 2, 4)
    assert shared.R.shape == (2, 2, 2)
    assert shared.nodes.tolist() == [7, 3]
    assert len(shared) == 2
    each = measurements(H=np.stack([np.eye(2, 4), 2 * np.eye(2, 4)]), R=np.stack([np.eye(2), 3 * np.eye(2)]))
    assert each.H[1, 0, 0] == 2
    assert each.R[1, 0, 0] == 3
    assert not each.z.flags.writeable


def test_a_node_may_be_measured_twice():
    assert measurements(nodes=[3, 3]).nodes.tolist() == [3, 3]


@pytest.mark.parametrize("H", [np.eye(2, 4), np.empty((0, 2, 4))])
def test_nothing_was_measured(H):
    none = Measurements([], np.empty((0, 2)), H, np.eye(2))
    assert len(none) == 0
    assert none.H.shape == (0, 2, 4)


def test_wrong_measurements_are_named(subtests):
    for columns, message in [
        ({"nodes": [1.0, 2.0]}, "nodes: expected a list of integers"),
        ({"nodes": [[1, 2]]}, "nodes: expected a list of integers"),
        ({"nodes": 1}, "nodes: expected a list of integers"),
        ({"nodes": ["a", "b"]}, "nodes: expected a list of integers"),
        ({"nodes": [1]}, r"z: expected shape \(1, any\), got \(2, 2\)"),
        ({"z": np.zeros(2)}, r"z: expected shape \(2, any\)"),
        ({"z": [[0.0, np.nan], [0.0, 0.0]]}, r"z\[0, 1\]: expected a finite number, got nan"),
        ({"z": [[0.0, 0.0], [np.inf, 0.0]]}, r"z\[1, 0\]: expected a finite number, got inf"),
        ({"z": [["a", "b"]] * 2}, "z: expected numbers"),
        ({"H": np.eye(3, 4)}, r"H: expected shape \(2, 2, any\), got \(2, 3, 4\)"),
        ({"H": np.ones(4)}, r"H: expected shape \(2, 2, any\), got \(4,\)"),
        ({"H": np.full((2, 4), np.nan)}, r"H\[0, 0, 0\]: expected a finite number"),
        ({"H": [[1.0, 0.0], [0.0]]}, "H: expected numbers"),
        ({"H": "identity"}, "H: expected"),
        ({"R": np.eye(3)}, r"R: expected shape \(2, 2, 2\), got \(2, 3, 3\)"),
        ({"R": 0.5}, r"R: expected shape \(2, 2, 2\), got \(\)"),
        ({"R": np.zeros((2, 2))}, r"R\[0\]: expected a positive definite matrix"),
        ({"R": -np.eye(2)}, r"R\[0\]: expected a positive definite matrix"),
        ({"R": np.ones((2, 2))}, r"R\[0\]: expected a positive definite matrix"),
        ({"R": [[1.0, 0.2], [0.0, 1.0]]}, r"R\[0\]: expected a symmetric matrix"),
        ({"R": np.stack([np.eye(2), np.diag([1.0, np.inf])])}, r"R\[1, 1, 1\]: expected a finite number"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            measurements(**columns)
