"""Contenders whose noise and edges are fitted to recordings that are not judged."""

from __future__ import annotations

from collections.abc import Sequence

from pipelines.bench.gaps.bench import Contender
from pipelines.config import TrackConfig
from pipelines.learning import learn_interactions
from pipelines.tracking import Progress
from saga_fg.learning import Trajectories, fit_acceleration_noise_by_class, measured_trajectories
from saga_fg.types.dataset import Dataset


def fitted_contenders(
    dataset: Dataset, recordings: Sequence[str], base: TrackConfig, progress: Progress | None = None
) -> list[Contender]:
    """kf with the process noise, and saga with the edges, learned from some annotated recordings.

    Raises `InputError` where there is nothing to learn from.
    """
    scenes = [dataset.scene(name) for name in recordings]
    noise = fit_acceleration_noise_by_class(measured_trajectories(iter(scenes), base.sensors))
    truths = {scene.name: Trajectories.of_truth(scene) for scene in scenes}
    learned = learn_interactions(truths, f"recordings {', '.join(recordings)}", progress=progress)
    return [
        Contender("kf, fitted noise", "kf", base.with_acceleration_noise(noise)),
        Contender("saga, learned edges", "saga", base.with_interactions(learned)),
    ]
