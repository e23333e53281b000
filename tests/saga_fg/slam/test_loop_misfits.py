"""The sparse system of loops against the dense covariance of all of them, by the textbook."""

from __future__ import annotations

import numpy as np
import pytest

from saga_fg.slam.submaps.loops import Misfits

STEPS, LOOPS = 6, 5


def covariances(rng: np.random.Generator, *shape: int) -> np.ndarray:
    A = rng.normal(size=(*shape, 6, 8))
    return A @ A.swapaxes(-1, -2)


def random_misfits(seed: int) -> Misfits:
    rng = np.random.default_rng(seed)
    first = rng.integers(0, STEPS - 1, LOOPS)
    ends = np.column_stack([first, rng.integers(first + 1, STEPS + 1)])
    moved = np.eye(6) + 0.3 * rng.normal(size=(STEPS, 6, 6))
    turned = np.array([np.linalg.multi_dot([np.eye(6), *moved[a:b][::-1], np.eye(6)]) for a, b in ends.tolist()])
    parts = np.zeros((STEPS, 3, 6, 6))
    both = covariances(rng, STEPS)
    parts[:, 0, :3, :3], parts[:, 1, 3:, 3:] = both[:, :3, :3], both[:, 3:, 3:]
    parts[:, 2] = both - parts[:, 0] - parts[:, 1]
    return Misfits(rng.normal(size=(LOOPS, 6)), ends, turned, moved, parts, covariances(rng, LOOPS))


def dense(misfits: Misfits, inflation: np.ndarray) -> np.ndarray:
    """C (6M, 6M): each loop is the sum of the steps that it passes, carried to its end."""
    a, b = inflation
    Q = np.einsum("g,sgij->sij", [a**2, b**2, a * b], misfits.parts)
    J = np.zeros((LOOPS, 6, STEPS, 6))
    for k, (first, second) in enumerate(misfits.ends.tolist()):
        carried = np.eye(6)
        for s in range(second - 1, first - 1, -1):
            J[k, :, s] = carried
            carried = carried @ misfits.moved[s]
    C = np.einsum("kisj,sjl,mnsl->kimn", J, Q, J)
    C[np.arange(LOOPS), :, np.arange(LOOPS)] += misfits.R
    return C


@pytest.mark.parametrize("seed", range(2))
def test_the_sparse_system_says_what_the_dense_covariance_does(seed: int) -> None:
    rng, misfits = np.random.default_rng(seed), random_misfits(seed)
    kept, inflation = np.array([True, True, False, True, True]), rng.uniform(1.0, 5.0, 2)
    blocks = dense(misfits, inflation)
    C, m = blocks[kept][:, :, kept].reshape(24, 24), misfits.m[kept].ravel()
    solution = misfits.solved(kept, inflation, misfits.loops(kept))
    expected = m @ np.linalg.solve(C, m) + np.linalg.slogdet(C)[1]
    np.testing.assert_allclose(solution.cost, expected, rtol=1e-7)
    v, V = solution.left_out(np.arange(LOOPS), kept)
    for row in range(LOOPS):
        others = kept & (np.arange(LOOPS) != row)
        size = 6 * int(others.sum())
        across = blocks[row][:, others].reshape(6, size)
        gain = across @ np.linalg.inv(blocks[others][:, :, others].reshape(size, size))
        np.testing.assert_allclose(v[row], misfits.m[row] - gain @ misfits.m[others].ravel(), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(V[row], blocks[row, :, row] - gain @ across.T, rtol=1e-5, atol=1e-6)
