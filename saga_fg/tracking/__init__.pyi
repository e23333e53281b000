from .clock import ClockSettings, TimeVerdict
from .clock_offsets import SensorTime
from .greedy import GreedySettings, GreedyTracker
from .journal import Journal, Observer, Stage, TrackerView
from .names import AssociationName
from .settings import (
    AssociationSettings,
    ClassSettings,
    EgoNodeSettings,
    ExistenceSettings,
    TrackerSettings,
)
from .table_tracking import track
from .track_filters import StationaritySettings
from .tracker import Tracker
from .traffic import SpeedPriorSettings, TrafficSettings

__all__ = [
    "AssociationName",
    "AssociationSettings",
    "ClassSettings",
    "ClockSettings",
    "EgoNodeSettings",
    "ExistenceSettings",
    "GreedySettings",
    "GreedyTracker",
    "Journal",
    "Observer",
    "SensorTime",
    "SpeedPriorSettings",
    "Stage",
    "StationaritySettings",
    "TimeVerdict",
    "Tracker",
    "TrackerSettings",
    "TrackerView",
    "TrafficSettings",
    "track",
]
