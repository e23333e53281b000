"""The passes over a recording, online and smoothing; each uses the results of the one before.

0. the tracker, frame by frame: which detections its tracks rest on;
1. tracklets without edges, reaching beyond both ends; weak ones, with little evidence, are put aside;
2. the others with the edges that follow from pass 1: ends and beginnings that meet become one object;
3. the stitched objects, with edges: free detections and those of weak tracklets are assigned; what no object takes of a
   weak tracklet is an object of its own; objects without a trace of evidence are dropped, stationary ones recognised;
4. the remaining ones, from first to last detection, with edges, robust losses, stationary states held, and factors of
   users' own: the final states. Those that came from far away reach back by `backward_time`.

A weak tracklet never takes a detection from a strong object, but it is not dropped either: in a crowd many true objects
are weak. Its low score puts it at the end of the ranking.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from saga_fg.graph import FactorProvider
from saga_fg.model import Sensor
from saga_fg.numerics import FloatArray, IntArray
from saga_fg.parts import new_part
from saga_fg.smoothing.association import (
    Evidence,
    assign_detections,
    assign_free_detections,
    evidence_scores,
    measured_in_order,
    stitch_tracklets,
)
from saga_fg.smoothing.batch_states import (
    GraphOf,
    ObjectMotion,
    StationaryStates,
    no_edges,
    robust_weights,
    smooth_states,
    stationary_states,
)
from saga_fg.smoothing.boxes import constant_sizes, size_weights
from saga_fg.smoothing.settings import PRIOR_OPPORTUNITY_TIME, SmoothingSettings
from saga_fg.smoothing.states import MEDIUM_SCORE, Lifespans, SmoothedEdges, StateTable
from saga_fg.tracking import ClassSettings, GreedyTracker, Tracker, TrackerSettings
from saga_fg.types import Frame, class_values

_REWEIGHTINGS = 1  # repetitions of loss weights and edges at the final states
ASSOCIATION_GATE = 0.95  # gate probability of detections without a track; higher: more are added, right and wrong
WEAK_SCORE = 0.05  # of a tracklet, below which it is not stitched and takes no detections from others
MAX_FREE_DISTANCE = 3.0  # between a state and a free detection assigned to it, m
UPDATED_GATE = 1 - 1e-12  # wide: the tracker has matched them already, perhaps by other models of the noise
EXTENSION = 1.5  # time by which the search for detections of an object reaches beyond its first and last one, s


def track_evidence(
    frames: Sequence[Frame],
    tracker: Tracker | GreedyTracker,
    evidence: Evidence,
    sensors: Mapping[str, Sensor],
    classes: Mapping[str, ClassSettings],
    progress: Callable[[int], None] | None = None,
) -> IntArray:
    """(N,) the track of each detection, -1 for none: the likeliest of the reported tracks that its frame updated.

    evidence: that of these frames, or of the next ones of a recording; progress: called with the frames done so far
    """
    track_of = np.full(len(evidence), -1, dtype=np.int64)
    ordered = measured_in_order(frames, sensors)
    for count, ((_, frame), rows) in enumerate(zip(ordered, evidence.rows_of_frame(), strict=True)):
        tracks = tracker.step(frame)
        updated = tracks.select(tracks.coasting == 0)
        boxes = updated.boxes
        objects, detections = assign_detections(
            boxes.label,
            boxes.position[:, :2] - evidence.origin,
            updated.position_covariance,
            evidence,
            np.arange(rows.start, rows.stop),
            UPDATED_GATE,
            class_values(classes, ClassSettings, boxes.label, "max_distance")[0],
        )
        track_of[detections] = updated.id[objects]
        if progress is not None:
            progress(count + 1)
    return track_of


@dataclass(frozen=True, eq=False)
class SmoothedObjects:
    """Result of the passes.

    lifespans  of the objects kept, from first to last detection
    object_of  (N,) the object of each detection, -1 for none or one that was dropped
    track_of   (N,) the online track of each detection, -1 for none or a weak one that lost it to another object
    states     of the objects at all moments of their lifespans, and before them of those that came from far away
    judged     the states, within the lifespans, that scores and stationary states follow from
    stationary the states in which an object is stationary
    dropped    the lifespans of the objects dropped
    held       states in which a person says that an object stands
    """

    lifespans: Lifespans
    object_of: IntArray
    track_of: IntArray
    states: StateTable
    judged: StateTable
    stationary: StationaryStates
    dropped: Lifespans
    held: StationaryStates = field(default_factory=lambda: StationaryStates(np.nan))


def smooth_objects(
    evidence: Evidence,
    track_of: IntArray,
    settings: SmoothingSettings,
    tracker: TrackerSettings,
    providers: Sequence[FactorProvider] = (),
) -> SmoothedObjects:
    """All passes. track_of (N,): the online track of each detection, -1 for none; providers: in place of those of the
    settings, asked from the first moment on every time the final states are solved for.
    """
    passes = Passes(evidence, settings, tracker, providers)
    everything = evidence.lifespans(track_of)
    ahead = max(EXTENSION, settings.max_gap)
    alone = passes.alone(everything, track_of, ahead)
    score = evidence_scores(evidence, track_of, everything, alone.within(everything), PRIOR_OPPORTUNITY_TIME)
    tracklets = everything.select(score >= WEAK_SCORE)
    strong = np.isin(track_of, tracklets.id)
    object_of = np.where(strong, track_of, -1)
    is_strong = np.isin(alone.id, tracklets.id)
    states = passes.coupled(tracklets, object_of, ahead, alone.select(is_strong))
    first = stitch_tracklets(tracklets, states, passes.motion(tracklets).velocity_prior, evidence, settings.max_gap)
    object_of[strong] = first[tracklets.rows_of(track_of[strong])]

    joined = evidence.lifespans(object_of)
    states = passes.alone(joined, object_of, EXTENSION)
    states = passes.coupled(joined, object_of, EXTENSION, states)
    object_of = assign_free_detections(evidence, object_of, joined, states, ASSOCIATION_GATE, MAX_FREE_DISTANCE)
    track_of = np.where(strong | (object_of < 0), track_of, -1)
    object_of = np.where(object_of < 0, track_of, object_of)
    states = states.merged(alone.select(~is_strong))
    lifespans = evidence.lifespans(object_of)
    within = states.within(lifespans)
    score = evidence_scores(evidence, object_of, lifespans, within, PRIOR_OPPORTUNITY_TIME)
    kept = score >= settings.min_score
    object_of = np.where(np.isin(object_of, lifespans.id[kept]), object_of, -1)
    stationary = stationary_states(within, lifespans, evidence, object_of, settings.position_drift, settings.classes)
    longer = passes.reaching_back(lifespans.select(kept), object_of, score[kept])
    final = passes.final(longer, object_of, states, stationary)
    return SmoothedObjects(
        lifespans=lifespans.select(kept),
        object_of=object_of,
        track_of=track_of,
        states=final,
        judged=within.within(lifespans.select(kept)),
        stationary=stationary,
        dropped=lifespans.select(~kept),
    )


@dataclass(frozen=True, eq=False)
class Passes:
    """Inputs of all passes, each of which gives states."""

    evidence: Evidence
    settings: SmoothingSettings
    tracker: TrackerSettings
    providers: Sequence[FactorProvider]

    def motion(
        self, lifespans: Lifespans, edges: GraphOf = no_edges, stationary: StationaryStates | None = None
    ) -> ObjectMotion:
        """How objects move, whose first velocities are those of new tracks."""
        (speed,) = class_values(self.tracker.classes, ClassSettings, lifespans.label, "initial_speed_deviation")
        return ObjectMotion(speed[:, None, None] ** 2 * np.eye(2), self.settings.classes, edges, stationary)

    def alone(self, lifespans: Lifespans, object_of: IntArray, ahead: float) -> StateTable:
        """States without edges of objects that reach beyond their detections, by `ahead` s at their ends."""
        longer = lifespans.reaching(self.evidence.times, EXTENSION, ahead)
        return smooth_states(self.evidence, object_of, longer, self.motion(longer))

    def coupled(self, lifespans: Lifespans, object_of: IntArray, ahead: float, states: StateTable) -> StateTable:
        """States as by `alone`, with the edges that follow from given states."""
        if not self.tracker.edges:
            return states
        longer = lifespans.reaching(self.evidence.times, EXTENSION, ahead)
        motion = self.motion(longer, self._edges(longer, object_of, states))
        return smooth_states(self.evidence, object_of, longer, motion)

    def reaching_back(self, lifespans: Lifespans, object_of: IntArray, score: FloatArray) -> Lifespans:
        """Extend objects of a score (n,) above low quality to before their first detection, if that is far away."""
        rows = np.flatnonzero(object_of >= 0)[::-1]
        distance = np.full(len(lifespans), np.nan)
        distance[lifespans.rows_of(object_of[rows])] = self.evidence.distance[rows]  # the earliest is written last
        settings = self.settings
        far = (distance > settings.backward_distance) & (score >= MEDIUM_SCORE)
        back = lifespans.reaching(self.evidence.times, settings.backward_time, 0.0)
        return replace(lifespans, first=np.where(far, back.first, lifespans.first))

    def final(
        self, lifespans: Lifespans, object_of: IntArray, states: StateTable, stationary: StationaryStates
    ) -> StateTable:
        """States with everything, from first to last detection; edges at first from `states` of an earlier pass."""
        for _ in range(_REWEIGHTINGS + 1 if self.settings.robust else 1):
            edges = self._edges(lifespans, object_of, states.within(lifespans)) if self.tracker.edges else no_edges
            loss = self.settings.robust
            weight = None if loss is None else robust_weights(self.evidence, object_of, states, loss)
            asked = self.providers or [new_part("providers", one, FactorProvider) for one in self.settings.providers]
            motion = self.motion(lifespans, edges, stationary)
            states = smooth_states(self.evidence, object_of, lifespans, motion, weight, asked)
        return states

    def _edges(self, lifespans: Lifespans, object_of: IntArray, states: StateTable) -> SmoothedEdges:
        rows = np.flatnonzero(np.isin(object_of, lifespans.id))
        owner, boxes = lifespans.rows_of(object_of[rows]), self.evidence.boxes
        size = constant_sizes(owner, len(lifespans), boxes.size[rows], size_weights(self.evidence)[rows])
        yaw = np.full(len(lifespans), np.nan)
        known = np.isfinite(boxes.yaw[rows])
        yaw[owner[known]] = boxes.yaw[rows[known]]
        return SmoothedEdges(self.tracker.edges, self.tracker.explained_noise, lifespans, states, yaw, size[:, 0])
