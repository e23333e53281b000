"""Trackers and snapshots that went through pickle, whose arrays then lie in bytes, go on with kernels."""

import pickle

import numpy as np
import pytest

from pipelines.config import load_config
from tests.saga_fg.kernels.test_tracks import random_frames


@pytest.mark.parametrize("protocol", [4, 5])
@pytest.mark.parametrize("family", ["nuscenes", "file", "traffic", "kitti"])
def test_a_pickled_tracker_and_snapshot_go_on_alike(family, protocol):
    config, frames = load_config(family), random_frames(2)
    tracker = config.new_tracker("saga")
    for frame in frames[:6]:
        tracker.step(frame)
    copied = pickle.loads(pickle.dumps(tracker, protocol))
    restored = config.new_tracker("saga")
    restored.restore(pickle.loads(pickle.dumps(tracker.snapshot(), protocol)))
    for frame in frames[6:]:
        expected = tracker.step(frame)
        assert len(expected)
        for again in (copied, restored):
            found = again.step(frame)
            assert found.id.tolist() == expected.id.tolist()
            np.testing.assert_allclose(found.boxes.position, expected.boxes.position, atol=1e-9)
