"""Poses by measured motions and what is seen from them, as providers of a running graph, in both back ends."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factors import Robust
from saga_fg.estimators import BatchSolver, IncrementalSmoother
from saga_fg.graph import GraphError, SceneFactorGraph, ask_all
from saga_fg.model.landmarks import PoleLandmark
from saga_fg.slam.mapping import LandmarkObservations, MeasuredMotion, landmark_key, pose_key
from saga_fg.types.landmark import Observation

Q = np.diag([0.01, 0.01, 0.02, 0.1, 0.05, 0.05]) ** 2
POLE, R = PoleLandmark(), 0.1**2 * np.eye(2)
POLES = np.array([[4.0, 5.0, 1.0], [9.0, -4.0, 1.0], [15.0, 6.0, 1.0]])
STEP = gtsam.Pose3(gtsam.Rot3.Yaw(0.1), np.array([2.0, 0.0, 0.0]))


def drive() -> tuple[list[MeasuredMotion], LandmarkObservations]:
    """Seven poses, from the last four of which all poles are seen, with wrong values to begin with."""
    rng, true = np.random.default_rng(0), gtsam.Pose3()
    motions, seen = [MeasuredMotion(np.eye(4), 1e-6 * np.eye(6))], dict[int, list[tuple[int, Observation]]]()
    for k in range(1, 7):
        motions.append(MeasuredMotion(STEP.retract(rng.normal(0, np.sqrt(np.diag(Q)))).matrix(), Q))
        true = true.compose(STEP)
        if k > 2:
            z = [true.transformTo(place) + np.append(rng.normal(0, 0.1, 2), 0.0) for place in POLES]
            seen[k] = [(n, Observation(POLE, one, R)) for n, one in enumerate(z)]
    return motions, LandmarkObservations(seen, {n: place[:2] + 0.5 for n, place in enumerate(POLES)})


def test_epochs_at_once_one_by_one_and_as_a_whole_are_the_same() -> None:
    together, single, whole = IncrementalSmoother(lag=None), IncrementalSmoother(lag=None), BatchSolver()
    motions, observations = drive()
    together.steps([(float(k), [motion, observations]) for k, motion in enumerate(motions)])
    for k, motion in enumerate(motions):
        whole.step(float(k), [motion, observations])
        now = {k: observations.seen[k]} if k in observations.seen else {}
        single.step(float(k), [motion, LandmarkObservations(now, observations.start)])
    keys = [pose_key(6), *map(landmark_key, range(3))]
    exact = whole.joint_covariance(keys)
    for smoother in (together, single):
        assert smoother.state(pose_key(6)).equals(whole.state(pose_key(6)), 1e-6)  # type: ignore[attr-defined]
        P = smoother.joint_covariance(keys)
        np.testing.assert_allclose(P, exact, atol=1e-6)
        np.testing.assert_allclose(smoother.joint_covariance(keys, rough=True), P, rtol=1e-5, atol=1e-9)
    for mark, place in zip(observations.landmarks(whole.solve(), 5), POLES, strict=True):
        off = mark.state - place[:2]
        assert off @ np.linalg.solve(mark.covariance, off) < 14
        assert not mark.confirmed


def test_a_loss_lets_an_outlier_go() -> None:
    motions, observations = drive()
    seen = {**observations.seen, 5: [*observations.seen[5], (0, Observation(POLE, np.array([30.0, 30.0, 0.0]), R))]}
    places = []
    for robust in (None, Robust("geman-mcclure", 3.0)):
        graph = SceneFactorGraph()
        for k, motion in enumerate(motions):
            graph.advance(float(k))
            ask_all([motion, LandmarkObservations(seen, observations.start, robust)], graph)
        places.append(BatchSolver(graph=graph).state(landmark_key(0)))
    plain, kept = (float(np.linalg.norm(place - POLES[0, :2])) for place in places)  # type: ignore[operator]
    assert kept < 0.6 * plain


def test_no_covariance_is_known_of_a_recording_that_is_solved_as_a_whole() -> None:
    class Asks:
        name = "asks"

        def factors(self, view):  # type: ignore[no-untyped-def]
            view.covariance(pose_key(0))

    graph = SceneFactorGraph()
    graph.advance(0.0)
    with pytest.raises(GraphError, match="no marginal is known"):
        ask_all([MeasuredMotion(np.eye(4), np.eye(6)), Asks()], graph)
