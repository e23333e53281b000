"""Duplicate tracks end."""

import numpy as np
import pytest

from saga_fg import Tracker, TrackerSettings
from saga_fg.tracking import ClassSettings
from saga_fg.tracking.deletion import duplicate_tracks
from tests.saga_fg.traffic_frames import frame, run


@pytest.mark.parametrize(
    ("second", "label", "seen", "expected"),
    [
        ((0.5, 0.0), "car", (True, False), [False, True]),
        ((0.5, 0.0), "car", (False, True), [True, False]),
        ((0.5, 0.0), "car", (True, True), [False, False]),
        ((0.5, 0.0), "car", (False, False), [False, False]),
        ((0.5, 0.0), "pedestrian", (True, False), [False, False]),
        ((1.5, 0.0), "car", (True, False), [False, False]),
    ],
    ids=["the second", "the first", "both seen", "none seen", "another class", "too far"],
)
def test_a_track_is_a_duplicate_where_it_is_not_seen_and_another_is(second, label, seen, expected):
    position = np.array([(0.0, 0.0), second])
    found = duplicate_tracks(position, np.array(["car", label]), np.array(seen), np.full(2, 1.0))
    assert found.tolist() == expected


def test_a_track_without_detections_ends_as_soon_as_another_takes_its_place():
    """Two cars side by side; the second one's detections end, and the first one comes to where it was."""
    ids = {}
    for distance in (0.0, 1.0):
        settings = TrackerSettings({"default": ClassSettings(merge_distance=distance, max_coasting=10.0)}, edges=())
        frames = [frame(0.1 * k, [(0.0, 0.1 * min(k, 25)), (0.0, 3.0)][: 2 if k < 10 else 1]) for k in range(40)]
        ids[distance] = [set(tracks.id.tolist()) for tracks in run(Tracker(settings), frames)]
    assert ids[0.0][10] == ids[1.0][10] == {1, 2}
    assert len(Tracker(settings).step(frames[0]).id) == 2
    assert ids[1.0][-1] == {1}
