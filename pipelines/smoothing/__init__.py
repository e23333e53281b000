"""Labels of recordings: read, labelled by `saga_fg.smoothing`, written."""

from pipelines.smoothing.configuration import SmoothConfig, for_given_tracks, load_smooth_config
from pipelines.smoothing.output import write_labels
from pipelines.smoothing.streaming import SmoothedScene, label_model, smooth_dataset, smooth_scene, smooth_stream

__all__ = [
    "SmoothConfig",
    "SmoothedScene",
    "for_given_tracks",
    "label_model",
    "load_smooth_config",
    "smooth_dataset",
    "smooth_scene",
    "smooth_stream",
    "write_labels",
]
