"""From recordings to labels: the online pass, the rounds of smoothing, the boxes."""

from pipelines.smoothing.config import SmoothConfig, load_smooth_config
from pipelines.smoothing.output import write_labels, write_streamed_labels
from pipelines.smoothing.rounds import smooth_known_objects
from pipelines.smoothing.scene import SmoothedScene, smooth_dataset, smooth_scene
from pipelines.smoothing.streamed import StreamedScene, smooth_stream
from pipelines.smoothing.stretches import StretchSettings

__all__ = [
    "SmoothConfig",
    "SmoothedScene",
    "StreamedScene",
    "StretchSettings",
    "load_smooth_config",
    "smooth_dataset",
    "smooth_known_objects",
    "smooth_scene",
    "smooth_stream",
    "write_labels",
    "write_streamed_labels",
]
