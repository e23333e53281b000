"""saga-fg: factor-graph filters and smoothers for many interacting objects."""

from importlib.metadata import version

from saga_fg.boxes import Boxes
from saga_fg.dataset import Annotations, Dataset, Scene
from saga_fg.errors import InputError, MissingExtraError, SagaError, UnknownNodeError
from saga_fg.frame import Detection, Detections, Frame
from saga_fg.node import ConstantAcceleration, ConstantVelocity, NodeType, RandomWalk
from saga_fg.scene_graph import Edges, SceneGraph
from saga_fg.sensor import Sensor
from saga_fg.track import Track, Tracks
from saga_fg.tracking import GreedyTracker, Tracker, TrackerSettings

__version__ = version("saga-fg")

__all__ = [
    "Annotations",
    "Boxes",
    "ConstantAcceleration",
    "ConstantVelocity",
    "Dataset",
    "Detection",
    "Detections",
    "Edges",
    "Frame",
    "GreedyTracker",
    "InputError",
    "MissingExtraError",
    "NodeType",
    "RandomWalk",
    "SagaError",
    "Scene",
    "SceneGraph",
    "Sensor",
    "Track",
    "Tracker",
    "TrackerSettings",
    "Tracks",
    "UnknownNodeError",
]
