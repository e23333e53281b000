"""Smoothing a simulated recording from end to end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from data_tools.metrics import match_scene
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.smoothing import SmoothedScene, load_smooth_config, smooth_scene
from pipelines.tracking import track_scene
from saga_fg import Boxes, Detections, Frame, Scene


@pytest.fixture(scope="module")
def smoothed() -> SmoothedScene:
    dataset = SimulatedTraffic(replace(SimulatorSettings(), duration=6.0), scenes=1, seed=5)
    return smooth_scene(dataset.scene("scene-0001"), load_smooth_config("simulated"))


def test_labels_fit_the_scene_and_are_counted(smoothed: SmoothedScene) -> None:
    assert len(smoothed.labels) == len(next(iter(smoothed.parts))[0])
    sources = np.concatenate([moment.source for moment in smoothed.labels])
    counts = smoothed.counts
    assert (counts.observed, counts.filled, counts.extended) == tuple(
        int((sources == name).sum()) for name in ("observed", "filled", "extended")
    )
    assert counts.boxes == sum(map(len, smoothed.labels)) > 0
    assert counts.filled > 0


def test_an_object_keeps_size_class_and_score_and_has_no_holes(smoothed: SmoothedScene) -> None:
    seen: dict[int, list[int]] = {}
    first: dict[int, tuple[str, list[float], float]] = {}
    for k, tracks in enumerate(smoothed.tracks):
        for i, id_ in enumerate(tracks.id.tolist()):
            seen.setdefault(id_, []).append(k)
            now = str(tracks.boxes.label[i]), tracks.boxes.size[i].tolist(), float(tracks.score[i])
            assert first.setdefault(id_, now) == now
    assert all(np.diff(moments).max(initial=1) == 1 for moments in seen.values())


def test_smoothed_positions_and_headings_are_better_than_online_ones(smoothed: SmoothedScene) -> None:
    ((scene, _),) = smoothed.parts
    assert scene.ground_truth is not None
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
def test_where_nothing_was_seen_there_are_no_labels(frames: list[Frame]) -> None:
    smoothed = smooth_scene(scene_of(frames, [0.0, 0.5, 1.0]), load_smooth_config("file"))
    assert [len(moment) for moment in smoothed.labels] == [0, 0, 0]
    assert smoothed.counts.boxes == 0


def test_size_and_heading_that_nobody_measured_stay_unknown() -> None:
    times = [0.1 * k for k in range(12)]
    scene = scene_of([frame_at(time, [0.2 * k]) for k, time in enumerate(times)], times)
    smoothed = smooth_scene(scene, load_smooth_config("file"))
    assert [len(moment) for moment in smoothed.labels] == [1] * 12
    assert all(np.isnan(moment.tracks.boxes.size).all() for moment in smoothed.labels)


def test_moments_between_frames_are_filled_and_those_beyond_are_not() -> None:
    frames = [frame_at(0.1 * k, [0.5 * k]) for k in range(10)]
    smoothed = smooth_scene(scene_of(frames, [-1.0, 0.25, 0.55, 5.0]), load_smooth_config("file"))
    assert [len(moment) for moment in smoothed.labels] == [0, 1, 1, 0]
    assert smoothed.tracks[1].boxes.position[0, 0] == pytest.approx(1.25, abs=0.1)
