from .clock import TimeVerdict
from .clock_offsets import SensorTime
from .greedy import GreedySettings, GreedyTracker
from .identity_tracking import IdentityTracker
from .journal import Journal, Observer, Stage, TrackerView
from .settings import (
    AssociationName,
    AssociationSettings,
    ClassSettings,
    EgoNodeSettings,
    ExistenceSettings,
    TrackerSettings,
)
from .table_tracking import track
from .tracker import Tracker
from .traffic import SpeedPriorSettings, TrafficSettings

__all__ = [
    "AssociationName",
    "AssociationSettings",
    "ClassSettings",
    "EgoNodeSettings",
    "ExistenceSettings",
    "GreedySettings",
    "GreedyTracker",
    "IdentityTracker",
    "Journal",
    "Observer",
    "SensorTime",
    "SpeedPriorSettings",
    "Stage",
    "TimeVerdict",
    "Tracker",
    "TrackerSettings",
    "TrackerView",
    "TrafficSettings",
    "track",
]
