"""Maps whose cost does not grow: which landmarks are near, a filter of these alone, and what a long drive holds."""

from __future__ import annotations

import tracemalloc

import gtsam
import numpy as np
import pytest

from saga_fg import InputError
from saga_fg.model.landmarks import PlaneLandmark, PointLandmark, PoleLandmark
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.mapping import LandmarkMapper, LocalMap, MapperSettings, NearbyLandmarks, place_of
from saga_fg.types.landmark import Observation

TREE, R = PointLandmark(density=0.01), 0.05**2 * np.eye(2)
Q = np.diag([0.02, 0.02, 0.002]) ** 2
SURE = 1e-6 * np.eye(3)


def ahead(metres: float, turn: float = 0.0) -> FloatArray:
    return np.asarray(gtsam.Pose2(metres, 0.0, turn).matrix())


def test_a_filter_of_some_landmarks_is_that_of_all_marginalised() -> None:
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


def test_near_is_what_can_be_seen_before_the_next_question() -> None:
    near = NearbyLandmarks()
    for number, x in enumerate([5.0, 18.0, 30.0, 100.0], start=1):
        near.see(number, np.array([5.0, 0.0]), np.array([[1.0, 0, x - 5.0], [0, 1, 0], [0, 0, 1]]), SURE)
    assert near.reach == 5.0
    assert near.near(np.array([10.0, 0.0]), SURE).tolist() == [1, 2]
    near.merge(2, 1)
    assert near.near(np.array([28.0, 0.0]), SURE).tolist() == [1, 3]  # anywhere between the two places


def test_drift_makes_more_landmarks_near_and_a_way_without_loops_does_not() -> None:
    near = NearbyLandmarks()
    near.see(1, np.array([5.0, 0.0]), np.eye(3), SURE)
    lost, place = np.diag([400.0, 400.0, 1e-2]), np.array([60.0, 0.0])
    for _ in range(60):
        near.move(ahead(1.0), Q)
    assert near.near(place, lost).tolist() == []  # the world is known badly, these 60 m are not
    for _ in range(600):
        near.move(ahead(1.0), Q)
    assert near.near(place, lost).tolist() == [1]


def test_a_wall_is_near_where_its_foot_was_seen() -> None:
    wall = Observation(PlaneLandmark(), np.array([0.0, -1.0, 0.0, 4.0]), 1e-4 * np.eye(3))
    np.testing.assert_allclose(place_of(wall), [0.0, 4.0], atol=1e-12)


def corridor(landmarks: int) -> tuple[LandmarkMapper, int, int]:
    """A drive past pairs of trees; the largest Gaussian held, and bytes that the last poses allocate at most."""
    rng = np.random.default_rng(1)
    trees = np.stack([np.repeat(np.arange(landmarks // 2), 2) * 9.0, np.tile([5.0, -5.0], landmarks // 2)], axis=1)
    trees += rng.uniform(-1.5, 1.5, trees.shape)
    mapper, widest, pose = LandmarkMapper(np.eye(3), SURE, MapperSettings(smooth_every=20)), 0, gtsam.Pose2()
    poses = int(9.0 * landmarks / 2 / 3.0)
    for k in range(poses):
        if k == poses - 15:
            tracemalloc.start()
        near = trees[np.abs(trees[:, 0] - pose.x()) < 10]
        mapper.observe([Observation(TREE, pose.transformTo(tree) + rng.normal(0, 0.05, 2), R) for tree in near])
        widest = max(widest, mapper.local.P.size)
        step = gtsam.Pose2(3.0, 0.0, 0.0)
        mapper.move(step.retract(rng.normal(0, np.sqrt(np.diag(Q)))).matrix(), Q)
        pose = pose.compose(step)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return mapper, widest, peak


def test_no_array_holds_all_pairs_of_landmarks() -> None:
    few, narrow, little = corridor(40)
    many, wide, much = corridor(160)
    assert (len(few.landmarks), len(many.landmarks)) == (40, 160)
    assert wide <= 1.2 * narrow  # numbers of the covariance
    assert much < 6 * little  # an array of all pairs is sixteen times as large


def test_duplicates_are_merged_along_the_whole_way_that_led_to_them() -> None:
    """Round a block with a drift that odometry tells, past the first trees again before the loop is found."""
    kind, rng = PointLandmark(density=0.05), np.random.default_rng(0)
    angle = 2 * np.pi * np.arange(60) / 60
    trees = np.stack([36 * np.sin(angle), 30 - 36 * np.cos(angle)], axis=1) + rng.uniform(-1.5, 1.5, (60, 2))
    mapper = LandmarkMapper(np.eye(3), SURE, MapperSettings(smooth_every=60))
    pose, step = gtsam.Pose2(), gtsam.Pose2(np.pi, 0.0, np.pi / 30)
    sigma = np.array([0.1, 0.1, 0.04])
    true, started = list[int](), 0
    for _ in range(84):
        local = np.array([pose.transformTo(tree) for tree in trees])
        rows = np.flatnonzero((np.hypot(*local.T) < 12) & (local[:, 0] > 0))
        taken = mapper.observe([Observation(kind, local[row] + rng.normal(0, 0.05, 2), R) for row in rows])
        started = max(started, *taken)
        true += rows.tolist()
        mapper.move(step.retract(sigma * rng.normal(size=3)).matrix(), np.diag(sigma**2))
        pose = pose.compose(step)
    found = [one.landmark for one in mapper.map().observations]
    assert max(found) <= started > 64
    assert len(set(zip(found, true, strict=True))) == len(set(found)) == len(set(true)) == 60


def test_what_an_observation_cannot_be_names_type_and_time_and_changes_nothing() -> None:
    mapper = LandmarkMapper(np.eye(3), SURE)
    good = Observation(TREE, np.array([4.0, 1.0]), R)
    mapper.observe([good])
    mapper.move(ahead(1.0), Q, time=12.5)
    with pytest.raises(InputError, match=r"pose 1 at 12\.50 s: point observed as \[1\.0, 2\.0, 3\.0\], which its type"):
        mapper.observe([good, Observation(TREE, np.array([1.0, 2.0, 3.0]), R)])
    with pytest.raises(InputError, match="time: expected a finite number after"):
        mapper.move(ahead(1.0), Q, time=12.5)
    with pytest.raises(InputError, match="covariance"):
        mapper.move(ahead(1.0), np.eye(6))
    with pytest.raises(InputError, match=r"pose 1 at 12\.50 s: pole: expected poses in space for this type"):
        mapper.observe([Observation(PoleLandmark(), np.array([1.0, 2.0, 3.0]), R)])
    with pytest.raises(InputError, match="observations: expected Sequence, got Observation"):
        mapper.observe(good)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="observations: expected Observation, got int"):
        mapper.observe([3])  # type: ignore[list-item]
    assert [landmark.observations for landmark in mapper.map().landmarks] == [1]


def test_what_is_no_motion_is_refused_and_the_drive_goes_on(subtests: pytest.Subtests) -> None:
    for motion, message in [
        (np.eye(4), r"a_T_b: expected a 3 x 3 transform like the mapper's poses, got shape \(4, 4\)"),
        (np.full((3, 3), np.nan), "a_T_b"),
        (2 * np.eye(3), "a_T_b: expected a rigid transform"),
        ("ahead", "a_T_b"),
    ]:
        with subtests.test(message):
            mapper = LandmarkMapper(np.eye(3), SURE)
            with pytest.raises(InputError, match=message):
                mapper.move(motion, Q)
            mapper.move(ahead(1.0).tolist(), Q)  # type: ignore[arg-type]
            assert len(mapper.map().world_T_pose) == 2


def test_a_first_pose_has_a_covariance(subtests: pytest.Subtests) -> None:
    for covariance in [np.eye(6), np.zeros((3, 3)), -np.eye(3), np.full((3, 3), np.nan)]:
        with subtests.test(covariance=covariance):
            with pytest.raises(InputError, match="covariance"):
                LandmarkMapper(np.eye(3), covariance)
            with pytest.raises(InputError, match="world_T_pose: expected a rigid transform"):
                LandmarkMapper(2 * np.eye(3), SURE)


class Sideways(PointLandmark):
    """A point of which only the distance to the side is measured."""

    def factors(self, rows, observed, covariances):  # type: ignore[no-untyped-def]
        from factors import residual_factor

        return [
            residual_factor(
                tuple(keys),
                (self.pose, self.variable),
                lambda pose, place, z=z: (pose.transformTo(place) - z) * [0.0, 1.0],
                covariance,
            )
            for keys, z, covariance in zip(rows.tolist(), observed, covariances, strict=True)
        ]


def test_a_landmark_that_one_observation_leaves_open_is_refused() -> None:
    mapper = LandmarkMapper(np.eye(3), SURE)
    with pytest.raises(InputError, match=r"at 0\.00 s: point observed .*: components \[0\] of its state are not"):
        mapper.observe([Observation(Sideways(), np.array([4.0, 1.0]), R)])
    assert mapper.landmarks == {}
