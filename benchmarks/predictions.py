"""How far off are predictions: tracks at a moment, predicted some seconds on, against where the objects then are.

The tracker has taken in the frames up to the moment and no later one. Whose track it is says the distance at the moment
itself, and only objects that are visible then are asked about.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from pipelines.process import one_thread
from pipelines.tracking import OnlineTracker
from saga_fg.numerics.arrays import IntArray, StrArray
from saga_fg.numerics.assignment import assign
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Annotations, Scene
from saga_fg.types.frame import Frame
from saga_fg.types.track import Tracks

MOVING = 0.5  # m/s
FOLLOWED = 1.5  # s in view before a question: sooner, nobody knows a velocity
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
            done = fed(tracker, scene.frames, done, time)
            later = int(np.argmin(np.abs(scene.timestamps - time - horizon)))
            now, then = scene.ground_truth[row], scene.ground_truth[later]
            wanted = np.flatnonzero(now.visible & np.isin(now.id, asked(row)))
            track_id = own_tracks(tracker.tracks(time), now.boxes.select(wanted))
            predicted = tracker.tracks(float(scene.timestamps[later]))
            found = position_errors(predicted, track_id, then, now.id[wanted])
            errors |= {(name, row): error for name, error in found.items()}
    return errors


def fed(tracker: OnlineTracker, frames: Sequence[Frame], done: int, time: float) -> int:
    """How many frames a tracker knows that knew `done` of them and is given all up to `time`."""
    while done < len(frames) and frames[done].timestamp <= time:
        tracker.step(frames[done])
        done += 1
    return done


def position_errors(tracks: Tracks, own: IntArray, truth: Annotations, names: StrArray) -> dict[str, float]:
    """Errors, m, of the tracks `own` (n,), by id, of the objects `names` (n,); of those that are there."""
    errors = {}
    for name, track in zip(names.tolist(), own.tolist(), strict=True):
        at, true = np.flatnonzero(tracks.id == track), np.flatnonzero(truth.id == name)
        if len(at) and len(true):
            errors[name] = float(np.hypot(*(tracks.boxes.position[at[0], :2] - truth.boxes.position[true[0], :2])))
    return errors


def moving(moment: Annotations) -> StrArray:
    """Ids of the objects that move."""
    return np.asarray(moment.id[np.hypot(*np.nan_to_num(moment.boxes.velocity).T) > MOVING])


def in_view(moments: Sequence[Annotations]) -> StrArray:
    """Ids of the objects that were visible at all these moments."""
    names = moments[0].id
    for moment in moments:
        names = np.intersect1d(names, moment.id[moment.visible])
    return np.asarray(names)


def own_tracks(tracks: Tracks, objects: Boxes) -> IntArray:
    """(n,) ids of the tracks of n objects of the same moment, -1 for none."""
    offset = objects.position[:, None, :2] - tracks.boxes.position[:, :2]
    distance = np.hypot(offset[..., 0], offset[..., 1])
    possible = (distance <= MATCHED) & (objects.label[:, None] == tracks.boxes.label)
    row, column = assign(distance, possible, MATCHED)
    own = np.full(len(objects), -1, dtype=np.int64)
    own[row] = tracks.id[column]
    return own
