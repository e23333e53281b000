"""Without bounds, iSAM2 tracks recordings as the joint Kalman filter does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.recordings import recording_set
from pipelines.config import load_config


@pytest.mark.parametrize(("name", "scene", "count"), [("megvii", "scene-0655", 20), ("kitti", "0011", 30)])
def test_isam2_gives_the_tracks_of_kalman(recordings: Path, name: str, scene: str, count: int) -> None:
    chosen = recording_set(name, recordings, 1)
    config = load_config(chosen.family)
    exact = replace(config.tracker, tolerance=0.0, max_component=None)
    trackers = [
        replace(config, tracker=replace(exact, estimator=estimator)).new_tracker("saga")
        for estimator in ("kalman", "isam2")
    ]
    for frame in list(chosen.dataset.scene(scene).frames)[:count]:
        for tracker in trackers:
            tracker.step(frame)
        expected, found = (tracker.tracks(frame.timestamp) for tracker in trackers)
        assert expected.id.tolist() == found.id.tolist()
        np.testing.assert_allclose(found.boxes.position, expected.boxes.position, rtol=0, atol=1e-9)
