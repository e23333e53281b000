"""Interactions from recordings: the noise of the classical filter first, then what neighbours say beyond it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pipelines.tracking import Progress
from saga_fg.errors import InputError
from saga_fg.learning import (
    FORMS_OF_TRACKERS,
    FilterNoise,
    FilterNoiseLikelihood,
    GapSettings,
    Trajectories,
    fit_by_held_out,
    fit_interactions,
    fit_networks,
)
from saga_fg.model.learned_interactions import LearnedInteractions


def learn_interactions(
    recordings: Mapping[str, Trajectories], origin: str, network: bool = False, progress: Progress | None = None
) -> LearnedInteractions:
    """Learn from recordings of one kind, for a tracker; `origin` says in the file where from.

    network: train networks (extra [learn]) in place of fitting kernels. Raises `InputError` where no object is followed
    for long enough.
    """
    settings = GapSettings()
    classes = tuple(sorted({str(c) for t in recordings.values() for c in np.unique(t.label)}))
    likelihoods = []
    for done, (name, trajectories) in enumerate(recordings.items()):
        likelihoods.append(FilterNoiseLikelihood(trajectories, classes, settings))
        if progress is not None:
            progress(f"classical filter {name}", done + 1, len(recordings))
    if not any(n for of in likelihoods for n in of.count.values()):
        raise InputError(f"{origin}: expected objects that are followed for {settings.followed:g} s and more")
    classical = FilterNoise.most_likely(likelihoods)
    fit = fit_networks if network else fit_interactions
    fitted = fit_by_held_out(list(recordings.values()), classes, classical, fit, settings, FORMS_OF_TRACKERS)
    return LearnedInteractions(
        learned_from=origin,
        edges=fitted.rules,
        explained_noise=fitted.explained_noise,
        acceleration_noise=fitted.acceleration_noise,
    )
