"""Trajectories of a dataset to learn interactions from."""

from __future__ import annotations

from data_tools.datasets.source import DatasetSource
from pipelines.config import load_config
from pipelines.tracking import track_scene
from saga_fg.learning import Trajectories


def trajectories(source: DatasetSource, with_truth: bool) -> dict[str, Trajectories]:
    """Trajectories by recording: of the ground truth, or of the classical tracker on the detections.

    Raises `InputError` for what cannot be read.
    """
    if with_truth:
        with source.ground_truth() as dataset:
            return {name: Trajectories.of_truth(dataset.scene(name)) for name in dataset.scenes}
    with source.open() as dataset:
        config = load_config(source.family)
        runs = (track_scene(dataset.scene(name), config.new_tracker("kf")) for name in dataset.scenes)
        return {run.scene.name: Trajectories.of_tracks(run.tracks) for run in runs}
