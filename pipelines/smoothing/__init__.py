"""From recordings to labels: the online pass, the rounds of smoothing, the boxes."""

from pipelines.smoothing.config import SmoothConfig, load_smooth_config
from pipelines.smoothing.scene import SmoothedScene, smooth_scene

__all__ = ["SmoothConfig", "SmoothedScene", "load_smooth_config", "smooth_scene"]
