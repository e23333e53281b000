"""The mapper of planar drives: maps whose cost does not grow, merging, and covariances that are honest."""

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks.landmark_mapper import LandmarkMapper, MapperSettings
from benchmarks.landmark_merging import NearbyLandmarks, duplicates, place_of
from saga_fg import InputError
from saga_fg.model.landmarks import PlaneLandmark, PointLandmark, PoleLandmark
from saga_fg.numerics.arrays import FloatArray
from saga_fg.slam.mapping import LocalMap
from saga_fg.types.frame import Observation

TREE, R = PointLandmark(density=0.01), 0.05**2 * np.eye(2)
Q = np.diag([0.02, 0.02, 0.002]) ** 2
SURE = 1e-6 * np.eye(3)
NOISE = {"pole": np.diag([0.1, 0.1]) ** 2, "plane": np.diag([0.01, 0.01, 0.05]) ** 2}


def ahead(metres: float, turn: float = 0.0) -> FloatArray:
    return np.asarray(gtsam.Pose2(metres, 0.0, turn).matrix())


def test_near_is_what_can_be_seen_and_a_wall_where_its_foot_was():
    near = NearbyLandmarks()
    for number, x in enumerate([5.0, 18.0, 30.0, 100.0], start=1):
        near.see(number, np.array([5.0, 0.0]), np.array([[1.0, 0, x - 5.0], [0, 1, 0], [0, 0, 1]]), SURE)
    assert near.reach == 5.0
    assert near.near(np.array([10.0, 0.0]), SURE).tolist() == [1, 2]
    near.merge(2, 1)
    assert near.near(np.array([28.0, 0.0]), SURE).tolist() == [1, 3]  # anywhere between the two places
    wall = Observation(PlaneLandmark(), np.array([0.0, -1.0, 0.0, 4.0]), 1e-4 * np.eye(3))
    np.testing.assert_allclose(place_of(wall), [0.0, 4.0], atol=1e-12)


def test_drift_makes_more_landmarks_near_and_a_way_without_loops_does_not():
    near = NearbyLandmarks()
    near.see(1, np.array([5.0, 0.0]), np.eye(3), SURE)
    lost, place = np.diag([400.0, 400.0, 1e-2]), np.array([60.0, 0.0])
    for _ in range(60):
        near.move(ahead(1.0), Q)
    assert near.near(place, lost).tolist() == []  # the world is known badly, these 60 m are not
    for _ in range(600):
        near.move(ahead(1.0), Q)
    assert near.near(place, lost).tolist() == [1]


def test_duplicates_are_merged_along_the_whole_way_that_led_to_them():
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


def test_what_an_observation_cannot_be_names_type_and_time_and_changes_nothing():
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


def test_the_filter_is_the_smoother_where_everything_is_linear():
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


def revisited(shift: tuple[float, float], drift: float, count: int) -> LocalMap:
    """Poles 1 ... count, and begun anew after a drift of unknown direction, `shift` in truth."""
    places = np.array([[5.0, 5.0], [12.0, -4.0], [20.0, 6.0], [26.0, -7.0]])[:count]
    local = poles_at(places, drift)
    for number, (x, y) in enumerate(places + shift, start=count + 1):
        local.augment(number, Observation(PoleLandmark(), np.array([x, y, 0.5]), NOISE["pole"]))
    return local


def test_constellations_are_recognised_and_what_was_seen_side_by_side_is_never_one():
    assert duplicates(revisited((4.0, 3.0), 5.0, 1), 0.999, set()) == {}
    assert duplicates(revisited((4.0, 3.0), 5.0, 4), 0.999, set()) == {5: 1, 6: 2, 7: 3, 8: 4}
    local = revisited((0.1, 0.0), 0.2, 2)
    assert duplicates(local, 0.999, set()) == {3: 1, 4: 2}
    assert duplicates(local, 0.999, {(1, 3)}) == {4: 2}


# Planes and poles are recovered within their stated covariance: the chi-square test over many drives

DRIVES = 30
CONSISTENCY_Q = np.diag([0.003, 0.003, 0.004, 0.03, 0.02, 0.02]) ** 2  # of a motion: rad, m
R_PLANE, R_POLE = np.diag([0.01, 0.01, 0.05]) ** 2, np.diag([0.08, 0.05]) ** 2
POLE, PLANE = PoleLandmark(), PlaneLandmark()


def drawn(rng: np.random.Generator, covariance: FloatArray) -> FloatArray:
    return np.linalg.cholesky(covariance) @ rng.normal(size=len(covariance))


def drive(seed: int) -> tuple[dict[str, tuple[float, int]], float]:
    """Squared error and dimension of all landmarks of each kind together, and squared error of the last pose."""
    rng = np.random.default_rng(seed)
    poles = np.array([[5.0, 6.0], [14.0, -7.0], [22.0, 6.5]]) + rng.uniform(-1, 1, (3, 2))
    walls = np.array([[0, -1, 0.05, 12], [-1, 0.1, 0, 45]])
    planes = [gtsam.OrientedPlane3(wall / np.linalg.norm(wall[:3])) for wall in walls]
    pose = gtsam.Pose3(gtsam.Rot3.Yaw(rng.normal(0, 0.1)), np.array([0.0, 0.0, 1.5]))
    mapper = LandmarkMapper(pose.matrix(), 1e-8 * np.eye(6), MapperSettings(smooth_every=30))
    for _ in range(9):
        seen = []
        for x, y in poles:
            z = pose.transformTo(np.array([x, y, rng.uniform(0.5, 2.5)]))
            R = pose.rotation().matrix()
            level = R.T @ np.append((R @ np.append(drawn(rng, R_POLE), 0.0))[:2], 0.0)
            seen.append(Observation(POLE, z + level, R_POLE))
        for plane in planes:
            noisy = plane.transform(pose).retract(drawn(rng, R_PLANE))
            seen.append(Observation(PLANE, noisy.planeCoefficients(), R_PLANE))
        mapper.observe(seen)
        step = gtsam.Pose3(gtsam.Rot3.Yaw(0.01), np.array([1.5, 0.0, 0.0]))
        pose = pose.compose(step)
        mapper.move(step.retract(drawn(rng, CONSISTENCY_Q)).matrix(), CONSISTENCY_Q)
    mapper.smooth()
    truth = {"pole": list(poles), "plane": planes}
    found = {}
    for name, things in truth.items():
        numbers = sorted(n for n, kind in mapper.local.kinds.items() if kind.name == name)
        assert len(numbers) == len(things), f"{name}: {len(numbers)} landmarks of {len(things)}"
        variable = mapper.local.kinds[numbers[0]].variable
        errors = np.concatenate(
            [variable.local(mapper.local.state(n), t) for n, t in zip(numbers, things, strict=True)]
        )
        squared = float(errors @ np.linalg.solve(mapper.local.covariance(numbers), errors))
        found[name] = (squared, len(errors))
    error = mapper.local.pose.localCoordinates(pose)
    return found, float(error @ np.linalg.solve(mapper.local.covariance([0]), error))


@pytest.fixture(scope="module")
def drives() -> list[tuple[dict[str, tuple[float, int]], float]]:
    return [drive(seed) for seed in range(DRIVES)]


def test_squared_errors_of_landmarks_and_poses_lie_in_the_band(drives, subtests):
    for kind in ["pole", "plane"]:
        with subtests.test(kind=kind):
            squared = sum(found[kind][0] for found, _ in drives)
            dim = sum(found[kind][1] for found, _ in drives)
            low, high = chi2.ppf([0.0005, 0.9995], dim)
            assert low < squared < high, (
                f"{squared / dim:.2f} a dimension, expected {low / dim:.2f} to {high / dim:.2f}"
            )
    low, high = chi2.ppf([0.0005, 0.9995], 6 * len(drives))
    assert low < sum(pose for _, pose in drives) < high
