"""What loops say against dead reckoning, as a sparse linear system over the anchors.

d_j, the error of the anchor j in its own frame (d_0 = 0), takes the place of the errors of odometry's steps,

    e_j = d_(j+1) - A_j d_j,  A_j = Ad(T_(j+1)^-1 T_j)        r_k = m_k + d_b - B_k d_a,  B_k = Ad(T_b^-1 T_a)

so that steps and loops are edges of one graph, H = sum G^T W G over both. With e = r = the residuals at its solution

    m^T C^-1 m  = sum e^T Q^-1 e + sum r^T R^-1 r         log |C| = log |H| + log |Q| + log |R|

where C = J Q J^T + R is the covariance of all loops by odometry, which is dense wherever cycles overlap. H is factored
by sparse LU without pivoting.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import splu

from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray

_AT_ONCE = 64  # loops predicted


@dataclass(frozen=True, eq=False)
class Misfits:
    """M loops between S + 1 anchors, linearised.

    m       (M, 6) deviations of loops from dead reckoning; ends (M, 2) their anchors
    turned  (M, 6, 6) B of each loop; moved (S, 6, 6) A of each step
    parts   (S, 3, 6, 6) covariance of each step by rotations, by translations, and by both together
    R       (M, 6, 6) covariance of each loop
    """

    m: FloatArray
    ends: IntArray
    turned: FloatArray
    moved: FloatArray
    parts: FloatArray
    R: FloatArray

    def loops(self, kept: BoolArray) -> tuple[csc_array, FloatArray, float]:
        """What kept loops add to H, its right side (S, 6), and log |R|; the same for every inflation."""
        W = np.asarray(np.linalg.inv(self.R[kept]))
        H = _assembled(len(self.moved), self.ends[kept], self.turned[kept], W)
        side = np.zeros((len(self.moved) + 1, 6))
        weighted = np.einsum("kij,kj->ki", W, self.m[kept])
        np.add.at(side, self.ends[kept, 1], -weighted)
        np.add.at(side, self.ends[kept, 0], np.einsum("kij,ki->kj", self.turned[kept], weighted))
        return H, side[1:], float(np.linalg.slogdet(self.R[kept])[1].sum())

    def solved(self, kept: BoolArray, inflation: FloatArray, loops: tuple[csc_array, FloatArray, float]) -> Solution:
        """The errors of anchors by kept loops, of which `loops` says what they add, with inflated odometry."""
        Q = np.einsum("g,sgij->sij", _scales(inflation), self.parts)
        inverse = np.linalg.inv(Q)
        steps = len(self.moved)
        chain = np.column_stack([np.arange(steps), np.arange(1, steps + 1)])
        H = _assembled(steps, chain, self.moved, inverse) + loops[0]
        factor = splu(H.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        d = np.concatenate([np.zeros((1, 6)), factor.solve(loops[1].ravel()).reshape(-1, 6)])
        e = d[1:] - np.einsum("sij,sj->si", self.moved, d[:-1])
        r = self.m + d[self.ends[:, 1]] - np.einsum("kij,kj->ki", self.turned, d[self.ends[:, 0]])
        squares = np.einsum("si,sij,sj->", e, inverse, e)
        squares += (r[kept] * np.linalg.solve(self.R[kept], r[kept][..., None])[..., 0]).sum()
        volume = np.log(np.abs(factor.U.diagonal())).sum() + np.linalg.slogdet(Q)[1].sum() + loops[2]
        return Solution(self, factor, e, r, float(squares + volume))


@dataclass(frozen=True, eq=False)
class Solution:
    """errors (S, 6) of odometry's steps and residuals (M, 6) of all loops; cost: m^T C^-1 m + log |C| of those kept."""

    misfits: Misfits
    factor: Any
    errors: FloatArray
    residuals: FloatArray
    cost: float

    def predicted(self, rows: IntArray) -> FloatArray:
        """The covariances (n, 6, 6) with which the solution predicts some loops."""
        given = self.misfits
        P, size = np.empty((len(rows), 6, 6)), 6 * len(given.moved)
        for part in range(0, len(rows), _AT_ONCE):
            at = rows[part : part + _AT_ONCE]
            side = np.zeros((len(given.moved) + 1, 6, len(at), 6))
            each = np.arange(len(at))
            side[given.ends[at, 1], :, each] = np.eye(6)
            side[given.ends[at, 0], :, each] = -given.turned[at].swapaxes(1, 2)
            x = self.factor.solve(side[1:].reshape(size, -1)).reshape(-1, 6, len(at), 6)
            x = np.concatenate([np.zeros((1, *x.shape[1:])), x])
            P[part : part + _AT_ONCE] = x[given.ends[at, 1], :, each] - given.turned[at] @ x[given.ends[at, 0], :, each]
        return (P + P.swapaxes(1, 2)) / 2

    def left_out(self, rows: IntArray, kept: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Deviations v (n, 6) and covariances V (n, 6, 6) of some loops by the kept ones without them."""
        P, R, v = self.predicted(rows), self.misfits.R[rows], self.residuals[rows]
        V, inside = P + R, kept[rows]
        if inside.any():
            inverse = np.linalg.inv(R[inside])
            V[inside] = np.linalg.inv(inverse - inverse @ P[inside] @ inverse)
            v = v.copy()
            v[inside] = np.einsum("kij,kjl,kl->ki", V[inside], inverse, v[inside])
        return v, V


def _assembled(steps: int, ends: IntArray, turned: FloatArray, W: FloatArray) -> csc_array:
    """The sum of G^T W G (6S, 6S) over edges (n, 2), whose residuals are d_b - turned d_a; d_0 is fixed."""
    across = -W @ turned
    blocks = np.stack([W, across, across.swapaxes(1, 2), -turned.swapaxes(1, 2) @ across], axis=1)
    block = ends[:, [1, 1, 0, 0]] - 1, ends[:, [1, 0, 1, 0]] - 1
    free = (block[0] >= 0) & (block[1] >= 0)
    row, column = (6 * at[free][:, None, None] for at in block)
    row, column = np.broadcast_arrays(row + np.arange(6)[:, None], column + np.arange(6))
    entries = blocks[free].ravel(), (row.ravel(), column.ravel())
    return coo_array(entries, shape=(6 * steps, 6 * steps)).tocsc()


def _scales(inflation: FloatArray) -> FloatArray:
    a, b = inflation
    return np.array([a**2, b**2, a * b])
