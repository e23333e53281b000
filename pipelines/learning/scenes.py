"""Scenes of a dataset to learn interactions from: with ground truth and frames of detections."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from data_tools.datasets.annotated import detected
from data_tools.datasets.source import DatasetSource
from pipelines.config import TrackConfig
from pipelines.tracking import track_scene
from saga_fg.model.sensor import Sensor
from saga_fg.types.by_class import DEFAULT
from saga_fg.types.dataset import Annotations, Scene
from saga_fg.types.track import Tracks


def scenes_to_learn_from(source: DatasetSource, config: TrackConfig, with_truth: bool) -> dict[str, Scene]:
    """Scenes by name. With the truth, what is annotated and visible is detected, by the only sensor that the
    configuration has a model of. Without it, the tracks of the tracker without edges stand for the truth.

    Raises `InputError` for what cannot be read.
    """
    if with_truth:
        with source.ground_truth() as dataset:
            return {name: _detected(dataset.scene(name), config) for name in dataset.scenes}
    with source.open() as dataset:
        scenes = [dataset.scene(name) for name in dataset.scenes]
    return {scene.name: _with_tracks(scene, track_scene(scene, config.new_tracker("kf")).tracks) for scene in scenes}


def _detected(scene: Scene, config: TrackConfig) -> Scene:
    frames, named = detected(scene), [name for name in config.sensors if name != DEFAULT]
    if len(named) == 1 and config.sensors.get(DEFAULT, Sensor()) == Sensor():
        frames = [replace(frame, sensor=named[0]) for frame in frames]
    return replace(scene, frames=frames)


def _with_tracks(scene: Scene, tracks: Sequence[Tracks]) -> Scene:
    seen = [moment.select(moment.coasting == 0) for moment in tracks]
    truth = [Annotations(each.id.astype(np.str_), each.boxes, np.ones(len(each), dtype=np.bool_)) for each in seen]
    return replace(scene, ground_truth=truth)
