from .association import (
    Evidence,
    EvidenceFrame,
    assign_detections,
    assign_free_detections,
    evidence_scores,
    frame_rate,
    gather_evidence,
    measured_in_order,
    opportunities,
    stitch_tracklets,
)
from .batch_states import ObjectMotion, StationaryStates, no_edges, robust_weights, smooth_states, stationary_states
from .boxes import (
    Headings,
    constant_sizes,
    is_reversed,
    scalar_readings,
    size_weights,
    smooth_headings,
    smooth_walks,
    weighted_medians,
)
from .labelling import RecordingLabels
from .passes import smooth_known_objects
from .recording import ChunkSettings, LabelBuilder, LabelModel
from .settings import (
    OfflineClass,
    SmoothingSettings,
)
from .states import LabelCounts, Labels, Lifespans, Quality, SmoothedEdges, Source, StateTable, lifespans_of, quality_of

__all__ = [
    "ChunkSettings",
    "Evidence",
    "EvidenceFrame",
    "Headings",
    "LabelBuilder",
    "LabelCounts",
    "LabelModel",
    "Labels",
    "Lifespans",
    "ObjectMotion",
    "OfflineClass",
    "Quality",
    "RecordingLabels",
    "SmoothedEdges",
    "SmoothingSettings",
    "Source",
    "StateTable",
    "StationaryStates",
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
    "smooth_known_objects",
    "smooth_states",
    "smooth_walks",
    "stationary_states",
    "stitch_tracklets",
    "weighted_medians",
]
