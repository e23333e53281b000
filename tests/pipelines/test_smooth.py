"""Labels: the command, scenes, recordings, crowds. `saga-fg smooth`, as a user calls it."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.detection_files import read_tracks
from data_tools.datasets.kitti import KittiTracking
from data_tools.datasets.nuscenes import NuScenes, write_nuscenes
from data_tools.metrics import (
    ErrorSample,
    LabelErrors,
    SceneBoxes,
    error_summary,
    label_errors,
    match_scene,
    placed_detections,
)
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.config import Family
from pipelines.configuration import read_settings, write_settings
from pipelines.smoothing import SmoothConfig, SmoothedScene, load_smooth_config, smooth_scene
from pipelines.tracking import track_scene
from saga_fg import Boxes, Detections, Frame, Scene, Tracks
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.dataset import Annotations, Dataset
from tests.pipelines.command import done, refused


def test_shipped_settings_survive_the_round_trip():
    families: tuple[Family, ...] = ("nuscenes", "kitti", "simulated", "traffic", "file")
    for family in families:
        config = load_smooth_config(family)
        assert read_settings(SmoothConfig, write_settings(config)) == config


def test_nuscenes_labels_are_complete(tmp_path):
    traffic = SimulatedTraffic(SimulatorSettings(duration=5.0), scenes=1, seed=3)
    write_nuscenes(tmp_path / "data", traffic, traffic.mounts)
    detections = tmp_path / "data" / "detections" / "lidar.json"
    arguments = ["smooth", "nuscenes", "--dataroot", str(tmp_path / "data"), "--split", "all"]
    run = done(*arguments, "--detections", f"lidar={detections}", "-o", tmp_path / "labels")
    assert "observed" in run.output
    written = {path.name for path in (tmp_path / "labels").iterdir()}
    assert written == {"labels.csv", "review.csv", "run.json", "summary.json", "tracking.json", "v1.0-mini", "maps"}
    rows = read_tracks(tmp_path / "labels" / "labels.csv", labels=True)
    summary = json.loads((tmp_path / "labels" / "summary.json").read_text())["total"]
    assert len(rows.source) == summary["observed"] + summary["filled"] + summary["extended"] > 0
    annotations = json.loads((tmp_path / "labels" / "v1.0-mini" / "sample_annotation.json").read_text())
    assert len(annotations) == len(rows.source)
    assert ((rows.probability >= 0) & (rows.probability <= 1)).all()
    with (tmp_path / "labels" / "review.csv").open() as file:
        review = list(csv.DictReader(file))
    gains = [float(row["gain"]) for row in review]
    assert {row["id"] for row in review} <= set(rows.id.tolist())
    last = run.stdout.splitlines()[-1]
    assert str(tmp_path / "labels" / "review.csv") in last
    assert f" {len(review)} object" in last
    assert gains == sorted(gains, reverse=True)


def test_an_output_that_cannot_be_written_is_found_before_the_work(tmp_path):
    assert "does not exist" in refused("smooth", "simulated", "-o", tmp_path / "missing" / "labels")


def test_labels_of_a_table_are_judged_by_a_table_of_truth(tmp_path):
    table, truth, figures = (tmp_path / name for name in ("detections.csv", "truth.csv", "figures.json"))
    boxes = [f"{0.1 * k:.1f},{k}.0,0.0,4.5,1.9,1.6,0.0,car" for k in range(15)]
    columns = "timestamp,x,y,length,width,height,yaw,label"
    table.write_text(f"{columns},score\n" + "".join(f"{row},0.9\n" for row in boxes))
    truth.write_text(f"{columns},id\n" + "".join(f"{row},a\n" for row in boxes))
    done("smooth", "file", table, "-o", tmp_path / "labels")
    labels = ["evaluate", "labels", "file", tmp_path / "labels", "--detections", table]
    assert "expected ground truth, there is none; name it: --truth TABLE" in refused(*labels)
    done(*labels, "--truth", truth, "--json", figures)
    assert json.loads(figures.read_text())["labels"]["tracking"]["overall"]["recall"] == 1.0
    labels[3] = tmp_path / "nothing"
    assert "expected a folder that `saga-fg smooth` wrote" in refused(*labels, "--truth", truth)


# Smoothing a simulated recording from end to end


@pytest.fixture(scope="module")
def smoothed() -> SmoothedScene:
    dataset = SimulatedTraffic(replace(SimulatorSettings(), duration=6.0), scenes=1, seed=5)
    return smooth_scene(dataset.scene("scene-0001"), load_smooth_config("simulated"))


def test_labels_fit_the_scene_and_are_counted(smoothed):
    assert len(smoothed.labels) == len(next(iter(smoothed.parts))[0])
    sources = np.concatenate([moment.source for moment in smoothed.labels])
    counts = smoothed.counts
    assert (counts.observed, counts.filled, counts.extended) == tuple(
        int((sources == name).sum()) for name in ("observed", "filled", "extended")
    )
    assert counts.boxes == sum(map(len, smoothed.labels)) > 0
    assert counts.filled > 0


def test_an_object_keeps_size_class_and_score_and_has_no_holes(smoothed):
    seen: dict[int, list[int]] = {}
    first: dict[int, tuple[str, list[float], float]] = {}
    for k, tracks in enumerate(smoothed.tracks):
        for i, id_ in enumerate(tracks.id.tolist()):
            seen.setdefault(id_, []).append(k)
            now = str(tracks.boxes.label[i]), tracks.boxes.size[i].tolist(), float(tracks.score[i])
            assert first.setdefault(id_, now) == now
    assert all(np.diff(moments).max(initial=1) == 1 for moments in seen.values())


def test_smoothed_positions_and_headings_are_better_than_online_ones(smoothed):
    ((scene, _),) = smoothed.parts
    online = track_scene(scene, load_smooth_config("simulated").tracking.new_tracker("saga")).tracks
    errors: list[list[float]] = []
    runs = [(moments, match_scene(scene.ground_truth, moments)) for moments in (online, smoothed.tracks)]
    for k, truth in enumerate(scene.ground_truth):
        rows = [dict(zip(m[k].object_row.tolist(), m[k].track_row.tolist(), strict=True)) for _, m in runs]
        for i in np.flatnonzero(truth.visible).tolist():
            if i in rows[0] and i in rows[1]:
                boxes = [moments[k].boxes.position[row[i], :2] for (moments, _), row in zip(runs, rows, strict=True)]
                errors.append([float(np.hypot(*(box - truth.boxes.position[i, :2]))) for box in boxes])
    online_rmse, smoothed_rmse = np.sqrt(np.mean(np.square(errors), axis=0))
    assert smoothed_rmse < 0.85 * online_rmse


def frame_at(time: float, x: list[float]) -> Frame:
    """Points without size and heading, seen from nobody knows where."""
    position = np.column_stack([x, np.zeros(len(x)), np.zeros(len(x))])
    return Frame(time, "radar", Detections(Boxes.of(["object"] * len(x), position), np.full(len(x), 0.9)))


def scene_of(frames: list[Frame], times: list[float]) -> Scene:
    return Scene("drive", np.array(times), np.tile(np.eye(4), (len(times), 1, 1)), ("",) * len(times), frames)


@pytest.mark.parametrize("frames", [[], [frame_at(0.0, []), frame_at(1.0, [])]])
def test_where_nothing_was_seen_there_are_no_labels(frames):
    smoothed = smooth_scene(scene_of(frames, [0.0, 0.5, 1.0]), load_smooth_config("file"))
    assert [len(moment) for moment in smoothed.labels] == [0, 0, 0]
    assert smoothed.counts.boxes == 0


def test_sizes_that_nobody_measured_stay_unknown_and_moments_between_frames_are_filled():
    times = [0.1 * k for k in range(12)]
    scene = scene_of([frame_at(time, [0.2 * k]) for k, time in enumerate(times)], times)
    smoothed = smooth_scene(scene, load_smooth_config("file"))
    assert [len(moment) for moment in smoothed.labels] == [1] * 12
    assert all(np.isnan(moment.tracks.boxes.size).all() for moment in smoothed.labels)
    frames = [frame_at(0.1 * k, [0.5 * k]) for k in range(10)]
    smoothed = smooth_scene(scene_of(frames, [-1.0, 0.25, 0.55, 5.0]), load_smooth_config("file"))
    assert [len(moment) for moment in smoothed.labels] == [0, 1, 1, 0]
    assert smoothed.tracks[1].boxes.position[0, 0] == pytest.approx(1.25, abs=0.1)


# Labels of recordings are nearer to the truth than the online tracks, in every class, on the boxes that both have

SCENES = {"nuscenes": ("scene-0061", "scene-0553"), "kitti": ("0000", "0017")}
FEWEST = 30  # boxes of a class that is compared


def dataset_of(family: str, recordings: Path) -> Dataset:
    root = recordings / family
    if family == "kitti":
        return KittiTracking(root, root / "detections" / "pointrcnn", SCENES[family], ground_truth=True)
    found = {"lidar": root / "detections" / "megvii_lidar.json"}
    return NuScenes(root, "v1.0-mini", found, SCENES[family], ground_truth=True)


@pytest.mark.parametrize("family", list(SCENES))
def test_labels_are_nearer_than_online_tracks_in_every_class(recordings, family):
    dataset, config = dataset_of(family, recordings), load_smooth_config(family)
    pairs = [of_both(dataset.scene(name), config, None) for name in dataset.scenes]
    online, labels = (LabelErrors.pool(parts) for parts in zip(*pairs, strict=True))
    both = online.tracked & labels.tracked & labels.matched
    names, count = np.unique(labels.label[both], return_counts=True)
    classes = names[count >= FEWEST].tolist()
    assert len(classes) >= 3
    for label in classes:
        of_class = both & (labels.label == label)
        assert labels.sample("position", of_class).rmse < online.sample("position", of_class).rmse, label


# Labels of crowds: never worse than the detections they come from, nor than the online tracks; nobody is lost

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


def errors(scene: Scene, tracks: tuple[Tracks, ...], label: str | None = "pedestrian") -> LabelErrors:
    """Errors at the labels of a class, None: of all, that a detection matches."""
    assert scene.ground_truth is not None
    truth = SceneBoxes.of_annotations(scene.ground_truth, hidden=False)
    truth = truth.select(np.flatnonzero((truth.boxes.label == label) | (label is None)))
    return label_errors(truth, SceneBoxes.of_tracks(tracks), truth.boxes.velocity, placed_detections(scene))


def of_both(scene: Scene, config: SmoothConfig, label: str | None = "pedestrian") -> tuple[LabelErrors, LabelErrors]:
    """Errors of the online tracks and of the labels."""
    online = track_scene(scene, config.tracking.new_tracker("saga")).tracks
    return errors(scene, tuple(online), label), errors(scene, smooth_scene(scene, config).tracks, label)


@pytest.fixture(scope="module")
def crowds() -> tuple[LabelErrors, LabelErrors]:
    config = load_smooth_config("nuscenes")
    online, labels = zip(*(of_both(crowd(seed), config) for seed in range(2)), strict=True)
    return LabelErrors.pool(online), LabelErrors.pool(labels)


def test_labels_of_a_crowd_are_better_and_their_covariances_hold(crowds):
    online, labels = map(error_summary, crowds)
    assert labels.tracked > 0.98 * labels.labels
    assert labels.position < labels.detection
    assert labels.position < online.position
    assert labels.velocity < online.velocity
    nees = ErrorSample.known(crowds[1].nees).values / 2
    assert 0.4 < np.median(nees) / np.log(2) < 1.6
    assert np.mean(nees) < 3.0


def test_weak_objects_are_kept_at_the_end_of_the_ranking():
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


def test_an_object_from_far_away_reaches_back(subtests):
    for first, with_pose, begins in [(60.0, True, 10), (20.0, True, 20), (60.0, False, 20)]:
        with subtests.test(first=first, with_pose=with_pose, begins=begins):
            config = load_smooth_config("kitti")
            smoothing = replace(config.smoothing, backward_time=1.0, backward_distance=50.0)
            there = approaching(first, replace(config, smoothing=smoothing), with_pose)
            assert there == [0] * begins + [1] * (50 - begins)
