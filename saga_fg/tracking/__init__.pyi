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
    FlowSettings,
    GreedySettings,
    StandingSettings,
    TrackerSettings,
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
    "FlowSettings",
    "GreedySettings",
    "GreedyTracker",
    "Journal",
    "Observer",
    "Stage",
    "StandingSettings",
    "TimeVerdict",
    "Tracker",
    "TrackerSettings",
    "TrackerView",
]
