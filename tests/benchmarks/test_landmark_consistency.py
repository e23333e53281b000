"""Planes, poles and road lines are recovered within their stated covariance: the chi-square test over many drives.

With the model true, the squared error e^T P^-1 e of all landmarks of a kind together, at the end of a drive, has as
many degrees of freedom as they have dimensions; its sum over independent drives is tested on both sides.
"""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks.landmark_mapper import LandmarkMapper, MapperSettings
from saga_fg.model.landmarks import LineLandmark, PlaneLandmark, PoleLandmark
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.landmark import Observation

DRIVES = 30
Q = np.diag([0.003, 0.003, 0.004, 0.03, 0.02, 0.02]) ** 2  # of a motion: rad, m
R_PLANE, R_POLE = np.diag([0.01, 0.01, 0.05]) ** 2, np.diag([0.08, 0.05]) ** 2
R_EDGE = np.array([[0.0064, 0.002], [0.002, 0.01]])
# edges are rare: what is tested is the covariance, not who is taken for whom
POLE, LINE, PLANE = PoleLandmark(), LineLandmark(density=1e-3), PlaneLandmark()


def drawn(rng: np.random.Generator, covariance: FloatArray) -> FloatArray:
    return np.linalg.cholesky(covariance) @ rng.normal(size=len(covariance))


def drive(seed: int) -> tuple[dict[str, tuple[float, int]], float]:
    """Squared error and dimension of all landmarks of each kind together, and squared error of the last pose."""
    rng = np.random.default_rng(seed)
    poles = np.array([[5.0, 6.0], [14.0, -7.0], [22.0, 6.5]]) + rng.uniform(-1, 1, (3, 2))
    walls = np.array([[0, -1, 0.05, 12], [-1, 0.1, 0, 45]])
    planes = [gtsam.OrientedPlane3(wall / np.linalg.norm(wall[:3])) for wall in walls]
    lines = np.array([[np.pi / 2 + rng.normal(0, 0.05), 4.0], [-np.pi / 2 + rng.normal(0, 0.05), 3.5]])
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
        for theta, rho in lines:
            n, along = np.array([np.cos(theta), np.sin(theta)]), np.array([-np.sin(theta), np.cos(theta)])
            middle = float(along @ pose.translation()[:2])
            off = rho + drawn(rng, R_EDGE)
            at = middle + np.array([rng.uniform(-9, -4), rng.uniform(4, 9)])
            ends = np.column_stack([off[:, None] * n + at[:, None] * along, np.zeros(2)])
            seen.append(Observation(LINE, np.concatenate([pose.transformTo(end) for end in ends]), R_EDGE))
        mapper.observe(seen)
        step = gtsam.Pose3(gtsam.Rot3.Yaw(0.01), np.array([1.5, 0.0, 0.0]))
        pose = pose.compose(step)
        mapper.move(step.retract(drawn(rng, Q)).matrix(), Q)
    mapper.smooth()
    truth = {"pole": list(poles), "plane": planes, "road line": list(lines)}
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


def test_squared_errors_lie_in_the_band(
    drives: list[tuple[dict[str, tuple[float, int]], float]], subtests: pytest.Subtests
) -> None:
    for kind in ["pole", "plane", "road line"]:
        with subtests.test(kind=kind):
            squared = sum(found[kind][0] for found, _ in drives)
            dim = sum(found[kind][1] for found, _ in drives)
            low, high = chi2.ppf([0.0005, 0.9995], dim)
            assert low < squared < high, (
                f"{squared / dim:.2f} a dimension, expected {low / dim:.2f} to {high / dim:.2f}"
            )


def test_so_does_the_pose(drives: list[tuple[dict[str, tuple[float, int]], float]]) -> None:
    low, high = chi2.ppf([0.0005, 0.9995], 6 * len(drives))
    assert low < sum(pose for _, pose in drives) < high
