"""Detections made from recorded traffic: viewpoints, what hides what, seeds, and colours of lights."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.recordings.ngsim import ngsim_windows
from benchmarks.recordings.sensed import sensed_scene, true_scene
from benchmarks.recordings.sources import Ngsim
from benchmarks.recordings.traffic import RecordedTraffic
from data_tools.simulator.settings import SensorSettings, SimulatorSettings
from pipelines.config import load_config
from pipelines.tracking import track_scene
from saga_fg.errors import InputError
from saga_fg.types.dataset import Scene
from tests.benchmarks.recordings.ngsim_example import crossing, rows, write_ngsim

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


def test_from_above_everything_is_detected_where_it_is(traffic: RecordedTraffic) -> None:
    scene = sensed_scene(traffic, "above", perfect(), seed=0)
    assert visible(scene) == {"1": 1.0, "2": 1.0, "3": 1.0}
    np.testing.assert_allclose(scene.timestamps, 0.1 * np.arange(12), atol=1e-9)
    assert scene.ground_truth is not None
    for frame, truth in zip(scene.frames, scene.ground_truth, strict=True):
        found = frame.detections.boxes.position[np.char.find(frame.detections.boxes.label, "light") < 0]
        apart = np.hypot(*np.moveaxis(found[:, None, :2] - truth.boxes.position[None, :, :2], -1, 0))
        assert len(found) == len(truth) == (2 if frame.timestamp < 0.45 else 3)
        assert apart.min(axis=0).max() < 0.6


def test_a_vehicle_behind_another_is_hidden_from_the_road_and_not_from_a_mast(traffic: RecordedTraffic) -> None:
    low, high = (visible(sensed_scene(traffic, f"10,0,{height}", perfect(), 0)) for height in (1.0, 60.0))
    assert high == {"1": 1.0, "2": 1.0, "3": 1.0}
    assert low["2"] == 1.0  # stands before the truck
    assert low["1"] == 1.0  # in the other lane
    trailing = replace(
        traffic,
        vehicles=replace(
            traffic.vehicles,
            size=np.where(traffic.vehicles.size[:, :1] > 7, [[4.5, 1.8, 1.5]], traffic.vehicles.size),
        ),
    )
    assert visible(sensed_scene(trailing, "10,0,1", perfect(), 0))["3"] < 0.5


def test_the_vehicle_that_carries_the_sensors_is_not_an_object_and_the_scene_lasts_as_long(
    traffic: RecordedTraffic,
) -> None:
    scene = sensed_scene(traffic, "3", perfect(), seed=0)
    assert set(visible(scene)) == {"1", "2"}
    assert len(scene) == 7
    np.testing.assert_allclose(scene.world_T_ego[:, 0, 3], -30 + 0.5 * np.arange(5, 12))
    chosen = sensed_scene(traffic, "vehicle", perfect(), seed=0)
    assert len(chosen) == 12
    assert set(visible(chosen)) in ({"1", "3"}, {"2", "3"})


def test_ground_truth_alone_has_everybody_and_no_frames(traffic: RecordedTraffic) -> None:
    scene = true_scene(traffic)
    assert not scene.frames
    assert visible(scene) == {"1": 1.0, "2": 1.0, "3": 1.0}
    assert scene.ground_truth is not None
    assert [len(truth) for truth in scene.ground_truth] == [2] * 5 + [3] * 7


def test_colours_are_reported_at_first_and_when_they_change(traffic: RecordedTraffic) -> None:
    scene = sensed_scene(traffic, "mast", perfect(), seed=0)
    reports = {
        round(frame.timestamp, 1): label
        for frame in scene.frames
        for label in frame.detections.boxes.label.tolist()
        if label.startswith("traffic_light")
    }
    assert reports == {
        0.0: "traffic_light_red",
        0.3: "traffic_light_green",
    }
    assert all(frame.road_map is traffic.road_map for frame in scene.frames)


def test_a_vehicle_that_appears_inside_another_is_tracked_with_the_rest(tmp_path: Path) -> None:
    inside = [f"X,A,9,{k},car,-3.2,0.1,0,0,,4.5,1.8" for k in range(4, 12)]
    traffic = ngsim_windows(write_ngsim(tmp_path, rows() + inside, {"A": crossing()})).read("A")
    scene = sensed_scene(traffic, "mast", perfect(), seed=0)
    assert scene.ground_truth is not None
    assert len(scene.ground_truth[-1]) == 4
    tracks = track_scene(scene, load_config("traffic").new_tracker("saga")).tracks
    assert len(tracks) == 12
    assert all(np.isfinite(moment.boxes.position).all() for moment in tracks)


def test_viewpoints_that_are_none_are_errors(traffic: RecordedTraffic, subtests: pytest.Subtests) -> None:
    for viewpoint, message in [
        ("roof", r"--viewpoint: A: unknown viewpoint 'roof', expected one of: mast, above, vehicle, X,Y,Z, 1, 2, 3"),
        ("1,2", r"--viewpoint: expected X,Y,Z of finite numbers, m, Z not below 0, got '1,2'"),
        ("1,nan,2", r"--viewpoint: expected X,Y,Z"),
        ("1,1,-2", r"--viewpoint: expected X,Y,Z"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            sensed_scene(traffic, viewpoint, None, 0)


def test_a_source_opens_chosen_windows(tmp_path: Path) -> None:
    write_ngsim(tmp_path, rows() + rows("B"), {"A": crossing(), "B": crossing()})
    source = Ngsim(dataroot=str(tmp_path), scenes="B", road="map")
    with source.open(truth=True) as dataset, source.ground_truth() as true:
        assert dataset.scenes == true.scenes == ("B",)
        scene = dataset.scene("B")
        assert len(true.scene("B")) == len(scene)
    labels = np.concatenate([frame.detections.boxes.label for frame in scene.frames])
    assert not (np.char.find(labels, "light") >= 0).any()
    assert scene.frames[0].road_map is not None
    with (
        pytest.raises(InputError, match=r"--scenes: unknown scene 'C'"),
        Ngsim(dataroot=str(tmp_path), scenes="C").open(),
    ):
        pass
