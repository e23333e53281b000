"""Interactions for every scene of a set of recordings, learned from the truth of others of them."""

from __future__ import annotations

from pipelines.learning import learn_interactions
from pipelines.tracking import Progress
from saga_fg.errors import InputError
from saga_fg.learning import Trajectories
from saga_fg.model.learned_interactions import LearnedInteractions
from saga_fg.types.dataset import Dataset

FOLDS = 2


def learn_by_folds(dataset: Dataset, progress: Progress | None = None) -> dict[str, LearnedInteractions]:
    """By scene: every other one taught the rest, and the other way round. Raises `InputError` for a single scene."""
    if len(dataset.scenes) < FOLDS:
        raise InputError(f"{', '.join(dataset.scenes)}: expected scenes to learn from beside it")
    trajectories = {name: Trajectories.of_truth(dataset.scene(name)) for name in dataset.scenes}
    learned: dict[str, LearnedInteractions] = {}
    for fold in range(FOLDS):
        tested = dataset.scenes[fold::FOLDS]
        others = {name: found for name, found in trajectories.items() if name not in tested}
        found = learn_interactions(others, f"scenes {', '.join(others)}", progress=progress)
        learned |= dict.fromkeys(tested, found)
    return learned
