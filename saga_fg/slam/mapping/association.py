"""Association of observations with landmarks: gates, mutual exclusion, joint compatibility.

    d^2 = r^T S^-1 r,      S = A P A^T + R      (innovation of one observation against one landmark)

A pair is possible inside the gate, and where it is likelier than an observation of a landmark not yet in the map, of
which `density` are expected per unit of volume:

    d^2 + log det(2 pi S)  <  -2 log density

so that neighbours are not confused while the pose is poorly known: the observation then initiates a new landmark, which
is merged later. The likeliest assignment among the possible pairs is chosen, each landmark once. Then all pairs are
tested together, with the correlations that their common pose causes: while the joint d^2 is outside the gate of its
dimension, the pair whose removal lowers it most is removed (after J. Neira and J. D. Tardos, "Data association in
stochastic mapping using the joint compatibility test", IEEE Transactions on Robotics and Automation 17, 2001, who
search all combinations).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.numerics.assignment import assign, gate
from saga_fg.slam.mapping.local_map import Innovation, LocalMap
from saga_fg.types.landmark import Observation

_GATE = 0.999  # gate probability of association; higher: fewer duplicates, more wrong matches


def associate(
    local: LocalMap,
    observations: Sequence[Observation],
    near: Callable[[int, int], bool] = lambda row, landmark: True,
) -> dict[int, Innovation]:
    """Assign the observations made from the present pose to the landmarks.

    near: whether the observation of a row may be of a landmark besides.
    Returns the innovation of each matched observation, by its row.
    """
    landmarks = sorted(local.kinds)
    column = {landmark: j for j, landmark in enumerate(landmarks)}
    gain = np.zeros((len(observations), len(landmarks)))
    candidates: dict[tuple[int, int], Innovation] = {}
    for kind in dict.fromkeys(observation.kind for observation in observations):
        alike = [number for number in landmarks if local.kinds[number] == kind]
        own = [row for row, observation in enumerate(observations) if observation.kind == kind]
        if not alike:
            continue
        innovations = local.innovations([observations[row] for row in own], alike)
        squared, spread = local.squared_distances(innovations)
        dim = kind.variable.dim
        noise = np.linalg.slogdet(np.stack([observations[row].covariance for row in own]))[1]
        won = log_odds(squared, spread + np.repeat(noise, len(alike)), dim, kind.density)
        for k in np.flatnonzero((squared < gate(_GATE, dim)) & (won > 0)).tolist():
            row, landmark = own[k // len(alike)], innovations.landmarks[k]
            if near(row, landmark):
                candidates[row, column[landmark]] = innovations[k]
                gain[row, column[landmark]] = won[k]
    rows, columns = assign(-gain, gain > 0, 0.0)
    pairs = {int(i): candidates[int(i), int(j)] for i, j in zip(rows, columns, strict=True)}
    return _compatible(local, pairs)


def log_odds(squared: FloatArray, log_det: FloatArray, dim: int, density: float) -> FloatArray:
    """Twice the log odds of one landmark against two different ones; squared: d^2, log_det: of S (dim, dim)."""
    return np.asarray(-2 * np.log(density) - squared - log_det - dim * np.log(2 * np.pi))


def _compatible(local: LocalMap, pairs: dict[int, Innovation]) -> dict[int, Innovation]:
    """The pairs without those that contradict the others."""
    while len(pairs) > 1:
        rows = list(pairs)
        innovations = list(pairs.values())
        S = local.innovation_covariance(innovations)
        r = np.concatenate([i.r for i in innovations])
        if _squared(r, S) < gate(_GATE, len(r)):
            break
        owner = np.repeat(np.arange(len(rows)), [len(i.r) for i in innovations])
        left = [_without(r, S, owner, row) for row in range(len(rows))]
        pairs = {row: pairs[row] for row in rows if row != rows[int(np.argmin(left))]}
    return pairs


def _without(r: FloatArray, S: FloatArray, owner: IntArray, row: int) -> float:
    keep = owner != row
    return _squared(r[keep], S[np.ix_(keep, keep)])


def _squared(r: FloatArray, S: FloatArray) -> float:
    return float(r @ np.linalg.solve(S, r))
