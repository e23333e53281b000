from .errors import InputError, MissingExtraError, SagaError, UnknownNodeError
from .model.motion import ConstantAcceleration, ConstantVelocity, Curvilinear, NodeType, RandomWalk
from .model.scene_graph import Edges, SceneGraph
from .model.sensor import Sensor
from .smoothing import smooth
from .tables.data_frames import frames_of
from .tracking import GreedyTracker, Tracker, TrackerSettings, track
from .types.boxes import Boxes
from .types.dataset import Annotations, Dataset, Scene
from .types.frame import Detection, Detections, Frame
from .types.track import PredictedTracks, Track, Tracks

__version__: str

__all__ = [
    "Annotations",
    "Boxes",
    "ConstantAcceleration",
    "ConstantVelocity",
    "Curvilinear",
    "Dataset",
    "Detection",
    "Detections",
    "Edges",
    "Frame",
    "GreedyTracker",
    "InputError",
    "MissingExtraError",
    "NodeType",
    "PredictedTracks",
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
    "frames_of",
    "smooth",
    "track",
]
