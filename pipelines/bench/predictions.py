"""How far off are predictions: tracks at a moment, predicted some seconds on, against where the objects then are.

The tracker has taken in the frames up to the moment and no later one. Whose track it is says the distance at the moment
itself, and only objects that are visible then are asked about.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from pipelines.process import one_thread
from pipelines.tracking import OnlineTracker
from saga_fg.arrays import IntArray, StrArray
from saga_fg.association import assign
from saga_fg.boxes import Boxes
from saga_fg.dataset import Scene
from saga_fg.track import Tracks

MATCHED = 2.0  # m between a track and its object at most, at the moment of the prediction

Asked = tuple[str, int]
"""An object's id and the row of a moment of the scene."""


def prediction_errors(
    scene: Scene, tracker: OnlineTracker, horizon: float, rows: Sequence[int], asked: Callable[[int], StrArray]
) -> Mapping[Asked, float]:
    """Errors, m, of the predictions `horizon` s on from the moments `rows` of objects `asked(row)` by id."""
    assert scene.ground_truth is not None
    errors: dict[Asked, float] = {}
    done = 0
    with one_thread():
        for row in rows:
            time = float(scene.timestamps[row])
            while done < len(scene.frames) and scene.frames[done].timestamp <= time:
                tracker.step(scene.frames[done])
                done += 1
            later = int(np.argmin(np.abs(scene.timestamps - time - horizon)))
            now, then = scene.ground_truth[row], scene.ground_truth[later]
            wanted = np.flatnonzero(now.visible & np.isin(now.id, asked(row)))
            track_id = own_tracks(tracker.tracks(time), now.boxes.select(wanted))
            predicted = tracker.tracks(float(scene.timestamps[later]))
            for name, track in zip(now.id[wanted].tolist(), track_id.tolist(), strict=True):
                at, true = np.flatnonzero(predicted.id == track), np.flatnonzero(then.id == name)
                if len(at) and len(true):
                    offset = predicted.boxes.position[at[0], :2] - then.boxes.position[true[0], :2]
                    errors[name, row] = float(np.hypot(*offset))
    return errors


def own_tracks(tracks: Tracks, objects: Boxes) -> IntArray:
    """(n,) ids of the tracks of n objects of the same moment, -1 for none."""
    offset = objects.position[:, None, :2] - tracks.boxes.position[:, :2]
    distance = np.hypot(offset[..., 0], offset[..., 1])
    possible = (distance <= MATCHED) & (objects.label[:, None] == tracks.boxes.label)
    row, column = assign(distance, possible, MATCHED)
    own = np.full(len(objects), -1, dtype=np.int64)
    own[row] = tracks.id[column]
    return own
