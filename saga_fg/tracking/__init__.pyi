from .by_name import estimator_parameters
from .class_belief import ConfusedClasses
from .clock import TimeVerdict
from .clock_offsets import SensorTime
from .greedy import GreedySettings, GreedyTracker
from .joint_state import JointTrackState
from .journal import Event, Journal, Observer, Stage, TrackerView, of_scene
from .map_nodes import motion_of
from .measurements import frame_measurements
from .prediction import predict_state
from .sensor_noise import scaled_sensors
from .settings import (
    AssociationCost,
    AssociationName,
    AssociationProblem,
    AssociationSettings,
    ClassSettings,
    EgoNodeSettings,
    ExistenceSettings,
    Method,
    TrackerSettings,
    TypicalSize,
)
from .table_tracking import (
    NO_TRACKS,
    IdentityTracker,
    SettingsName,
    dense_traffic_settings,
    plain_settings,
    predict,
    read_scenes,
    track,
)
from .track_filters import MOVING, Kinematics, TurnRate
from .track_table import SensorEvidence, TrackTable
from .tracker import Tracker
from .tracker_state import TrackerState
from .traffic import Passages, SpeedPriorSettings, Traffic, TrafficSettings
from .update import visible_share

__all__ = [
    "MOVING",
    "NO_TRACKS",
    "AssociationCost",
    "AssociationName",
    "AssociationProblem",
    "AssociationSettings",
    "ClassSettings",
    "ConfusedClasses",
    "EgoNodeSettings",
    "Event",
    "ExistenceSettings",
    "GreedySettings",
    "GreedyTracker",
    "IdentityTracker",
    "JointTrackState",
    "Journal",
    "Kinematics",
    "Method",
    "Observer",
    "Passages",
    "SensorEvidence",
    "SensorTime",
    "SettingsName",
    "SpeedPriorSettings",
    "Stage",
    "TimeVerdict",
    "TrackTable",
    "Tracker",
    "TrackerSettings",
    "TrackerState",
    "TrackerView",
    "Traffic",
    "TrafficSettings",
    "TurnRate",
    "TypicalSize",
    "dense_traffic_settings",
    "estimator_parameters",
    "frame_measurements",
    "motion_of",
    "of_scene",
    "plain_settings",
    "predict",
    "predict_state",
    "read_scenes",
    "scaled_sensors",
    "track",
    "visible_share",
]
