"""saga-fg: factor-graph filters and smoothers for many interacting objects."""

from saga_fg.boxes import Boxes
from saga_fg.dataset import Annotations, Dataset, Scene
from saga_fg.errors import InputError, MissingExtraError, SagaError, UnknownNodeError
from saga_fg.frame import Detection, Detections, Frame
from saga_fg.track import Track, Tracks

__all__ = [
    "Annotations",
    "Boxes",
    "Dataset",
    "Detection",
    "Detections",
    "Frame",
    "InputError",
    "MissingExtraError",
    "SagaError",
    "Scene",
    "Track",
    "Tracks",
    "UnknownNodeError",
]
