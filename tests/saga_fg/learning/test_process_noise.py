"""Process noise from data: the likelihood is the textbook filter's, and its maximum is the truth."""

import numpy as np
import pytest

from saga_fg import ConstantVelocity, InputError, NodeType, SceneGraph
from saga_fg.estimators import Gaussian, kalman_predict, kalman_update
from saga_fg.learning import MeasuredTrajectory, fit_acceleration_noise
from saga_fg.learning.process_noise import log_likelihood
from saga_fg.model.discretisation import discretise


def drawn(rng, acceleration_noise, count=40, length=30, noise=0.2):
    """Objects that move as the model says, seen at irregular times with known noise."""
    car = NodeType("car", ConstantVelocity(acceleration_noise))
    objects = []
    for _ in range(count):
        x, time, times, seen = rng.normal(size=4) * 5, 0.0, [], []
        for _ in range(int(rng.integers(3, length))):
            dt = float(rng.uniform(0.05, 0.6))
            step = discretise(SceneGraph.of([0], car), dt)
            x = step.F_matrix @ x + np.linalg.cholesky(step.Q_matrix.toarray()) @ rng.normal(size=4)
            time += dt
            times.append(time)
            seen.append(x[:2] + noise * rng.normal(size=2))
        objects.append(MeasuredTrajectory(times, seen, np.tile(noise**2 * np.eye(2), (len(seen), 1, 1))))
    return objects


def by_the_book(objects, acceleration_noise, initial_speed_deviation):
    car, H, total = NodeType("car", ConstantVelocity(acceleration_noise)), np.eye(2, 4), 0.0
    for o in objects:
        P = np.diag([0.0, 0.0, initial_speed_deviation**2, initial_speed_deviation**2])
        P[:2, :2] = o.R[0]
        x = Gaussian(np.concatenate([o.position[0], [0, 0]]), P)
        for k in range(1, len(o)):
            step = discretise(SceneGraph.of([0], car), o.time[k] - o.time[k - 1])
            x = kalman_predict(x, step.F_matrix.toarray(), step.b, step.Q_matrix.toarray())
            x, log_density = kalman_update(x, o.position[k], H, o.R[k])
            total += log_density
    return total


def test_the_likelihood_is_that_of_one_textbook_filter_an_object():
    objects = drawn(np.random.default_rng(0), 1.5, count=8)
    assert log_likelihood(objects, 0.7, 4.0) == pytest.approx(by_the_book(objects, 0.7, 4.0), rel=1e-9)
    assert log_likelihood(objects[::-1], 0.7, 4.0) == pytest.approx(log_likelihood(objects, 0.7, 4.0), rel=1e-12)


@pytest.mark.parametrize("truth", [0.05, 8.0])
def test_the_noise_of_the_model_is_found_again(truth):
    fitted = fit_acceleration_noise(drawn(np.random.default_rng(1), truth), initial_speed_deviation=5.0)
    assert fitted == pytest.approx(truth, rel=0.3)


def test_objects_seen_too_seldom_tell_nothing():
    seldom = MeasuredTrajectory([0.0, 1.0], np.zeros((2, 2)), np.tile(np.eye(2), (2, 1, 1)))
    for objects in ([], [seldom]):
        with pytest.raises(InputError, match="objects: expected at least one object seen three times or more"):
            fit_acceleration_noise(objects)


def test_wrong_sightings_are_named(subtests):
    for columns, message in [
        (([0.0, 2.0, 1.0], np.zeros((3, 2)), np.ones((3, 2, 2))), r"time\[2\]: expected times that do not decrease"),
        (([0.0, np.nan], np.zeros((2, 2)), np.ones((2, 2, 2))), r"time\[1\]: expected a finite number"),
        (([0.0, 1.0], np.zeros((3, 2)), np.ones((2, 2, 2))), r"position: expected shape \(2, 2\)"),
        (([0.0, 1.0], np.zeros((2, 2)), np.ones((2, 2))), r"R: expected shape \(2, 2, 2\)"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            MeasuredTrajectory(*columns)


def test_a_long_trajectory_is_cut_into_pieces_of_about_one_length() -> None:
    one = MeasuredTrajectory(np.arange(25.0), np.zeros((25, 2)), np.tile(np.eye(2), (25, 1, 1)))
    pieces = one.pieces(10)
    assert [len(piece) for piece in pieces] == [9, 8, 8]
    assert np.concatenate([piece.time for piece in pieces]).tolist() == one.time.tolist()
