"""Scenes that are simulated, chosen and judged."""

import csv
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from data_tools.datasets.detection_files import read_detections
from data_tools.simulator import SimulatedTraffic, simulate_scene
from data_tools.simulator.settings import scenario_settings
from pipelines.config import TrackConfig, load_config
from pipelines.learning.interactions import hidden
from pipelines.tracking import track_dataset, track_scene
from saga_fg import Boxes, Detections, Frame, Scene, Tracks
from saga_fg.learning.labelled_scene import FOLLOWED, LENGTHS, SPACING, LabelledScene, made_gaps
from tests.pipelines.command import done
from tests.pipelines.sampled_gaps import SHORT


def run(*arguments):
    result = done(*arguments)
    return result.output


def test_a_red_light_scene_goes_to_files_and_back(tmp_path):
    short = tmp_path / "short.yaml"
    short.write_text("duration: 1.5\nwarm_up: 4.0\n")
    out = tmp_path / "junctions"
    assert "1 scene of 1.5 s" in run("simulate", "-o", out, "--scenario", "red-light", "--scenes", 1, "--config", short)
    folder = out / "scene-0001"
    settings = replace(scenario_settings("red-light"), duration=1.5, warm_up=4.0)
    scene = SimulatedTraffic(settings, 1, 0).scene("scene-0001")
    read = read_detections(folder / "detections.csv").scene("scene-0001")
    assert [(frame.timestamp, frame.sensor) for frame in read.frames] == [(f.timestamp, f.sensor) for f in scene.frames]
    for got, made in zip(read.frames, scene.frames, strict=True):
        assert got.detections.boxes.label.tolist() == made.detections.boxes.label.tolist()
        for name in ("position", "size", "yaw", "velocity"):
            assert np.array_equal(
                getattr(got.detections.boxes, name), getattr(made.detections.boxes, name), equal_nan=True
            )
        assert np.allclose(got.world_T_ego, made.world_T_ego)
    assert any(label.startswith("traffic_light") for f in read.frames for label in f.detections.boxes.label.tolist())
    with (folder / "truth.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == sum(len(moment) for moment in scene.ground_truth)
    assert sum(int(row["visible"]) for row in rows) == sum(int(moment.visible.sum()) for moment in scene.ground_truth)

    written = load_config("file", folder / "settings.yaml")
    assert written.tracker.road_map == scene.frames[0].road_map
    assert written.tracker.edges == load_config("heterogeneous").tracker.edges
    tracks = tmp_path / "tracks.csv"
    run("track", "file", folder / "detections.csv", "--config", folder / "settings.yaml", "--output", tracks)
    assert len(tracks.read_text().splitlines()) > 10


# Tracking of a recorded scene: causal, at the right times, for any clocks of the sensors


class Recorder:
    """A tracker that notes what it is asked; the id of its one track is the number of frames it has seen."""

    def __init__(self) -> None:
        self.seen: list[float] = []
        self.predicted: list[float] = []
        self.sensor_times: dict[str, Any] = {}
        self.sensor_noise: dict[str, Any] = {}

    def step(self, frame: Frame) -> Tracks:
        self.seen.append(frame.timestamp)
        return self._tracks(frame.timestamp)

    def tracks(self, timestamp: float) -> Tracks:
        self.predicted.append(timestamp)
        return self._tracks(timestamp)

    def _tracks(self, timestamp: float) -> Tracks:
        boxes = Boxes.of(["car"], [[0.0, 0.0, 0.0]])
        one = np.ones((1, 2, 2))
        return Tracks(timestamp, np.array([len(self.seen)]), boxes, np.ones(1), one, one, np.zeros(1))


def scene(moments: Sequence[float], frames: Sequence[float], name: str = "a") -> Scene:
    return Scene(
        name,
        np.array(moments),
        np.tile(np.eye(4), (len(moments), 1, 1)),
        ("",) * len(moments),
        [Frame(t, "lidar", Detections.empty()) for t in sorted(frames)],
    )


times = st.integers(0, 40).map(lambda k: k / 4)


@given(st.lists(times, unique=True).map(sorted), st.lists(times))
def test_tracks_at_a_moment_rest_on_the_frames_up_to_it_and_no_others(moments, frames):
    tracker = Recorder()
    run = track_scene(scene(moments, frames), tracker)
    assert [tracks.timestamp for tracks in run.tracks] == moments
    assert [int(tracks.id[0]) for tracks in run.tracks] == [sum(f <= t for f in frames) for t in moments]
    assert tracker.predicted == [t for t in moments if t not in frames]
    assert run.frames == len(tracker.seen)


def test_every_scene_gets_a_fresh_tracker_and_counts_its_frames():
    calls: list[tuple[str, int, int]] = []
    track_scene(scene([0.0, 1.0], [0.0, 0.5, 1.0]), Recorder(), lambda *call: calls.append(call))
    assert calls == [("a", 1, 3), ("a", 2, 3), ("a", 3, 3)]
    runs = track_dataset(TwoScenes(), Recorder)
    assert [(run.scene.name, int(run.tracks[0].id[0])) for run in runs] == [("a", 1), ("b", 1)]
    assert [run.scene.name for run in track_dataset(TwoScenes(), Recorder, ["b"])] == ["b"]


class TwoScenes:
    scenes = ("a", "b")

    def scene(self, name: str) -> Scene:
        return scene([0.0], [0.0], name)


def test_kf_is_the_tracker_without_edges():
    config = TrackConfig()
    assert config.new_tracker("saga").settings.edges  # type: ignore[attr-defined]
    assert config.new_tracker("kf").settings.edges == ()  # type: ignore[attr-defined]


# Made gaps hide one object among others


def test_made_gaps_hide_one_object_among_others():
    config = load_config("simulated")
    traffic = LabelledScene.from_scene(simulate_scene(SHORT, seed=4), config.sensors)
    gaps = made_gaps(traffic, passes=2, seed=0)
    assert gaps == made_gaps(traffic, passes=2, seed=0)
    assert {gap.run for gap in gaps} == {1, 2}
    assert {gap.length for gap in gaps} <= set(LENGTHS)
    still = made_gaps(traffic, passes=2, seed=0, chosen=lambda gap: not gap.moving)
    assert not any(gap.moving for gap in still)
    time = traffic.scene.timestamps
    for gap in gaps:
        assert time[gap.stop - 1] - time[gap.start] == pytest.approx(gap.length, abs=0.06)
        assert traffic.detected[[gap.start, gap.stop], gap.row].all()
        assert time[gap.start] >= FOLLOWED - 0.1
    first = [gap for gap in gaps if gap.run == 1]
    for a in first:
        for b in first:
            together = range(max(a.start, b.start), min(a.stop, b.stop) + 1)
            if a is not b and together:
                assert a.row != b.row
                apart = traffic.position[together[0], a.row] - traffic.position[together[0], b.row]
                assert np.hypot(*apart) >= SPACING
    frames = hidden(traffic, first)
    assert len(frames) == len(traffic.scene.frames)
    without_them = LabelledScene.from_scene(replace(traffic.scene, frames=frames), config.sensors)
    for gap in first:
        inside = slice(gap.start + 1, gap.stop)
        assert not without_them.detected[inside, gap.row].any()
        assert without_them.detected[[gap.start, gap.stop], gap.row].all()
    mine = [gap.row for gap in first]
    others = np.delete(traffic.detected, mine, axis=1)
    assert (np.delete(without_them.detected, mine, axis=1) == others).all()
