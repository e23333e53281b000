"""Recorded traffic as worlds of its own."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.crossings import simulated_crossings
from benchmarks.recordings.ngsim import ngsim_windows
from benchmarks.recordings.sources import Ngsim, sensed_scene, true_scene
from benchmarks.recordings.traffic import RecordedTraffic
from data_tools.simulator.settings import SensorSettings, SimulatorSettings
from pipelines.config import load_config
from pipelines.learning import scenes_to_learn_from
from saga_fg.errors import InputError
from saga_fg.types.dataset import Scene
from tests.benchmarks.recordings.ngsim_example import crossing, rows, write_ngsim
from tests.pipelines.command import done

PERFECT = SensorSettings(
    detection_probability=1.0, clutter_rate=0.0, reach=1000.0, max_range=500.0, size_noise=0.0, yaw_noise=0.0
)


@pytest.fixture
def traffic(tmp_path: Path) -> RecordedTraffic:
    return ngsim_windows(write_ngsim(tmp_path, rows(), {"A": crossing()})).read("A")


def perfect() -> SimulatorSettings:
    """A sensor that detects all that it sees, and truth of everything."""
    return SimulatorSettings(sensors={"lidar": PERFECT}, annotation_range=math.inf, memory=math.inf, shortest_view=0.0)


def visible(scene: Scene) -> dict[str, float]:
    """Share of the moments of each vehicle at which it is visible."""
    seen: dict[str, list[bool]] = {}
    for truth in scene.ground_truth or ():
        for name, is_visible in zip(truth.id.tolist(), truth.visible.tolist(), strict=True):
            seen.setdefault(name, []).append(is_visible)
    return {name: float(np.mean(values)) for name, values in seen.items()}


def test_from_above_everything_is_detected_where_it_is(traffic):
    scene = sensed_scene(traffic, "above", perfect(), seed=0)
    assert visible(scene) == {"1": 1.0, "2": 1.0, "3": 1.0}
    np.testing.assert_allclose(scene.timestamps, 0.1 * np.arange(12), atol=1e-9)
    assert scene.ground_truth is not None
    for frame, truth in zip(scene.frames, scene.ground_truth, strict=True):
        found = frame.detections.boxes.position[np.char.find(frame.detections.boxes.label, "light") < 0]
        apart = np.hypot(*np.moveaxis(found[:, None, :2] - truth.boxes.position[None, :, :2], -1, 0))
        assert len(found) == len(truth) == (2 if frame.timestamp < 0.45 else 3)
        assert apart.min(axis=0).max() < 0.6


def test_a_vehicle_behind_another_is_hidden_from_the_road_and_not_from_a_mast(traffic):
    low, high = (visible(sensed_scene(traffic, f"10,0,{height}", perfect(), 0)) for height in (1.0, 60.0))
    assert high == {"1": 1.0, "2": 1.0, "3": 1.0}
    assert low["2"] == 1.0  # stands before the truck
    assert low["1"] == 1.0  # in the other lane
    trailing = replace(
        traffic,
        vehicles=replace(
            traffic.vehicles, size=np.where(traffic.vehicles.size[:, :1] > 7, [[4.5, 1.8, 1.5]], traffic.vehicles.size)
        ),
    )
    assert visible(sensed_scene(trailing, "10,0,1", perfect(), 0))["3"] < 0.5


def test_the_vehicle_that_carries_the_sensors_is_not_an_object_and_the_scene_lasts_as_long(traffic):
    scene = sensed_scene(traffic, "3", perfect(), seed=0)
    assert set(visible(scene)) == {"1", "2"}
    assert len(scene) == 7
    np.testing.assert_allclose(scene.world_T_ego[:, 0, 3], -30 + 0.5 * np.arange(5, 12))
    chosen = sensed_scene(traffic, "vehicle", perfect(), seed=0)
    assert len(chosen) == 12
    assert set(visible(chosen)) in ({"1", "3"}, {"2", "3"})


def test_ground_truth_alone_has_everybody_and_no_frames(traffic):
    scene = true_scene(traffic)
    assert not scene.frames
    assert visible(scene) == {"1": 1.0, "2": 1.0, "3": 1.0}
    assert [len(truth) for truth in scene.ground_truth] == [2] * 5 + [3] * 7


def test_colours_are_reported_at_first_and_when_they_change(traffic):
    scene = sensed_scene(traffic, "mast", perfect(), seed=0)
    reports = {
        round(frame.timestamp, 1): label
        for frame in scene.frames
        for label in frame.detections.boxes.label.tolist()
        if label.startswith("traffic_light")
    }
    assert reports == {0.0: "traffic_light_red", 0.3: "traffic_light_green"}
    assert all(frame.road_map is traffic.road_map for frame in scene.frames)


def test_viewpoints_that_are_none_are_errors(traffic, subtests):
    for viewpoint, message in [
        ("roof", r"--viewpoint: A: unknown viewpoint 'roof', expected one of: mast, above, vehicle, X,Y,Z, 1, 2, 3"),
        ("1,2", r"--viewpoint: expected X,Y,Z of finite numbers, m, Z not below 0, got '1,2'"),
        ("1,nan,2", r"--viewpoint: expected X,Y,Z"),
        ("1,1,-2", r"--viewpoint: expected X,Y,Z"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            sensed_scene(traffic, viewpoint, None, 0)


def test_a_source_opens_chosen_windows(tmp_path):
    write_ngsim(tmp_path, rows() + rows("B"), {"A": crossing(), "B": crossing()})
    source = Ngsim(dataroot=str(tmp_path), scenes="B", road="map")
    with source.open(truth=True) as dataset:
        assert dataset.scenes == ("B",)
        scene, true = dataset.scene("B"), dataset.true_scene("B")
    assert (len(true), len(true.frames)) == (len(scene), 0)
    assert all(moment.visible.all() for moment in true.ground_truth)
    labels = np.concatenate([frame.detections.boxes.label for frame in scene.frames])
    assert not (np.char.find(labels, "light") >= 0).any()
    assert scene.frames[0].road_map is not None
    with (
        pytest.raises(InputError, match=r"--scenes: unknown scene 'C'"),
        Ngsim(dataroot=str(tmp_path), scenes="C").open(),
    ):
        pass


# Simulated crossings without signals


@pytest.mark.parametrize("row", range(3))
def test_nobody_collides_and_somebody_waits(row):
    recordings = simulated_crossings(3)
    assert len({name.rpartition("-")[0] for name in recordings.names}) == 3, "a scene of each rule"
    traffic = recordings.read(recordings.names[row])
    vehicles = traffic.vehicles
    assert np.allclose(np.diff(vehicles.time), 0.1)
    assert vehicles.time[0] == 0
    assert "traffic_cone" not in vehicles.label
    speed = np.hypot(*np.moveaxis(vehicles.velocity, -1, 0))
    pairs = vehicles.present[:, :, None] & vehicles.present[:, None] & ~np.eye(len(vehicles.id), dtype=bool)
    apart = np.linalg.norm(vehicles.position[:, :, None] - vehicles.position[:, None], axis=-1)
    assert apart[pairs].min() > 1.5
    slow = (speed < 2.0) & vehicles.present
    assert 0.01 < slow.sum() / vehicles.present.sum() < 0.7


# Recorded traffic through the command and the benchmarks, on a crossing written by hand

NGSIM = "benchmarks.recordings:Ngsim"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    (tmp_path / "ngsim").mkdir()
    write_ngsim(tmp_path / "ngsim", rows(steps=20), {"A": crossing()})
    return tmp_path


def test_track_and_evaluate(data):
    root, tracks = str(data / "ngsim"), str(data / "tracks.csv")
    run = done("track", NGSIM, "--dataroot", root, "--output", tracks)
    assert "1 scene, 20 frames" in run.output
    run = done("evaluate", NGSIM, tracks, "--dataroot", root)
    assert "MOTA" in run.output


def test_scenes_to_learn_from_have_the_carrier_as_well(data):
    source = Ngsim(dataroot=str(data / "ngsim"), viewpoint="1")
    scene = scenes_to_learn_from(source, load_config("traffic"), with_truth=True)["A"]
    ids = [name for moment in scene.ground_truth for name in moment.id.tolist()]
    assert [ids.count(name) for name in ("1", "2", "3")] == [20, 20, 15]
    assert [len(frame) for frame in scene.frames] == [len(moment) for moment in scene.ground_truth]
    assert {frame.sensor for frame in scene.frames} == {"lidar"}
