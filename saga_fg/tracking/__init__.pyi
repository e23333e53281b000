from .clock import ClockSettings, TimeVerdict
from .clock_offsets import SensorTime
from .greedy import GreedySettings, GreedyTracker
from .journal import Journal
from .names import AssociationName
from .observer import Observer, Stage, TrackerView
from .settings import (
    AssociationSettings,
    ClassSettings,
    EgoNodeSettings,
    ExistenceSettings,
    TrackerSettings,
)
from .stationarity import StationaritySettings
from .table_tracking import track
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
