"""Landmarks: every type behind the protocol, association, merging, and maps that are as good as they say."""

from __future__ import annotations

from itertools import product

import gtsam
import numpy as np
import pytest

from saga_fg import InputError
from saga_fg.model.landmarks import LineLandmark, PlaneLandmark, PointLandmark, PoleLandmark
from saga_fg.numerics.arrays import FloatArray
from saga_fg.numerics.assignment import gate
from saga_fg.slam.mapping import (
    LandmarkMap,
    LandmarkMapper,
    LocalMap,
    MapperSettings,
    associate,
    duplicates,
)
from saga_fg.types.landmark import LandmarkType, Observation

KINDS: list[LandmarkType] = [PointLandmark(), PointLandmark(dim=3), PoleLandmark(), PlaneLandmark(), LineLandmark()]
Q = np.diag([0.01, 0.01, 0.01, 0.05, 0.02, 0.02]) ** 2
NOISE = {"pole": np.diag([0.1, 0.1]) ** 2, "plane": np.diag([0.01, 0.01, 0.05]) ** 2}


def some_pose(kind: LandmarkType, rng: np.random.Generator) -> FloatArray:
    if kind.pose.dim == 3:
        return gtsam.Pose2(*rng.normal(0, 5, 2), rng.uniform(-3, 3)).matrix()
    return gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(0, 0.3, 3)), rng.normal(0, 5, 3)).matrix()


def some_observation(kind: LandmarkType, rng: np.random.Generator) -> FloatArray:
    if isinstance(kind, PlaneLandmark):
        normal = rng.normal(size=3)
        return np.append(normal / np.linalg.norm(normal), rng.uniform(2, 9))
    if isinstance(kind, LineLandmark):
        return rng.normal(0, 8, 6)
    return rng.normal(0, 8, 2 if isinstance(kind, PointLandmark) and kind.dim == 2 else 3)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: f"{kind.name} from {kind.pose.dim} dimensions")
def test_a_landmark_stands_where_its_first_observation_says(kind: LandmarkType) -> None:
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


def test_the_filter_is_the_smoother_where_everything_is_linear() -> None:
    """A straight drive past points, without turns: joint filter and global solution agree."""
    kind, rng = PointLandmark(), np.random.default_rng(0)
    mapper = LandmarkMapper(np.eye(3), np.diag([1e-4, 1e-4, 1e-12]), MapperSettings(smooth_every=10**6))
    trees = np.array([[3.0, 4.0], [8.0, -5.0], [15.0, 3.0]])
    step = np.eye(3)
    step[0, 2] = 1.0
    for k in range(8):
        seen = trees - [k, 0] + 0.05 * rng.normal(size=trees.shape)
        mapper.observe([Observation(kind, z, 0.01 * np.eye(2)) for z in seen])
        mapper.move(step, np.diag([1e-3, 1e-3, 1e-12]))
    filtered = mapper.local
    mapper.smooth()
    for number in (1, 2, 3):
        np.testing.assert_allclose(mapper.local.state(number), filtered.state(number), atol=1e-4)
    np.testing.assert_allclose(mapper.local.covariance([1, 2, 3]), filtered.covariance([1, 2, 3]), rtol=1e-2, atol=1e-6)


def poles_at(places: FloatArray, drift: float) -> LocalMap:
    """A map of poles, and a pose that is known to `drift` m within it."""
    local = LocalMap(np.eye(4), 1e-6 * np.eye(6))
    for number, (x, y) in enumerate(places, start=1):
        local.augment(number, Observation(PoleLandmark(), np.array([x, y, 0.5]), NOISE["pole"]))
    local.predict(np.eye(4), np.diag([1e-8, 1e-8, 1e-8, drift**2, drift**2, 1e-8]))
    return local


def seen(*places: tuple[float, float]) -> list[Observation]:
    return [Observation(PoleLandmark(), np.array([x, y, 0.0]), NOISE["pole"]) for x, y in places]


def test_each_landmark_is_matched_once_and_by_the_likeliest() -> None:
    local = poles_at(np.array([[10.0, 2.0], [10.0, -2.0]]), drift=0.1)
    pairs = associate(local, seen((10.05, -1.9), (10.4, -2.3), (10.0, 2.1)))
    assert {row: pair.landmark for row, pair in pairs.items()} == {0: 2, 2: 1}


def test_landmarks_of_another_type_are_no_candidates() -> None:
    local = poles_at(np.array([[10.0, 2.0]]), drift=0.1)
    point = Observation(PointLandmark(dim=3), np.array([10.0, 2.0, 0.5]), 0.01 * np.eye(3))
    assert associate(local, [point]) == {}


def test_pairs_that_contradict_each_other_are_not_taken_together() -> None:
    """Both move by more than a common shift can explain: one to the left, one to the right."""
    local = poles_at(np.array([[10.0, 4.0], [10.0, -4.0]]), drift=0.5)
    assert [len(associate(local, seen(one))) for one in ((10.0, 4.6), (10.0, -4.6))] == [1, 1]
    assert len(associate(local, seen((10.0, 4.6), (10.0, -4.6)))) == 1
    assert len(associate(local, seen((10.0, 4.4), (10.0, -3.6)))) == 2


def test_where_the_pose_is_badly_known_a_lone_landmark_is_not_matched() -> None:
    places = np.array([[10.0, 2.0]])
    assert len(associate(poles_at(places, 0.3), seen((10.3, 2.0)))) == 1
    assert len(associate(poles_at(places, 8.0), seen((10.3, 2.0)))) == 0


def revisited(shift: tuple[float, float], drift: float, count: int) -> LocalMap:
    """Poles 1 ... count, and begun anew after a drift of unknown direction, `shift` in truth."""
    places = np.array([[5.0, 5.0], [12.0, -4.0], [20.0, 6.0], [26.0, -7.0]])[:count]
    local = poles_at(places, drift)
    for number, (x, y) in enumerate(places + shift, start=count + 1):
        local.augment(number, Observation(PoleLandmark(), np.array([x, y, 0.5]), NOISE["pole"]))
    return local


def test_a_constellation_is_recognised_where_no_single_landmark_is() -> None:
    assert duplicates(revisited((4.0, 3.0), 5.0, 1), 0.999, set()) == {}
    assert duplicates(revisited((4.0, 3.0), 5.0, 4), 0.999, set()) == {5: 1, 6: 2, 7: 3, 8: 4}


def test_what_was_seen_side_by_side_is_never_one() -> None:
    local = revisited((0.1, 0.0), 0.2, 2)
    assert duplicates(local, 0.999, set()) == {3: 1, 4: 2}
    assert duplicates(local, 0.999, {(1, 3)}) == {4: 2}


def test_an_edge_is_one_whichever_way_its_normal_points(subtests: pytest.Subtests) -> None:
    """A curb in any direction, seen again a little turned: theta beyond pi, or (theta + pi, -rho)."""
    for way, side in product([0.0, np.pi / 2, np.pi, -np.pi + 1e-3], [4.0, 0.0]):
        with subtests.test(way=way, side=side):
            kind, R = LineLandmark(), 0.01 * np.eye(2)
            local = LocalMap(np.eye(4), 1e-6 * np.eye(6))
            for number, (turn, shift) in enumerate([(0.002, 0.02), (-0.002, -0.02)], start=1):
                along = np.array([np.cos(way + turn), np.sin(way + turn), 0.0])
                foot = (side + shift) * np.array([-along[1], along[0], 0.0])
                local.augment(number, Observation(kind, np.concatenate([foot - 5 * along, foot + 5 * along]), R))
            local.augment(3, Observation(kind, np.array([-5.0, -9.0, 0.0, 5.0, 11.0, 0.0]), R))
            assert duplicates(local, 0.999, set()) == {2: 1}


def street(seed: int) -> tuple[LandmarkMap, FloatArray, FloatArray, list[gtsam.OrientedPlane3]]:
    """Two rounds past poles, walls and the ground: the map, true poses, true poles, true planes."""
    rng = np.random.default_rng(seed)
    poles = np.array([[x, y] for x in (-12.0, 0.0, 12.0) for y in (-16.0, 0.5, 16.0)]) + rng.uniform(-1, 1, (9, 2))
    walls = np.array([[-1, 0.1, 0, 25], [1, 0, 0, 24], [0, -1, 0, 22], [0.1, 1, 0, 23], [0, 0, 1, 0]])
    planes = [gtsam.OrientedPlane3(wall / np.linalg.norm(wall[:3])) for wall in walls]
    true = [gtsam.Pose3(gtsam.Rot3.Yaw(np.pi / 2), np.array([9.0, 0.0, 1.5]))]
    turn = 2 * np.pi / 30
    mapper = LandmarkMapper(true[0].matrix(), 1e-6 * np.eye(6), MapperSettings(confirm_after=5, smooth_every=200))
    for _ in range(60):
        observations = []
        for x, y in poles:
            z = true[-1].transformTo(np.array([x, y, rng.uniform(0, 3)]))
            if np.hypot(*z[:2]) < 18:
                level = true[-1].rotation().matrix().T @ [
                    *(true[-1].rotation().matrix() @ [*rng.normal(0, 0.1, 2), 0])[:2],
                    0,
                ]
                observations.append(Observation(PoleLandmark(), z + level, NOISE["pole"]))
        for plane in planes:
            near = plane.transform(true[-1]).retract(rng.normal(0, np.sqrt(np.diag(NOISE["plane"]))))
            observations.append(Observation(PlaneLandmark(), near.planeCoefficients(), NOISE["plane"]))
        mapper.observe(observations)
        step = gtsam.Pose3(gtsam.Rot3.Yaw(turn), np.array([9.0 * turn, 0.0, 0.0]))
        mapper.move(step.retract(rng.normal(0, np.sqrt(np.diag(Q)))).matrix(), Q)
        true.append(true[-1].compose(step))
    return mapper.map(), np.stack([pose.matrix() for pose in true]), poles, planes


def test_planes_and_poles_are_recovered_within_their_stated_covariance() -> None:
    normalised: dict[str, list[float]] = {"pole": [], "plane": []}
    inside, worst = [], 0.0
    for seed in range(2):
        found, true, poles, planes = street(seed)
        truths = {"pole": list(poles), "plane": planes}
        confirmed = [landmark for landmark in found.landmarks if landmark.confirmed]
        assert len(confirmed) == len(poles) + len(planes)
        worst = max(worst, float(np.abs(found.world_T_pose[:, :3, 3] - true[:, :3, 3]).max()))
        for landmark in confirmed:
            errors = [landmark.kind.variable.local(landmark.state, t) for t in truths[landmark.kind.name]]
            squared = [float(e @ np.linalg.solve(landmark.covariance, e)) for e in errors]
            normalised[landmark.kind.name].append(min(squared) / len(errors[0]))
            inside.append(min(squared) < gate(0.95, len(errors[0])))
    assert worst < 0.6
    assert np.mean(inside) > 0.88
    for values in normalised.values():  # 1 on average if the covariance is honest; a map's landmarks err together
        assert 0.6 < np.mean(values) < 1.5


def test_every_observation_belongs_to_one_landmark_of_the_map() -> None:
    found, *_ = street(seed=0)
    numbers = {landmark.number for landmark in found.landmarks}
    assert {observation.landmark for observation in found.observations} == numbers
    assert sum(landmark.observations for landmark in found.landmarks) == len(found.observations)


def test_what_cannot_be_is_refused(subtests: pytest.Subtests) -> None:
    for make, message in [
        (lambda: Observation(PoleLandmark(), [1, 2, np.nan], np.eye(2)), "observed pole"),
        (lambda: Observation(PoleLandmark(), [1, 2, 3], np.eye(3)), "covariance of a pole"),
        (lambda: Observation(PlaneLandmark(), [0, 0, 1, 2], -np.eye(3)), "positive definite"),
        (lambda: LineLandmark().initialise(np.eye(4), np.tile([3.0, 2.0, 0.0], 2)), "two ends that are apart"),
        (lambda: PointLandmark(dim=4), "dim: expected 2 or 3"),
        (lambda: PoleLandmark(density=0.0), "density"),
        (lambda: MapperSettings(smooth_every=0), "smooth_every"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            make()  # type: ignore[operator]
