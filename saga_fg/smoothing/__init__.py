"""Offline smoothing: from tracks of a recording to labels, with past and future of every box."""

from saga_fg.smoothing.attribution import attribute
from saga_fg.smoothing.batch_states import Standing, no_edges, robust_weights, smooth_states
from saga_fg.smoothing.claiming import claim_detections
from saga_fg.smoothing.edges import SmoothedEdges
from saga_fg.smoothing.evidence import Evidence, Look, gather_evidence, measured_in_order
from saga_fg.smoothing.headings import Headings, is_backwards, smooth_headings
from saga_fg.smoothing.joining import join_tracklets
from saga_fg.smoothing.labels import LabelCounts, Labels, Quality, Source, quality_of
from saga_fg.smoothing.random_walk import previous_rows, scalar_readings, smooth_walks
from saga_fg.smoothing.scoring import evidence_scores, look_rate, looks_in_view
from saga_fg.smoothing.settings import (
    OfflineClass,
    QualitySettings,
    SmoothingSettings,
    StationarySettings,
    StitchingSettings,
)
from saga_fg.smoothing.sizes import constant_sizes, size_weights, weighted_medians
from saga_fg.smoothing.standing import standing_states
from saga_fg.smoothing.states import Lives, StateTable, lives_of_evidence

__all__ = [
    "Evidence",
    "Headings",
    "LabelCounts",
    "Labels",
    "Lives",
    "Look",
    "OfflineClass",
    "Quality",
    "QualitySettings",
    "SmoothedEdges",
    "SmoothingSettings",
    "Source",
    "Standing",
    "StateTable",
    "StationarySettings",
    "StitchingSettings",
    "attribute",
    "claim_detections",
    "constant_sizes",
    "evidence_scores",
    "gather_evidence",
    "is_backwards",
    "join_tracklets",
    "lives_of_evidence",
    "look_rate",
    "looks_in_view",
    "measured_in_order",
    "no_edges",
    "previous_rows",
    "quality_of",
    "robust_weights",
    "scalar_readings",
    "size_weights",
    "smooth_headings",
    "smooth_states",
    "smooth_walks",
    "standing_states",
    "weighted_medians",
]
