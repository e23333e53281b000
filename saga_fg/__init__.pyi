from .boxes import Boxes
from .dataset import Annotations, Dataset, Scene
from .errors import InputError, MissingExtraError, SagaError, UnknownNodeError
from .frame import Detection, Detections, Frame
from .node import ConstantAcceleration, ConstantVelocity, NodeType, RandomWalk
from .scene_graph import Edges, SceneGraph
from .sensor import Sensor
from .track import Track, Tracks
from .tracking import GreedyTracker, Tracker, TrackerSettings

__version__: str

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
