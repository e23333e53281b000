r"""The score of an object from all its evidence.

    score = sum_k p_k / (looks + prior)

p_k the probabilities of its detections, looks the frames that had it in view during its life: the posterior mean of the
share of looks that show it, with the detector's probabilities in place of yes and no, from a Beta prior that counts as
`prior` looks without a detection. A lone detection scores low, however probable, and a long track is worth its mean.
"""

from __future__ import annotations

import numpy as np

from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.smoothing.evidence import Evidence
from saga_fg.smoothing.states import Lives, StateTable


def evidence_scores(
    evidence: Evidence, object_of: IntArray, lives: Lives, states: StateTable, prior_opportunity_time: float
) -> FloatArray:
    """(n,) scores in [0, 1). prior_opportunity_time: of the prior's opportunities, s."""
    rows = np.flatnonzero(object_of >= 0)
    owner = lives.rows_of(object_of[rows])
    total = np.bincount(owner, evidence.probability[rows], minlength=len(lives))
    seen = np.bincount(owner, minlength=len(lives))
    looks = np.maximum(looks_in_view(evidence, lives, states), seen)
    return np.asarray(total / (looks + prior_opportunity_time * look_rate(evidence)))


def looks_in_view(evidence: Evidence, lives: Lives, states: StateTable) -> IntArray:
    """(n,) how many frames had each object in their field of view."""
    count = np.zeros(len(lives), dtype=np.int64)
    for look in evidence.looks:
        rows = states.at(look.moment)
        position = states.mean[rows, :2] + evidence.origin
        count[lives.rows_of(states.id[rows])] += look.sensor.sees(position, look.world_T_ego)
    return count


def look_rate(evidence: Evidence) -> float:
    """Frames per second, of all sensors."""
    moments = [look.moment for look in evidence.looks]
    if len(set(moments)) < 2:
        return 1.0
    return (len(moments) - 1) / float(evidence.times[moments[-1]] - evidence.times[moments[0]])
