"""Probabilities of associations against all joint events, and pairs of tracks that exchange their objects."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from benchmarks.recording_sets import chosen_sets
from benchmarks.variants import contenders
from data_tools.metrics import scene_metrics
from pipelines.config import load_config
from pipelines.tracking import track_scene
from saga_fg.kernels.identities import association_marginals
from saga_fg.tracking.association import LARGEST_EXACT, SWEEPS
from saga_fg.tracking.encounters import Encounters
from saga_fg.tracking.track_filters import Kinematics
from saga_fg.tracking.update import doubted
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections, Frame


def enumerated(track, detection, log_weight):
    """Marginals (K,) by the sum over every joint event."""
    totals, weight = np.zeros(len(track)), np.exp(log_weight)

    def events(k, chosen, product):
        if k == len(track):
            totals[chosen] += product
            return product
        rest = events(k + 1, chosen, product)
        if not any(track[k] == track[j] or detection[k] == detection[j] for j in chosen):
            rest += events(k + 1, [*chosen, k], product * weight[k])
        return rest

    return totals / events(0, [], 1.0) if len(track) else totals


def random_problem(rng, least, most, density):
    """Candidates of tracks along a line, each with the detections near it."""
    n, m = rng.integers(least, most + 1, 2)
    there = rng.random((n, m)) < density
    i, j = there.nonzero()
    x, z = rng.uniform(0, 4, n), rng.uniform(0, 4, m)
    return i, j, 3.0 - 2 * (x[i] - z[j]) ** 2 + rng.normal(size=len(i))


def test_marginals_of_500_random_problems_against_all_joint_events():
    rng, apart = np.random.default_rng(0), []
    for _ in range(500):
        i, j, w = random_problem(rng, 1, 5, 0.55)
        expected = enumerated(i, j, w)
        np.testing.assert_allclose(association_marginals(i, j, w, LARGEST_EXACT, SWEEPS), expected, atol=1e-6)
        apart.append(np.abs(association_marginals(i, j, w, 0, SWEEPS) - expected).max(initial=0.0))
    print(f"loopy: largest difference, median {np.median(apart):.3f}, 95th percentile {np.quantile(apart, 0.95):.3f}")
    assert np.median(apart) <= 0.03


def test_marginals_of_large_clusters_by_belief_propagation():
    rng, apart = np.random.default_rng(1), []
    for _ in range(60):
        i, j, w = random_problem(rng, 9, 11, 0.4)
        exact, loopy = (association_marginals(i, j, w, largest, SWEEPS) for largest in (11, LARGEST_EXACT))
        apart.append(np.abs(exact - loopy).max())
        assert (np.bincount(i, loopy) <= 1 + 1e-9).all()
    assert 0 < np.median(apart) <= 0.03


@pytest.mark.parametrize("largest", [0, LARGEST_EXACT])
def test_marginals_where_weights_are_beyond_what_an_exponential_holds(largest):
    i, j = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
    p = association_marginals(i, j, np.array([900.0, 0.0, 0.0, -900.0]), largest, SWEEPS)
    np.testing.assert_allclose(p, [1, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(association_marginals(i[:0], j[:0], np.empty(0), largest, SWEEPS), [])


def test_a_doubted_measurement_moves_its_track_by_its_share():
    rng, w = np.random.default_rng(2), np.array([0.3])
    A, B = rng.normal(size=(2, 4, 4))
    R, P = (A @ A.T)[None], np.zeros((1, 4, 4))
    P[0, :2, :2], P[0, 2:, 2:] = (B @ B.T)[:2, :2], (B @ B.T)[2:, 2:]
    now = Kinematics(np.zeros((1, 2)), np.zeros((1, 2)), P[:, :2, :2], P[:, 2:, 2:])
    gain, usual = P @ np.linalg.inv(P + doubted(R, w, now)), P @ np.linalg.inv(P + R)
    np.testing.assert_allclose(gain, w * usual, atol=1e-12)


def log_likelihood(x, P, detections, noise, dt):
    """Of detections of one object, by a textbook filter."""
    F, G = np.eye(4) + dt * np.eye(4, k=2), np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
    total = 0.0
    for k, (z, R) in enumerate(detections):
        if k:
            x, P = F @ x, F @ P @ F.T + noise * G
        S = P[:2, :2] + R
        K = P[:, :2] @ np.linalg.inv(S)
        total += multivariate_normal(x[:2], S).logpdf(z)
        x, P = x + K @ (z - x[:2]), P - K @ P[:2]
    return total


@pytest.mark.parametrize("swapped", [False, True])
def test_what_follows_tells_whether_two_tracks_exchanged_their_objects(swapped):
    rng, noise, dt, R = np.random.default_rng(3), 0.3, 0.4, 0.01 * np.eye(2)
    A, B = np.array([0.0, 0.1, 1.3, 0.2]), np.array([0.1, -0.1, -1.3, 0.1])
    P = np.diag([0.02, 0.02, 0.2, 0.2])
    found = [[x[:2] + k * dt * x[2:] + 0.1 * rng.normal(size=2) for x in (A, B)] for k in range(5)]
    given = [pair[::-1] for pair in found] if swapped else found
    known = Encounters.empty().begun(np.array([[4, 7]]), np.array([[A, B]]), np.array([[P, P]]), 0.0)
    seen, both = np.ones((1, 2), dtype=bool), np.tile(R, (1, 2, 1, 1))
    for k, pair in enumerate(given):
        known = known.followed(np.array([noise]), np.array([dt if k else 0.0]), np.array([pair]), both, seen)
    a, b = ([(pair[i], R) for pair in given] for i in range(2))
    kept, exchanged = (
        log_likelihood(A, P, one, noise, dt) + log_likelihood(B, P, other, noise, dt) for one, other in ((a, b), (b, a))
    )
    np.testing.assert_allclose(known.log_odds, exchanged - kept, rtol=1e-9)
    assert known.exchanges(np.array([4, 7])) == ([(4, 7)] if swapped else [])
    assert known.exchanges(np.array([4])) == []
    assert [len(known.live(np.array(ids), 1.9)) for ids in ([4, 7], [4, 8])] == [swapped, 0]
    assert len(known.live(np.array([4, 7]), 2.1)) == len(known.without(2, 4)) == 0


def test_tracks_that_exchange_have_all_of_each_other_but_the_id():
    tracker = load_config("traffic", None).new_tracker("saga")
    for k in range(6):
        place = np.array([(k, 0.0, 0.9), (-k, 5.0, 0.9)])
        boxes = Boxes.of(["car", "pedestrian"], place, np.array([(4.5, 1.9, 1.5), (0.6, 0.6, 1.7)]))
        before = tracker.step(Frame(0.4 * k, "lidar", Detections(boxes, np.full(2, 0.99))))
    a, b = before.id.tolist()
    tracker._state.exchange(a, b)
    after = tracker.tracks(before.timestamp)
    assert (after.id.tolist(), after.boxes.label.tolist()) == ([a, b], ["pedestrian", "car"])
    for one, other in ((after.boxes.position, before.boxes.position), (after.boxes.velocity, before.boxes.velocity)):
        np.testing.assert_allclose(one, other[::-1], atol=1e-9)
    assert tracker.assignment.id.tolist() == [b, a]
    assert (tracker.step(Frame(2.4, "lidar", Detections(boxes, np.full(2, 0.99)))).id == [a, b]).all()


def test_fewer_identities_are_exchanged_in_a_crowd():
    (recordings,) = chosen_sets("crowds", None, 2, "crowd-1")
    found = contenders("traffic", load_config("traffic", None), "saga,hard association", ())
    runs = [track_scene(recordings.scene("crowd-1"), one.config.new_tracker(one.method)) for one in found]
    soft, hard = (scene_metrics(run.scene.ground_truth, run.tracks).switches for run in runs)
    assert soft < 0.8 * hard
