"""Labels of crowds: never worse than the detections they come from, nor than the online tracks; nobody is lost."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.nuscenes import NuScenes
from data_tools.evaluation import placed_detections
from data_tools.metrics import ErrorSample, LabelErrors, SceneBoxes, error_summary, label_errors
from pipelines.smoothing import SmoothConfig, load_smooth_config, smooth_scene
from pipelines.tracking import track_scene
from saga_fg import Boxes, Detections, Frame, Scene, Tracks
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.dataset import Annotations

SIZE = (0.7, 0.7, 1.7)
PEOPLE, STEPS, PERIOD = 40, 30, 0.5


def pedestrians(position: FloatArray, velocity: FloatArray | None = None) -> Boxes:
    n = len(position)
    world = np.column_stack([position, np.zeros(n)])
    return Boxes.of(["pedestrian"] * n, world, [SIZE] * n, np.zeros(n), velocity)


def crowd(seed: int) -> Scene:
    """People who walk, stand, start and stop on a square, seen at 2 Hz by a detector.

    It is sure of few of them, misses some at times, sees some twice, and some where nobody is.
    """
    rng = np.random.default_rng(seed)
    position = rng.uniform(-14, 14, (PEOPLE, 2))
    wish = rng.normal(0, 1.0, (PEOPLE, 2)) * (rng.random((PEOPLE, 1)) < 0.7)
    velocity = wish.copy()
    certainty = rng.uniform(0.1, 0.55, PEOPLE)
    frames, truth = [], []
    times = PERIOD * np.arange(STEPS)
    for k, time in enumerate(times.tolist()):
        stops = rng.random(PEOPLE) < 0.05
        wish[stops] = rng.normal(0, 1.0, (int(stops.sum()), 2)) * (rng.random((int(stops.sum()), 1)) < 0.5)
        velocity += 0.6 * (wish - velocity) + rng.normal(0, 0.1, velocity.shape)
        position = position + PERIOD * velocity
        boxes = pedestrians(position, velocity)
        truth.append(Annotations(np.arange(PEOPLE).astype(str), boxes, np.ones(PEOPLE, dtype=bool)))
        seen = np.flatnonzero(rng.random(PEOPLE) < 0.85)
        twice = seen[rng.random(len(seen)) < 0.08]
        places = [
            position[seen] + rng.normal(0, 0.12, (len(seen), 2)),
            position[twice] + rng.normal(0, 0.6, (len(twice), 2)),
            rng.uniform(-16, 16, (4, 2)),
        ]
        score = [certainty[seen] + rng.uniform(-0.05, 0.05, len(seen)), 0.6 * certainty[twice], np.full(4, 0.1)]
        found = Detections(pedestrians(np.concatenate(places)), np.concatenate(score))
        frames.append(Frame(time, "lidar", found, np.eye(4), token=str(k)))
    poses = np.tile(np.eye(4), (STEPS, 1, 1))
    return Scene("crowd", times, poses, tuple(map(str, range(STEPS))), frames, truth)


def errors(scene: Scene, tracks: tuple[Tracks, ...], label: str = "pedestrian") -> LabelErrors:
    """Errors at the labels of a class that a detection matches."""
    assert scene.ground_truth is not None
    truth = SceneBoxes.of_annotations(scene.ground_truth, hidden=False)
    truth = truth.select(np.flatnonzero(truth.boxes.label == label))
    return label_errors(truth, SceneBoxes.of_tracks(tracks), truth.boxes.velocity, placed_detections(scene))


def of_both(scene: Scene, config: SmoothConfig) -> tuple[LabelErrors, LabelErrors]:
    """Errors of the online tracks and of the labels."""
    online = track_scene(scene, config.tracking.new_tracker("saga")).tracks
    return errors(scene, tuple(online)), errors(scene, smooth_scene(scene, config).tracks)


@pytest.fixture(scope="module")
def crowds() -> tuple[LabelErrors, LabelErrors]:
    config = load_smooth_config("nuscenes")
    online, labels = zip(*(of_both(crowd(seed), config) for seed in range(3)), strict=True)
    return LabelErrors.pool(online), LabelErrors.pool(labels)


def test_labels_of_a_crowd_are_better_than_its_detections_and_than_online_tracks(
    crowds: tuple[LabelErrors, LabelErrors],
) -> None:
    online, labels = map(error_summary, crowds)
    assert labels.tracked > 0.98 * labels.labels
    assert labels.position < labels.detection
    assert labels.position < online.position
    assert labels.velocity < online.velocity


def test_covariances_hold_in_a_crowd(crowds: tuple[LabelErrors, LabelErrors]) -> None:
    nees = ErrorSample.known(crowds[1].nees).values / 2
    assert 0.4 < np.median(nees) / np.log(2) < 1.6
    assert np.mean(nees) < 3.0


def test_weak_objects_are_kept_at_the_end_of_the_ranking() -> None:
    times = PERIOD * np.arange(12)
    frames = []
    for k, time in enumerate(times.tolist()):
        boxes = pedestrians(np.array([[0.5 * k, 0.0], [0.5 * k, 1.5]]))
        frames.append(Frame(time, "lidar", Detections(boxes, np.array([0.6, 0.1])), np.eye(4)))
    scene = Scene("pair", times, np.tile(np.eye(4), (12, 1, 1)), ("",) * 12, frames)
    labels = smooth_scene(scene, load_smooth_config("nuscenes")).tracks
    assert [len(moment) for moment in labels] == [2] * 12
    assert {round(float(score), 9) for moment in labels for score in moment.score} == {
        round(0.6 * 12 / (12 + 2 * 11 / 11), 9),
        round(0.1 * 12 / (12 + 2 * 11 / 11), 9),
    }


def approaching(first: float, config: SmoothConfig, with_pose: bool = True) -> list[int]:
    """Number of labels at each moment of a parked car that a vehicle at 10 m/s detects from the second 2 on, when it is
    `first` m ahead; scores are logits, as KITTI's."""
    times = 0.1 * np.arange(50)
    poses = np.tile(np.eye(4), (50, 1, 1))
    poses[:, 0, 3] = 10 * times
    car = Boxes.of(["car"], [(first + 20.0, 2.0, 0.8)], [(4.2, 1.8, 1.6)], [0.0])
    nothing = car.select(np.empty(0, dtype=np.int64))
    frames = []
    for k, time in enumerate(times.tolist()):
        seen = Detections(car, np.array([5.0])) if k >= 20 else Detections(nothing, np.empty(0))
        frames.append(Frame(time, "lidar", seen, poses[k] if with_pose else None))
    scene = Scene("road", times, poses, ("",) * 50, frames)
    return [len(moment) for moment in smooth_scene(scene, config).tracks]


def test_an_object_from_far_away_reaches_back(subtests: pytest.Subtests) -> None:
    for first, with_pose, begins in [(60.0, True, 10), (20.0, True, 20), (60.0, False, 20)]:
        with subtests.test(first=first, with_pose=with_pose, begins=begins):
            config = load_smooth_config("kitti")
            smoothing = replace(config.smoothing, backward_time=1.0, backward_distance=50.0)
            there = approaching(first, replace(config, smoothing=smoothing), with_pose)
            assert there == [0] * begins + [1] * (50 - begins)


def test_labels_of_a_recorded_crowd_are_better_than_its_detections(recordings: Path) -> None:
    root = recordings / "nuscenes"
    found = {"lidar": root / "detections" / "megvii_lidar.json"}
    scene = NuScenes(root, "v1.0-mini", found, ["scene-0103"], ground_truth=True).scene("scene-0103")
    labels = smooth_scene(scene, load_smooth_config("nuscenes")).tracks
    for label in ("pedestrian", "car", "bicycle"):
        f = error_summary(errors(scene, labels, label))
        assert f.position < f.detection, label
