"""Sensors that mistake cars, trucks and buses for one another: confusion learned, tracks and labels with beliefs."""

from dataclasses import replace

import numpy as np
import pytest

from data_tools.metrics import SceneMetrics, scene_metrics
from data_tools.simulator import SimulatedTraffic, SimulatorSettings, simulate_scene
from pipelines.config import load_config
from pipelines.learning import learn_noise, learned_fragment
from pipelines.smoothing import smooth_scene
from pipelines.smoothing.passes import load_smooth_config
from pipelines.tracking import track_scene
from saga_fg.learning import learn_confusion
from saga_fg.types.boxes import Boxes
from saga_fg.types.frame import Detections

RIGHT = {"lidar": 0.9, "camera": 0.7}
VEHICLES = ("bus", "car", "truck")


def simulator(duration, right=RIGHT):
    plain = SimulatorSettings(duration=duration)
    return replace(plain, sensors={n: replace(plain.sensors[n], class_accuracy=share) for n, share in right.items()})


def believing(config):
    tables = {n: {c: {z: p if z == c else (1 - p) / 2 for z in VEHICLES} for c in VEHICLES} for n, p in RIGHT.items()}
    return replace(config, sensors={n: replace(config.sensors[n], confusion=table) for n, table in tables.items()})


def test_confusion_and_sizes_are_found_by_sensor(tmp_path):
    dataset = SimulatedTraffic(simulator(5.0), scenes=1, seed=702)
    learned = learn_noise(dataset, dataset.scenes, load_config("simulated"), True)
    path = tmp_path / "learned.yaml"
    path.write_text(learned_fragment(learned, "a test"))
    read = load_config("simulated", path)
    for name, share in RIGHT.items():
        row = read.sensors[name].confusion["car"]
        assert row["car"] / sum(row.values()) == pytest.approx(share, abs=0.06)
        assert row["bus"] / sum(row.values()) == pytest.approx((1 - share) / 2, abs=0.05)
    sizes = {c: read.tracker.classes[c].typical_size for c in VEHICLES}
    assert sizes["car"].length == pytest.approx(4.7, abs=0.5)
    assert sizes["bus"].length == pytest.approx(12.0, abs=1.0)
    assert "typical_size" not in path.read_text().split("pedestrian:")[-1].split("truck:")[0]


def test_detectors_with_an_output_for_each_class_confuse_nothing():
    scene = simulate_scene(simulator(2.0, {"lidar": 1.0}), seed=702)
    frames = []
    for frame in scene.frames:  # every third car or bus is reported as a truck in its place too
        boxes, score = frame.detections.boxes, frame.detections.score
        rows = np.flatnonzero(np.isin(boxes.label, ("car", "bus")))[::3]
        twins = replace(boxes.select(rows), label=np.full(len(rows), "truck"))
        both = Detections(Boxes.concatenate([boxes, twins]), np.concatenate([score, 0.9 * score[rows]]))
        frames.append(replace(frame, detections=both))
    sensors = load_config("simulated").sensors
    assert learn_confusion([scene], sensors) == {"lidar": {}}
    assert learn_confusion([replace(scene, frames=tuple(frames))], sensors) == {"lidar": {}}


def test_beliefs_leave_one_track_and_one_label_an_object():
    plain = load_config("simulated")
    scene = simulate_scene(simulator(4.0), seed=702)
    assert scene.ground_truth is not None
    runs = {}
    for name, config in (("plain", plain), ("believing", believing(plain))):
        tracks = track_scene(scene, config.new_tracker("saga")).tracks
        vehicles = {id_ for each in tracks for id_ in each.id[each.boxes.label != "pedestrian"].tolist()}
        runs[name] = SceneMetrics.pool([scene_metrics(scene.ground_truth, tracks)]).mota, len(vehicles)
    assert runs["believing"][0] > 0.85
    assert runs["plain"][0] < 0.3
    assert runs["believing"][1] < 0.6 * runs["plain"][1]
    settings = load_smooth_config("simulated")
    counts = {}
    for name, of in (("plain", settings), ("believing", replace(believing(settings), tracking=believing(plain)))):
        labels, wrong, found = smooth_scene(scene, of).labels, 0, 0
        for moment, truth in zip(labels, scene.ground_truth, strict=True):
            boxes, true = moment.tracks.boxes, truth.boxes
            apart = np.hypot(*np.moveaxis(boxes.position[:, None, :2] - true.position[:, :2], -1, 0))
            near = (apart < 1.0) & np.isin(true.label, VEHICLES)
            wrong += int((near & (boxes.label[:, None] != true.label)).sum())
            found += int(near.sum())
        counts[name] = wrong / found
    assert counts["plain"] > 0.2
    assert counts["believing"] < 0.05
