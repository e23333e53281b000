import data_tools.datasets.detection_file_source as _judged
import pipelines.report.page as _shown

from .errors import InputError, MissingExtraError, SagaError, UnknownNodeError
from .model.motion import ConstantAcceleration, ConstantVelocity, Curvilinear, NodeType, RandomWalk
from .model.scene_graph import Edges, SceneGraph
from .model.sensor import GroundCamera, Sensor
from .smoothing import smooth
from .tables.column_names import TableImport
from .tables.detections import frames_of
from .tracking import GreedyTracker, IdentityTracker, Tracker, TrackerSettings, predict, track
from .types.boxes import Boxes
from .types.dataset import Annotations, Dataset, Scene
from .types.frame import Detection, Detections, Frame
from .types.track import PredictedTracks, Track, Tracks

__version__: str
evaluate = _judged.evaluate
view = _shown.view

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
    "GroundCamera",
    "IdentityTracker",
    "InputError",
    "MissingExtraError",
    "NodeType",
    "PredictedTracks",
    "RandomWalk",
    "SagaError",
    "Scene",
    "SceneGraph",
    "Sensor",
    "TableImport",
    "Track",
    "Tracker",
    "TrackerSettings",
    "Tracks",
    "UnknownNodeError",
    "evaluate",
    "frames_of",
    "predict",
    "smooth",
    "track",
    "view",
]
