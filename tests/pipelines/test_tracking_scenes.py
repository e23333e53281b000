"""Tracking of a recorded scene: causal, at the right times, for any clocks of the sensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.config import TrackConfig
from pipelines.tracking import track_dataset, track_scene
from saga_fg import Detections, Frame, Scene, Tracks
from saga_fg.types.boxes import Boxes


class Recorder:
    """A tracker that notes what it is asked; the id of its one track is the number of frames it has seen."""

    def __init__(self) -> None:
        self.seen: list[float] = []
        self.predicted: list[float] = []
        self.sensor_times: dict[str, Any] = {}

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
def test_tracks_at_a_moment_rest_on_the_frames_up_to_it_and_no_others(
    moments: list[float], frames: list[float]
) -> None:
    tracker = Recorder()
    run = track_scene(scene(moments, frames), tracker)
    assert [tracks.timestamp for tracks in run.tracks] == moments
    assert [int(tracks.id[0]) for tracks in run.tracks] == [sum(f <= t for f in frames) for t in moments]
    assert tracker.predicted == [t for t in moments if t not in frames]
    assert run.frames == len(tracker.seen)


def test_progress_counts_the_frames_of_the_scene() -> None:
    calls: list[tuple[str, int, int]] = []
    track_scene(scene([0.0, 1.0], [0.0, 0.5, 1.0]), Recorder(), lambda *call: calls.append(call))
    assert calls == [("a", 1, 3), ("a", 2, 3), ("a", 3, 3)]


class TwoScenes:
    scenes = ("a", "b")

    def scene(self, name: str) -> Scene:
        return scene([0.0], [0.0], name)


def test_every_scene_gets_a_fresh_tracker_and_is_read_when_its_turn_comes() -> None:
    runs = track_dataset(TwoScenes(), Recorder)
    assert [(run.scene.name, int(run.tracks[0].id[0])) for run in runs] == [("a", 1), ("b", 1)]
    assert [run.scene.name for run in track_dataset(TwoScenes(), Recorder, ["b"])] == ["b"]


@pytest.mark.parametrize("method", ["saga", "kf", "centerpoint"])
def test_every_method_tracks_a_car_through_a_scene(method: str) -> None:
    """10 m/s along x, seen ten times a second by one sensor, tracks wanted in between and afterwards."""
    steps = np.arange(20) / 10
    frames = [
        Frame(t, "lidar", Detections(Boxes.of(["car"], [[10 * t, 0, 1]], [[4, 2, 1.5]], [0.0]), np.array([0.9])))
        for t in steps
    ]
    moments = np.append(steps[10:], [1.95, 2.0])
    whole = Scene("a", moments, np.tile(np.eye(4), (12, 1, 1)), ("",) * 12, frames)
    run = track_scene(whole, TrackConfig().new_tracker(method))  # type: ignore[arg-type]
    assert [len(tracks) for tracks in run.tracks] == [1] * 12
    assert len({int(tracks.id[0]) for tracks in run.tracks}) == 1
    position = np.array([tracks.boxes.position[0, 0] for tracks in run.tracks])
    np.testing.assert_allclose(position, 10 * moments, atol=0.3)
    np.testing.assert_allclose(run.tracks[-1].boxes.velocity, [[10.0, 0.0]], atol=0.5)


def test_kf_is_the_tracker_without_edges() -> None:
    config = TrackConfig()
    assert config.new_tracker("saga").settings.edges  # type: ignore[attr-defined]
    assert config.new_tracker("kf").settings.edges == ()  # type: ignore[attr-defined]
