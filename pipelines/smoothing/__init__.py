"""Offline labelling of recordings: the online pass, the passes of smoothing, the labels."""

from pipelines.smoothing.given_tracks import for_given_tracks
from pipelines.smoothing.labelling import SmoothedScene
from pipelines.smoothing.output import write_labels
from pipelines.smoothing.passes import SmoothConfig, load_smooth_config, smooth_known_objects
from pipelines.smoothing.streaming import (
    ChunkSettings,
    smooth_dataset,
    smooth_scene,
    smooth_stream,
)

__all__ = [
    "ChunkSettings",
    "SmoothConfig",
    "SmoothedScene",
    "for_given_tracks",
    "load_smooth_config",
    "smooth_dataset",
    "smooth_known_objects",
    "smooth_scene",
    "smooth_stream",
    "write_labels",
]
