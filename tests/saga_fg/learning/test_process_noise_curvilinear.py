"""Curvilinear motion from data: the likelihood is the textbook filter's, and what is learned holds on other objects."""

from dataclasses import replace

import numpy as np
import pytest

from saga_fg import ConstantVelocity, Curvilinear, NodeType, SceneGraph
from saga_fg.estimators import Gaussian, kalman_predict, kalman_update
from saga_fg.learning import MeasuredTrajectory, fit_curvilinear, fit_curvilinear_by_class
from saga_fg.learning import process_noise as learning
from saga_fg.learning.process_noise import CurvilinearLikelihood
from saga_fg.model.discretisation import discretise
from saga_fg.model.turning import KnownCourses

DT, NOISE, YAW_NOISE = 0.1, 0.1, 0.01
TRUTH = Curvilinear(acceleration_noise=0.3, lateral_acceleration_noise=0.02, jerk_noise=0.5, fading_time=2.0)


def drawn(rng, motion, count, moments=60):
    """Vehicles that drive along the motion's own courses, straight on, seen with known noise."""
    car, objects = NodeType("car", motion), []
    for _ in range(count):
        heading = rng.uniform(-np.pi, np.pi)
        u = np.array([np.cos(heading), np.sin(heading)])
        x = np.concatenate([rng.normal(size=2), 25 * u, np.zeros(2)])
        seen = []
        for _ in range(moments):
            straight = np.array([heading]), np.zeros(1), np.zeros(1)
            record = KnownCourses.from_turn_rates(car, np.array([0]), *straight, x[None], DT)
            step = discretise(replace(SceneGraph.of([0], car), motions=(record,)), DT)
            x = step.F_matrix @ x + step.b + rng.multivariate_normal(np.zeros(6), step.Q_matrix.toarray())
            seen.append(x[:2] + NOISE * rng.normal(size=2))
        R = np.tile(NOISE**2 * np.eye(2), (moments, 1, 1))
        yaw = heading + YAW_NOISE * rng.normal(size=moments)
        objects.append(MeasuredTrajectory(DT * np.arange(moments), seen, R, yaw, np.full(moments, YAW_NOISE)))
    return objects


def test_without_headings_the_loss_is_that_of_one_textbook_filter_an_object(monkeypatch):
    """With ever more degrees of freedom Student's t is the normal distribution."""
    monkeypatch.setattr(learning, "TAILS", 1e9)
    rng, car, H = np.random.default_rng(0), NodeType("car", TRUTH), np.eye(2, 6)
    objects = [
        MeasuredTrajectory(
            np.cumsum(rng.uniform(0.05, 0.3, k)).round(3), rng.normal(size=(k, 2)), np.tile(np.eye(2), (k, 1, 1))
        )
        for k in (4, 6, 3)
    ]
    densities = []
    for one in objects:
        P = np.diag([1.0, 1.0, *[learning.INITIAL_SPEED_DEVIATION**2] * 2, 1.0, 1.0])
        x = Gaussian(np.concatenate([one.position[0], np.zeros(4)]), P)
        for k in range(1, len(one)):
            step = discretise(SceneGraph.of([0], car), one.time[k] - one.time[k - 1])
            x = kalman_predict(x, step.F_matrix.toarray(), step.b, step.Q_matrix.toarray())
            x, log_density = kalman_update(x, one.position[k], H, one.R[k])
            densities.append(log_density + np.log(2 * np.pi))
    assert CurvilinearLikelihood.from_trajectories(objects).loss(TRUTH) == pytest.approx(-np.mean(densities), rel=1e-6)


def test_what_is_learned_is_near_the_truth_and_better_on_other_objects(monkeypatch):
    monkeypatch.setattr(learning, "EVALUATIONS", 20)
    rng = np.random.default_rng(1)
    start = replace(TRUTH, acceleration_noise=3.0, jerk_noise=0.05)
    learned = fit_curvilinear(drawn(rng, TRUTH, 30, moments=40), start)
    others = CurvilinearLikelihood.from_trajectories(drawn(rng, TRUTH, 30, moments=40))
    assert others.loss(learned) < (others.loss(start) + others.loss(TRUTH)) / 2
    assert TRUTH.acceleration_noise / 2 < learned.acceleration_noise < start.acceleration_noise / 1.5


def test_too_few_objects_teach_nothing():
    objects = drawn(np.random.default_rng(2), TRUTH, 3, moments=20)
    assert fit_curvilinear(objects, TRUTH) == TRUTH
    assert fit_curvilinear([], TRUTH) == TRUTH


def test_only_classes_that_move_so_are_learned(monkeypatch):
    monkeypatch.setattr(learning, "EVALUATIONS", 10)
    start = replace(TRUTH, acceleration_noise=5.0)
    objects = {"car": drawn(np.random.default_rng(3), TRUTH, 24, moments=25)}
    learned = fit_curvilinear_by_class(objects, lambda _: start)
    assert list(learned) == ["default"], "one class needs no motion of its own"
    assert learned["default"].acceleration_noise < 5.0
    assert fit_curvilinear_by_class(objects, lambda _: ConstantVelocity()) == {}
