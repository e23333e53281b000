r"""Prediction of hidden objects through a gap, and the likelihood of their positions.

Inside a gap an object moves by its own velocity and by its edges to the neighbours, which stay in view. All shipped
interactions act on the velocity alone, so that over a step with rates frozen at its start

    dp/dt = v,    dv/dt = D v + c + w,    E[w w^T] = q exp(-explained_noise K) I delta

with, for each edge j -> i at rate r (K is the sum of all r), u the unit heading and m the normal of a heading,

    shared velocity   D -= r I              c += r R_ij v_j
    car-following     D -= r u_i u_i^T      c += r u_i (u_j . v_j)          time constant infinite: speeds alone
    shared course     D -= r m_j m_j^T

D is negative semidefinite, and the implicit midpoint rule, E = (I - D h/2)^{-1} (I + D h/2), keeps every step stable.
The neighbours' states are taken as known: this is the innovation likelihood of the joint filter up to the correlation
of an object with its neighbours, at a cost that does not grow with their number. As innovations have heavy tails, they
are modelled as Student's t with covariance scale S = H P H^T + R; `xp` is NumPy or JAX.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from saga_fg.errors import InputError
from saga_fg.learning.gaps import GapSample
from saga_fg.model.edge_features import EdgeEnds, EdgeFeatures, edge_features
from saga_fg.model.interactions import CarFollowing, Interaction, SharedCourse, SharedVelocity
from saga_fg.numerics.arrays import FloatArray

TAILS = 3.0  # degrees of freedom of the innovations
SUBSTEPS = 2  # of a step: neighbours move on, edges are made anew
TURNS_ABOVE = 1.0  # m/s: the heading of what is faster turns with its velocity


class Coupling(NamedTuple):
    """Edges of one interaction from the M neighbours of W objects: rate (W, M), 1/s."""

    interaction: Interaction
    rate: Any


Couple = Callable[[EdgeFeatures, Any], Sequence[Coupling]]
"""Rates from features (W, M) and whether each neighbour is seen (W, M)."""


class GapPrediction(NamedTuple):
    """At the end of S steps: position (W, S, 2) and its covariance scale (W, S, 2, 2)."""

    position: Any
    S: Any


def predict_gaps(
    sample: GapSample,
    couple: Couple,
    acceleration_noise: Any,
    explained_noise: Any,
    xp: Any = np,
) -> GapPrediction:
    """Coast through all gaps; acceleration_noise q, m^2/s^3, a number or (W,).

    Raises `InputError` for interactions other than those above.
    """
    p, v, heading = sample.mean[:, :2], sample.mean[:, 2:], sample.heading
    P_pp, P_pv, P_vv = sample.P[:, :2, :2], sample.P[:, :2, 2:], sample.P[:, 2:, 2:]
    eye = xp.eye(2)
    positions, covariances = [], []
    for step in range(sample.dt.shape[1]):
        h = (sample.dt[:, step] / SUBSTEPS)[:, None, None]
        other, seen = sample.other_mean[:, step], sample.other_seen[:, step]
        for k in range(SUBSTEPS):
            moved = other[..., :2] + other[..., 2:] * (k * h)
            source = EdgeEnds(moved, other[..., 2:], sample.other_heading[:, step], sample.other_moved[:, step])
            target = EdgeEnds(p[:, None], v[:, None], heading[:, None], sample.has_moved[:, None])
            couplings = couple(edge_features(target, source, xp), seen)
            D, c, K = _dynamics(couplings, target, source, xp)
            E = _implicit_midpoint(D, h, eye, xp)
            v_new = _apply(E, v) + _apply((eye + E) / 2, c) * h[..., 0]
            p = p + h[..., 0] / 2 * (v + v_new)
            B = h / 2 * (eye + E)
            q = (acceleration_noise * xp.exp(-explained_noise * K))[:, None, None] * eye
            P_pp = P_pp + B @ _t(P_pv) + P_pv @ _t(B) + B @ P_vv @ _t(B) + h**3 / 3 * q
            P_pv = P_pv @ _t(E) + B @ P_vv @ _t(E) + h**2 / 2 * q
            P_vv = E @ P_vv @ _t(E) + h * q
            turned = xp.arctan2(v[:, 0] * v_new[:, 1] - v[:, 1] * v_new[:, 0], (v * v_new).sum(axis=-1) + 1e-9)
            fast = (sample.has_moved > 0) & ((v**2).sum(axis=-1) > TURNS_ABOVE**2)
            heading, v = heading + xp.where(fast, turned, 0.0), v_new
        positions.append(p)
        covariances.append(P_pp)
    return GapPrediction(xp.stack(positions, axis=1), xp.stack(covariances, axis=1))


def gap_errors(sample: GapSample, prediction: GapPrediction) -> Any:
    """Position errors (W, S), m, of a prediction; NaN where the true position is unknown."""
    return np.hypot(*np.moveaxis(sample.measured - prediction.position, -1, 0))


def errors_alone(sample: GapSample) -> FloatArray:
    """Errors (W, S), m, of the independent filter: objects keep the velocity they had when the gap began."""
    return np.asarray(gap_errors(sample, predict_gaps(sample, lambda _features, _seen: [], 0.0, 0.0)))


def negative_log_likelihood(sample: GapSample, prediction: GapPrediction, position_noise: Any, xp: Any = np) -> Any:
    """Mean over all known places at the ends of all steps, without constants."""
    known = np.isfinite(sample.measured[..., 0]) & (sample.dt > 0)
    e = xp.where(known[..., None], sample.measured - prediction.position, 0.0)
    S = prediction.S + position_noise**2 * xp.eye(2)
    det = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] * S[..., 1, 0]
    square = (S[..., 1, 1] * e[..., 0] ** 2 + S[..., 0, 0] * e[..., 1] ** 2) - 2 * S[..., 0, 1] * e[..., 0] * e[..., 1]
    loss = 0.5 * xp.log(det) + (TAILS + 2) / 2 * xp.log1p(square / det / TAILS)
    return xp.where(known, loss, 0.0).sum() / max(int(known.sum()), 1)


def _dynamics(couplings: Sequence[Coupling], target: EdgeEnds, source: EdgeEnds, xp: Any) -> tuple[Any, Any, Any]:
    """D (W, 2, 2), c (W, 2) and K (W,) of all edges."""
    W = target.position.shape[0]
    D, c, K = xp.zeros((W, 2, 2)), xp.zeros((W, 2)), xp.zeros(W)
    u_i, u_j = _unit(target.heading, xp), _unit(source.heading, xp)
    for interaction, rate in couplings:
        total = rate.sum(axis=-1)
        match interaction:
            case SharedVelocity(along_heading=along_heading):
                v_j = (
                    _turned(source.velocity, target.heading - source.heading, xp) if along_heading else source.velocity
                )
                D = D - total[:, None, None] * xp.eye(2)
                c = c + (rate[..., None] * v_j).sum(axis=1)
            case CarFollowing(time_constant=math.inf):
                D = D - total[:, None, None] * (u_i[:, 0, :, None] * u_i[:, 0, None, :])
                c = c + u_i[:, 0] * (rate * (u_j * source.velocity).sum(axis=-1)).sum(axis=-1)[:, None]
            case SharedCourse():
                m_j = xp.stack([-u_j[..., 1], u_j[..., 0]], axis=-1)
                D = D - (rate[..., None, None] * m_j[..., :, None] * m_j[..., None, :]).sum(axis=1)
            case _:
                raise InputError(
                    "interaction: expected shared velocity, shared course, or car-following with time constant .inf, "
                    f"got {interaction}"
                )
        K = K + total
    return D, c, K


def _implicit_midpoint(D: Any, h: Any, eye: Any, xp: Any) -> Any:
    """(I - D h/2)^{-1} (I + D h/2) for matrices (W, 2, 2)."""
    A = eye - D * h / 2
    det = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]
    rows = [[A[:, 1, 1], -A[:, 0, 1]], [-A[:, 1, 0], A[:, 0, 0]]]
    inverse = xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2) / det[:, None, None]
    return inverse @ (eye + D * h / 2)


def _apply(A: Any, x: Any) -> Any:
    return (A @ x[..., None])[..., 0]


def _t(A: Any) -> Any:
    return A.swapaxes(-1, -2)


def _unit(heading: Any, xp: Any) -> Any:
    return xp.stack([xp.cos(heading), xp.sin(heading)], axis=-1)


def _turned(v: Any, angle: Any, xp: Any) -> Any:
    c, s = xp.cos(angle), xp.sin(angle)
    return xp.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], axis=-1)
