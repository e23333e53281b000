"""The rounds of smoothing a recording: each knows more than the one before, and leaves better objects.

1. tracklets on their own, reaching beyond both ends; those with next to no evidence go;
2. the others with the edges that follow from round 1: ends and beginnings that meet become one object;
3. the objects so joined, with edges: detections nobody took are claimed, objects with too little evidence dropped, and
   stands recognised;
4. what is left, from first to last detection, with edges, robust losses, pinned stands, and factors of users' own: the
   final states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from saga_fg.graph import FactorProvider
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.smoothing import (
    Evidence,
    Lives,
    SmoothedEdges,
    SmoothingSettings,
    Standing,
    StateTable,
    claim_detections,
    constant_sizes,
    evidence_scores,
    join_tracklets,
    lives_of_evidence,
    no_edges,
    robust_weights,
    smooth_states,
    standing_states,
)
from saga_fg.tracking import TrackerSettings
from saga_fg.tracking.provider_names import new_provider
from saga_fg.tracking.settings import ClassSettings
from saga_fg.types.by_class import class_values

TAKES_PART = 0.5  # share of the score an object needs that a tracklet needs to become part of one
MAX_CLAIM = 3.0  # largest distance between a state and a detection it claims, m


@dataclass(frozen=True, eq=False)
class SmoothedObjects:
    """What the rounds come to.

    lives      the objects kept
    object_of  (N,) the object of each detection, -1 for none or one that was dropped
    track_of   (N,) the online track of each detection, -1 for none or one that did not take part
    states     of the objects at all moments of their lives
    score      (n,) of the lives
    standing   the states in which an object stands
    joined     tracklets that became part of another's object
    dropped    the lives of the tracklets and objects dropped
    """

    lives: Lives
    object_of: IntArray
    track_of: IntArray
    states: StateTable
    score: FloatArray
    standing: Standing
    joined: int
    dropped: tuple[Lives, Lives]


def smooth_objects(
    evidence: Evidence,
    track_of: IntArray,
    settings: SmoothingSettings,
    tracker: TrackerSettings,
    providers: Sequence[FactorProvider] = (),
) -> SmoothedObjects:
    """All rounds. track_of (N,): the online track of each detection, -1 for none; providers: in place of those of the
    settings, asked from the first moment on every time the final states are solved for.
    """
    rounds = _Rounds(evidence, settings, tracker, providers)
    label, moment = evidence.boxes.label, evidence.moment
    everything = lives_of_evidence(track_of, label, moment)
    ahead = max(settings.extension, settings.stitching.max_gap)
    states = rounds.alone(everything, track_of, ahead)
    score = evidence_scores(evidence, track_of, everything, states.within(everything), settings.prior_opportunity_time)
    weak = everything.select(score < TAKES_PART * settings.min_score)
    tracklets = everything.select(score >= TAKES_PART * settings.min_score)
    track_of = np.where(np.isin(track_of, tracklets.id), track_of, -1)
    states = rounds.coupled(tracklets, track_of, ahead, states.select(np.isin(states.id, tracklets.id)))
    first = join_tracklets(tracklets, states, rounds.velocity_prior(tracklets), evidence, settings.stitching)
    object_of = track_of.copy()
    tracked = np.flatnonzero(track_of >= 0)
    object_of[tracked] = first[tracklets.rows_of(track_of[tracked])]

    joined = lives_of_evidence(object_of, label, moment)
    states = rounds.alone(joined, object_of, settings.extension)
    states = rounds.coupled(joined, object_of, settings.extension, states)
    object_of = claim_detections(evidence, object_of, joined, states, settings.association_gate, MAX_CLAIM)
    lives = lives_of_evidence(object_of, label, moment)
    within = states.within(lives)
    score = evidence_scores(evidence, object_of, lives, within, settings.prior_opportunity_time)
    kept = score >= settings.min_score
    object_of = np.where(np.isin(object_of, lives.id[kept]), object_of, -1)
    standing = standing_states(within, lives, evidence, object_of, settings.stationary, settings.classes)
    final = rounds.final(lives.select(kept), object_of, states, standing)
    return SmoothedObjects(
        lives.select(kept),
        object_of,
        track_of,
        final,
        score[kept],
        standing,
        len(tracklets) - len(joined),
        (weak, lives.select(~kept)),
    )


def smooth_known_objects(
    evidence: Evidence, object_of: IntArray, settings: SmoothingSettings, tracker: TrackerSettings
) -> StateTable:
    """The last round alone, without stands, where it is known which object (N,) each detection is of, -1 for none."""
    rounds = _Rounds(evidence, settings, tracker, ())
    lives = lives_of_evidence(object_of, evidence.boxes.label, evidence.moment)
    states = smooth_states(evidence, object_of, lives, rounds.velocity_prior(lives), settings.classes)
    return rounds.final(lives, object_of, states, Standing(settings.stationary))


@dataclass(frozen=True, eq=False)
class _Rounds:
    """What all rounds share."""

    evidence: Evidence
    settings: SmoothingSettings
    tracker: TrackerSettings
    providers: Sequence[FactorProvider]

    def velocity_prior(self, lives: Lives) -> FloatArray:
        """(n, 2, 2) covariance of the velocity of something new."""
        (speed,) = class_values(self.tracker.classes, ClassSettings, lives.label, "initial_speed_deviation")
        return np.asarray(speed[:, None, None] ** 2 * np.eye(2))

    def alone(self, lives: Lives, object_of: IntArray, ahead: float) -> StateTable:
        """States without edges of objects that reach beyond their detections, by `ahead` s at their ends."""
        longer = lives.reaching(self.evidence.times, self.settings.extension, ahead)
        return smooth_states(self.evidence, object_of, longer, self.velocity_prior(longer), self.settings.classes)

    def coupled(self, lives: Lives, object_of: IntArray, ahead: float, states: StateTable) -> StateTable:
        """The same with the edges that follow from given states."""
        if not self.tracker.edges:
            return states
        longer = lives.reaching(self.evidence.times, self.settings.extension, ahead)
        edges = self._edges(longer, object_of, states)
        prior, classes = self.velocity_prior(longer), self.settings.classes
        return smooth_states(self.evidence, object_of, longer, prior, classes, edges)

    def final(self, lives: Lives, object_of: IntArray, states: StateTable, standing: Standing) -> StateTable:
        """With everything, from first to last detection; `states` of an earlier round tell the edges."""
        for _ in range(self.settings.reweightings + 1 if self.settings.robust else 1):
            edges = self._edges(lives, object_of, states.within(lives)) if self.tracker.edges else no_edges
            loss = self.settings.robust
            weight = None if loss is None else robust_weights(self.evidence, object_of, states, loss)
            prior, classes = self.velocity_prior(lives), self.settings.classes
            asked = self.providers or [new_provider(name) for name in self.settings.providers]
            states = smooth_states(self.evidence, object_of, lives, prior, classes, edges, weight, standing, asked)
        return states

    def _edges(self, lives: Lives, object_of: IntArray, states: StateTable) -> SmoothedEdges:
        rows = np.flatnonzero(object_of >= 0)
        rows = rows[np.isin(object_of[rows], lives.id)]
        owner, boxes, p = lives.rows_of(object_of[rows]), self.evidence.boxes, self.evidence.probability[rows]
        size = constant_sizes(owner, len(lives), boxes.size[rows], p, self.evidence.distance[rows])
        yaw = np.full(len(lives), np.nan)
        known = np.isfinite(boxes.yaw[rows])
        yaw[owner[known]] = boxes.yaw[rows[known]]
        return SmoothedEdges.of(self.tracker.edges, self.tracker.explained_noise, lives, states, yaw, size[:, 0])
