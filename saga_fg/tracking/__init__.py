"""Trackers: frames of detections in, tracks out."""

from saga_fg.tracking.clock import TimeVerdict
from saga_fg.tracking.greedy import GreedyTracker
from saga_fg.tracking.journal import Journal
from saga_fg.tracking.observer import Observer, Stage, TrackerView
from saga_fg.tracking.settings import (
    AssociationName,
    AssociationSettings,
    ClassSettings,
    ClockSettings,
    EgoNodeSettings,
    EstimatorName,
    ExistenceSettings,
    FlowSettings,
    GreedySettings,
    StandingSettings,
    TrackerSettings,
)
from saga_fg.tracking.tracker import Tracker

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
