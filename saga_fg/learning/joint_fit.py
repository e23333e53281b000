"""Rates, kernel widths and process noise of edge rules by the likelihood of objects in view.

The likelihood is that of the joint filter (`joint_gaps`), with all correlations between the objects: of every position,
given all before. Neither unknown velocities nor neighbours that react bias it, as they do that of places where objects
reappear (`interaction_fit`). But it is Gaussian, costs a run of the filter for each trial, and weighs the next
moment, not the next seconds. The parameters are those of `interaction_fit`, with independent normal priors about the
template, of standard deviation one in their logarithms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import minimize

from saga_fg.arrays import FloatArray
from saga_fg.by_class import DEFAULT
from saga_fg.errors import InputError
from saga_fg.learning.independent_filter import filter_independently
from saga_fg.learning.interaction_fit import EXPLAINED_BOUNDS, NOISE_BOUNDS, FittedInteractions
from saga_fg.learning.joint_gaps import JointGaps
from saga_fg.learning.rule_parameters import Rule, RuleParameters
from saga_fg.learning.trajectories import Trajectories


def fit_interactions_in_view(
    recordings: Sequence[Trajectories],
    position_noise: float,
    acceleration_noise: Mapping[str, float],
    template: Sequence[Rule],
    iterations: int = 15,
) -> FittedInteractions:
    """The most likely values of the template's rules, from how objects in view move.

    position_noise      standard deviation of the positions, m
    acceleration_noise  by class, with `default`: where the search begins; each entry is a parameter

    Raises `InputError` for recordings in which no object is seen twice.
    """
    parameters = RuleParameters.of(template)
    classes, m = list(acceleration_noise), len(parameters.start)
    bounds = [*parameters.bounds, *[tuple(np.log(NOISE_BOUNDS))] * len(classes), EXPLAINED_BOUNDS]
    noise = np.log([acceleration_noise[c] for c in classes])
    start = np.clip(np.concatenate([parameters.start, noise, [0.0]]), *np.array(bounds).T)
    filtered = []
    for trajectories in recordings:
        of_class = [acceleration_noise.get(c, acceleration_noise[DEFAULT]) for c in trajectories.label.tolist()]
        filtered.append(filter_independently(trajectories, np.array(of_class), position_noise))

    def loss(x: FloatArray) -> float:
        q = dict(zip(classes, np.exp(x[m:-1]).tolist(), strict=True))
        rules, total, count = parameters.valued(x[:m]), 0.0, 0
        for trajectories, alone in zip(recordings, filtered, strict=True):
            log, positions = JointGaps(trajectories, alone, q, position_noise, rules, float(x[-1])).log_likelihood()
            total, count = total + log, count + positions
        if count == 0:
            raise InputError("recordings: expected objects that are seen twice")
        return (0.5 * float(((x[:m] - start[:m]) ** 2).sum()) - total) / count

    found = minimize(loss, start, method="L-BFGS-B", bounds=bounds, options={"maxiter": iterations, "eps": 1e-3})
    q = np.exp(found.x[m:-1]).tolist()
    return FittedInteractions(
        tuple(parameters.valued(found.x[:m])), dict(zip(classes, q, strict=True)), float(found.x[-1]), float(found.fun)
    )
