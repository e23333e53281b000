"""Exponentials and their integrals against those of whole matrices."""

from itertools import product

import numpy as np
from scipy.linalg import expm

from saga_fg.kernels.matrix_functions import coupling_integrals
from saga_fg.model.discretisation import linear_motions


def near(one, other, tolerance=1e-11):
    """Stacks of matrices that agree up to rounding, relative to the largest entry of each."""
    assert one.shape == other.shape
    scale = np.abs(other).max(axis=(1, 2), keepdims=True, initial=1e-12)
    assert (np.abs(one - other) <= tolerance * scale).all()


def test_motions_are_those_of_the_matrix_exponential(subtests):
    """exp(A dt), and Q by the exponential of [[A, Qc], [0, -A^T]] dt (Van Loan, 1978)."""
    for d, dt in product([1, 2, 4, 6], [0.05, 1.0, 8.0]):
        with subtests.test(d=d, dt=dt):
            rng = np.random.default_rng(d)
            A, root = 0.3 * rng.normal(size=(12, d, d)), rng.normal(size=(12, d, d))
            Qc = root @ np.swapaxes(root, 1, 2)
            F, Q = linear_motions(A, Qc, dt)
            whole = expm(dt * np.block([[A, Qc], [np.zeros_like(A), -np.swapaxes(A, 1, 2)]]))
            near(F, whole[:, :d, :d])
            near(Q, whole[:, :d, d:] @ np.swapaxes(whole[:, :d, :d], 1, 2), 1e-8)


def test_integrals_of_couplings_are_corners_of_the_matrix_exponential(subtests):
    """int exp(M (dt - s)) C exp(A s) ds is the upper right block of the exponential of [[M, C], [0, A]] dt."""
    for dt in [0.05, 1.0, 4.0]:
        with subtests.test(dt=dt):
            rng = np.random.default_rng(1)
            M, A, C = rng.normal(size=(3, 4, 4)), rng.normal(size=(2, 6, 6)), rng.normal(size=(9, 4, 6))
            at, of = np.sort(rng.integers(0, 3, 9)), rng.integers(0, 2, 9)
            whole = expm(dt * np.block([[M[at], C], [np.zeros((9, 6, 4)), A[of]]]))
            near(coupling_integrals(M, at, C, A, of, dt, 12, 0.5), whole[:, :4, 4:], 1e-10)
