"""Offline smoothing: from tracks of a recording to labels, with past and future of every box."""

from saga_fg.smoothing.association import assign_detections, assign_free_detections, stitch_tracklets
from saga_fg.smoothing.batch_states import no_edges, robust_weights, smooth_states
from saga_fg.smoothing.boxes import (
    Headings,
    constant_sizes,
    is_reversed,
    size_weights,
    smooth_headings,
    weighted_medians,
)
from saga_fg.smoothing.edges import SmoothedEdges
from saga_fg.smoothing.evidence import (
    Evidence,
    EvidenceFrame,
    evidence_scores,
    frame_rate,
    gather_evidence,
    measured_in_order,
    opportunities,
)
from saga_fg.smoothing.labels import LabelCounts, Labels, Quality, Source, quality_of
from saga_fg.smoothing.random_walk import scalar_readings, smooth_walks
from saga_fg.smoothing.settings import (
    OfflineClass,
    QualitySettings,
    SmoothingSettings,
    StationarySettings,
    StitchingSettings,
)
from saga_fg.smoothing.states import Lifespans, StateTable, lifespans_of
from saga_fg.smoothing.stationarity import StationaryStates, stationary_states

__all__ = [
    "Evidence",
    "EvidenceFrame",
    "Headings",
    "LabelCounts",
    "Labels",
    "Lifespans",
    "OfflineClass",
    "Quality",
    "QualitySettings",
    "SmoothedEdges",
    "SmoothingSettings",
    "Source",
    "StateTable",
    "StationarySettings",
    "StationaryStates",
    "StitchingSettings",
    "assign_detections",
    "assign_free_detections",
    "constant_sizes",
    "evidence_scores",
    "frame_rate",
    "gather_evidence",
    "is_reversed",
    "lifespans_of",
    "measured_in_order",
    "no_edges",
    "opportunities",
    "quality_of",
    "robust_weights",
    "scalar_readings",
    "size_weights",
    "smooth_headings",
    "smooth_states",
    "smooth_walks",
    "stationary_states",
    "stitch_tracklets",
    "weighted_medians",
]
