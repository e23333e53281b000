from .association import assign_detections, assign_free_detections, stitch_tracklets
from .batch_states import no_edges, robust_weights, smooth_states
from .boxes import (
    Headings,
    constant_sizes,
    is_reversed,
    size_weights,
    smooth_headings,
    weighted_medians,
)
from .edges import SmoothedEdges
from .evidence import (
    Evidence,
    EvidenceFrame,
    evidence_scores,
    frame_rate,
    gather_evidence,
    measured_in_order,
    opportunities,
)
from .labels import LabelCounts, Labels, Quality, Source, quality_of
from .random_walk import scalar_readings, smooth_walks
from .settings import (
    OfflineClass,
    SmoothingSettings,
    StationarySettings,
    StitchingSettings,
)
from .states import Lifespans, StateTable, lifespans_of
from .stationarity import StationaryStates, stationary_states

__all__ = [
    "Evidence",
    "EvidenceFrame",
    "Headings",
    "LabelCounts",
    "Labels",
    "Lifespans",
    "OfflineClass",
    "Quality",
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
