"""Offline labelling of recordings: the online pass, the passes of smoothing, the labels."""

from pipelines.smoothing.output import SmoothedScene, smooth_dataset, smooth_scene, write_labels, write_streamed_labels
from pipelines.smoothing.passes import SmoothConfig, load_smooth_config, smooth_known_objects
from pipelines.smoothing.streaming import ChunkSettings, StreamedScene, smooth_stream

__all__ = [
    "ChunkSettings",
    "SmoothConfig",
    "SmoothedScene",
    "StreamedScene",
    "load_smooth_config",
    "smooth_dataset",
    "smooth_known_objects",
    "smooth_scene",
    "smooth_stream",
    "write_labels",
    "write_streamed_labels",
]
