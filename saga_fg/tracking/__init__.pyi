from .clock import TimeVerdict
from .greedy import GreedyTracker
from .journal import Journal
from .names import AssociationName, EstimatorName
from .observer import Observer, Stage, TrackerView
from .settings import (
    AssociationSettings,
    ClassSettings,
    ClockSettings,
    EgoNodeSettings,
    ExistenceSettings,
    GreedySettings,
    StationaritySettings,
    TrackerSettings,
    TrafficFlowSettings,
)
from .tracker import Tracker

__all__ = [
    "AssociationName",
    "AssociationSettings",
    "ClassSettings",
    "ClockSettings",
    "EgoNodeSettings",
    "EstimatorName",
    "ExistenceSettings",
    "GreedySettings",
    "GreedyTracker",
    "Journal",
    "Observer",
    "Stage",
    "StationaritySettings",
    "TimeVerdict",
    "Tracker",
    "TrackerSettings",
    "TrackerView",
    "TrafficFlowSettings",
]
