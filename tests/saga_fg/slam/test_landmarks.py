"""Landmarks: laws, providers of one's own, and the page on them."""

import re
import subprocess
import sys
from pathlib import Path

import gtsam
import numpy as np
import pytest

from factors import Robust
from saga_fg import InputError
from saga_fg.estimators import BatchSolver, IncrementalSmoother
from saga_fg.graph import GraphError, SceneFactorGraph, ask_all
from saga_fg.model.landmarks import PlaneLandmark, PointLandmark, PoleLandmark
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.mapping import LandmarkObservations, LocalMap, MeasuredMotion, associate, landmark_key, pose_key
from saga_fg.types.frame import LandmarkType, Observation

KINDS: list[LandmarkType] = [PointLandmark(), PointLandmark(dim=3), PoleLandmark(), PlaneLandmark()]
POLE = np.diag([0.1, 0.1]) ** 2
TREE, R = PointLandmark(density=0.01), 0.05**2 * np.eye(2)
Q = np.diag([0.02, 0.02, 0.002]) ** 2


def some_pose(kind: LandmarkType, rng: np.random.Generator) -> FloatArray:
    if kind.pose.dim == 3:
        return gtsam.Pose2(*rng.normal(0, 5, 2), rng.uniform(-3, 3)).matrix()
    return gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(0, 0.3, 3)), rng.normal(0, 5, 3)).matrix()


def some_observation(kind: LandmarkType, rng: np.random.Generator) -> FloatArray:
    if isinstance(kind, PlaneLandmark):
        normal = rng.normal(size=3)
        return np.append(normal / np.linalg.norm(normal), rng.uniform(2, 9))
    return rng.normal(0, 8, 2 if isinstance(kind, PointLandmark) and kind.dim == 2 else 3)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: f"{kind.name} from {kind.pose.dim} dimensions")
def test_a_landmark_stands_where_its_first_observation_says(kind):
    rng = np.random.default_rng(0)
    k, d = kind.pose.dim, kind.variable.dim
    local = LocalMap(some_pose(kind, rng), 0.01 * np.eye(k))
    R = np.diag(rng.uniform(0.01, 0.1, d))
    observation = Observation(kind, some_observation(kind, rng), R)
    local.augment(7, observation)
    (innovation,) = local.innovations([observation], [7])
    np.testing.assert_allclose(innovation.r, 0, atol=1e-9)
    # seen again from the same pose, the observation is as uncertain as noise alone: both share the pose's error
    np.testing.assert_allclose(local.innovation_covariance([innovation]), 2 * np.eye(d), atol=1e-6)
    before = local.covariance([7])
    local.update([innovation])
    assert np.linalg.det(local.covariance([7])) < np.linalg.det(before)
    assert {"x", "y"} <= set(kind.coordinates(local.state(7)))


def poles_at(places: FloatArray, drift: float) -> LocalMap:
    """A map of poles, and a pose that is known to `drift` m within it."""
    local = LocalMap(np.eye(4), 1e-6 * np.eye(6))
    for number, (x, y) in enumerate(places, start=1):
        local.augment(number, Observation(PoleLandmark(), np.array([x, y, 0.5]), POLE))
    local.predict(np.eye(4), np.diag([1e-8, 1e-8, 1e-8, drift**2, drift**2, 1e-8]))
    return local


def seen(*places: tuple[float, float]) -> list[Observation]:
    return [Observation(PoleLandmark(), np.array([x, y, 0.0]), POLE) for x, y in places]


def test_each_landmark_is_matched_once_by_the_likeliest_of_its_type():
    local = poles_at(np.array([[10.0, 2.0], [10.0, -2.0]]), drift=0.1)
    pairs = associate(local, seen((10.05, -1.9), (10.4, -2.3), (10.0, 2.1)))
    assert {row: pair.landmark for row, pair in pairs.items()} == {0: 2, 2: 1}
    local = poles_at(np.array([[10.0, 2.0]]), drift=0.1)
    point = Observation(PointLandmark(dim=3), np.array([10.0, 2.0, 0.5]), 0.01 * np.eye(3))
    assert associate(local, [point]) == {}


def test_contradictions_and_badly_known_poses_match_nothing():
    """Both move by more than a common shift can explain: one to the left, one to the right."""
    local = poles_at(np.array([[10.0, 4.0], [10.0, -4.0]]), drift=0.5)
    assert [len(associate(local, seen(one))) for one in ((10.0, 4.6), (10.0, -4.6))] == [1, 1]
    assert len(associate(local, seen((10.0, 4.6), (10.0, -4.6)))) == 1
    assert len(associate(local, seen((10.0, 4.4), (10.0, -3.6)))) == 2
    places = np.array([[10.0, 2.0]])
    assert len(associate(poles_at(places, 0.3), seen((10.3, 2.0)))) == 1
    assert len(associate(poles_at(places, 8.0), seen((10.3, 2.0)))) == 0


def ahead(metres: float, turn: float = 0.0) -> FloatArray:
    return np.asarray(gtsam.Pose2(metres, 0.0, turn).matrix())


def test_a_filter_of_some_landmarks_is_that_of_all_marginalised():
    rng = np.random.default_rng(0)
    places = rng.uniform(-20, 20, (6, 2))
    everything = LocalMap(np.eye(3), np.diag([1e-2, 1e-2, 1e-4]))
    for number, place in enumerate(places, start=1):
        everything.augment(number, Observation(TREE, place + rng.normal(0, 0.1, 2), R))
    everything.predict(ahead(2.0, 0.3), Q)
    some = [2, 3, 5]
    local = LocalMap(
        everything.pose.matrix(), everything.covariance([0, *some]), {n: (TREE, everything.state(n)) for n in some}
    )
    for _ in range(3):
        pose = everything.pose
        seen = [Observation(TREE, pose.transformTo(places[n - 1]) + rng.normal(0, 0.1, 2), R) for n in some]
        for held in (everything, local):
            held.update([held.innovations([z], [n])[0] for z, n in zip(seen, some, strict=True)])
            held.predict(ahead(1.0, -0.1), Q)
    np.testing.assert_allclose(local.covariance([0, *some]), everything.covariance([0, *some]), atol=1e-12)
    np.testing.assert_allclose(local.pose.matrix(), everything.pose.matrix(), atol=1e-12)


def test_what_cannot_be_is_refused(subtests):
    for make, message in [
        (lambda: Observation(PoleLandmark(), [1, 2, np.nan], np.eye(2)), "observed pole"),
        (lambda: Observation(PoleLandmark(), [1, 2, 3], np.eye(3)), "covariance of a pole"),
        (lambda: Observation(PlaneLandmark(), [0, 0, 1, 2], -np.eye(3)), "positive definite"),
        (lambda: PointLandmark(dim=4), "dim: expected 2 or 3"),
        (lambda: PoleLandmark(density=0.0), "density"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            make()  # type: ignore[operator]


# Poses by measured motions and what is seen from them, as providers of a running graph, in both back ends

OWN_Q = np.diag([0.01, 0.01, 0.02, 0.1, 0.05, 0.05]) ** 2
OWN_POLE, OWN_R = PoleLandmark(), 0.1**2 * np.eye(2)
POLES = np.array([[4.0, 5.0, 1.0], [9.0, -4.0, 1.0], [15.0, 6.0, 1.0]])
STEP = gtsam.Pose3(gtsam.Rot3.Yaw(0.1), np.array([2.0, 0.0, 0.0]))


def drive() -> tuple[list[MeasuredMotion], LandmarkObservations]:
    """Seven poses, from the last four of which all poles are seen, with wrong values to begin with."""
    rng, true = np.random.default_rng(0), gtsam.Pose3()
    motions, seen = [MeasuredMotion(np.eye(4), 1e-6 * np.eye(6))], dict[int, list[tuple[int, Observation]]]()
    for k in range(1, 7):
        motions.append(MeasuredMotion(STEP.retract(rng.normal(0, np.sqrt(np.diag(OWN_Q)))).matrix(), OWN_Q))
        true = true.compose(STEP)
        if k > 2:
            z = [true.transformTo(place) + np.append(rng.normal(0, 0.1, 2), 0.0) for place in POLES]
            seen[k] = [(n, Observation(OWN_POLE, one, OWN_R)) for n, one in enumerate(z)]
    return motions, LandmarkObservations(seen, {n: place[:2] + 0.5 for n, place in enumerate(POLES)})


def test_epochs_one_by_one_and_as_a_whole_are_the_same():
    single, whole = IncrementalSmoother(lag=None), BatchSolver()
    motions, observations = drive()
    for k, motion in enumerate(motions):
        whole.step(float(k), [motion, observations])
        now = {k: observations.seen[k]} if k in observations.seen else {}
        single.step(float(k), [motion, LandmarkObservations(now, observations.start)])
    keys = [pose_key(6), *map(landmark_key, range(3))]
    exact = whole.joint_covariance(keys)
    assert single.state(pose_key(6)).equals(whole.state(pose_key(6)), 1e-6)  # type: ignore[attr-defined]
    P = single.joint_covariance(keys)
    np.testing.assert_allclose(P, exact, atol=1e-6)
    np.testing.assert_allclose(single.joint_covariance(keys, rough=True), P, rtol=1e-5, atol=1e-9)
    for mark, place in zip(observations.landmarks(whole.solve(), 5), POLES, strict=True):
        off = mark.state - place[:2]
        assert off @ np.linalg.solve(mark.covariance, off) < 14
        assert not mark.confirmed


def test_a_loss_lets_an_outlier_go():
    motions, observations = drive()
    seen = {
        **observations.seen,
        5: [*observations.seen[5], (0, Observation(OWN_POLE, np.array([30.0, 30.0, 0.0]), OWN_R))],
    }
    places = []
    for robust in (None, Robust("geman-mcclure", 3.0)):
        graph = SceneFactorGraph()
        for k, motion in enumerate(motions):
            graph.advance(float(k))
            ask_all([motion, LandmarkObservations(seen, observations.start, robust)], graph)
        places.append(BatchSolver(graph=graph).state(landmark_key(0)))
    plain, kept = (float(np.linalg.norm(place - POLES[0, :2])) for place in places)  # type: ignore[operator]
    assert kept < 0.6 * plain


def test_no_covariance_is_known_of_a_recording_that_is_solved_as_a_whole():
    class Asks:
        name = "asks"

        def factors(self, view):  # type: ignore[no-untyped-def]
            view.covariance(pose_key(0))

    graph = SceneFactorGraph()
    graph.advance(0.0)
    with pytest.raises(GraphError, match="no marginal is known"):
        ask_all([MeasuredMotion(np.eye(4), np.eye(6)), Asks()], graph)


# The page "How to add a landmark" runs as printed, top to bottom

PAGE = Path(__file__).parents[3] / "docs" / "guides" / "add-a-landmark.md"


def test_page_runs():
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    assert len(blocks) == 5
    done = subprocess.run([sys.executable, "-c", "\n".join(blocks)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    assert done.stdout.count("traffic sign {") == 5
    assert "traffic sign observed as [10.0, 4.0, 2.0], which its type cannot read" in done.stdout
