"""Online tracking of recorded scenes: frames in order of time into a tracker, tracks at every moment of the scene.

At a moment t of the scene, every frame up to and including t has been taken in; the tracks reported are the tracker's
state at t, predicted there where the last frame is older. Nothing later than t has any influence.

With horizons, the tracks reported at t are predicted to t plus each of them as well.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from data_tools.datasets.detection_files import prediction_writer, predictions_path
from pipelines.process import one_thread
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from saga_fg.tracking import SensorTime
from saga_fg.types.dataset import Dataset, Scene
from saga_fg.types.frame import Frame
from saga_fg.types.predicted_tracks import LONGEST, PredictedTracks
from saga_fg.types.track import Tracks

Progress = Callable[[str, int, int], None]
"""Called with the scene's name, the number of its frames done, and the number of all its frames."""


class OnlineTracker(Protocol):
    """A tracker that takes one frame at a time, of any sensor."""

    def step(self, frame: Frame) -> Tracks:
        """Take in a frame; the tracks at its time."""
        ...

    def tracks(self, timestamp: float) -> Tracks:
        """The tracks predicted to `timestamp` (s), without a change of state."""
        ...


@runtime_checkable
class PredictingTracker(Protocol):
    """A tracker that predicts its tracks, `saga_fg.tracking.Tracker`."""

    def predict(self, horizons: FloatArray, joint: bool = False) -> PredictedTracks:
        """The tracks at horizons (H,), s, after the newest frame."""
        ...


@runtime_checkable
class ClockComparing(Protocol):
    """A tracker that compares the clocks of its sensors."""

    @property
    def sensor_times(self) -> dict[str, SensorTime]:
        """The clock of each sensor against the consensus of all."""
        ...

    def take_clocks(self, other: Any) -> None:
        """Take over the usual steps and the records of the sensors from the tracker of the scene before."""
        ...


@dataclass(frozen=True, eq=False)
class TrackedScene:
    """A scene and its tracks, one table for each of its timestamps.

    milliseconds  that the tracker took for each frame
    predictions   made at its timestamps, where horizons were given
    clocks        of its sensors, at the end, where there are several
    """

    scene: Scene
    tracks: tuple[Tracks, ...]
    milliseconds: tuple[float, ...]
    predictions: tuple[PredictedTracks, ...] = ()
    clocks: Mapping[str, SensorTime] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        """Number of frames that were taken in."""
        return len(self.milliseconds)

    @property
    def seconds(self) -> float:
        """Time spent in the tracker."""
        return sum(self.milliseconds) / 1e3


def track_scene(
    scene: Scene, tracker: OnlineTracker, progress: Progress | None = None, horizons: FloatArray | None = None
) -> TrackedScene:
    """Track one scene with a fresh tracker. Frames after the last timestamp of the scene are left out.

    horizons: (H,) s, to which the tracks of each timestamp are predicted; raises `InputError` where the tracker can't.
    """
    wanted: list[Tracks] = []
    predicted: list[PredictedTracks] = []
    milliseconds: list[float] = []
    done, latest, total = 0, None, len(scene.frames)
    with one_thread():
        for moment in scene.timestamps.tolist():
            while done < total and scene.frames[done].timestamp <= moment:
                start = time.perf_counter()
                latest = tracker.step(scene.frames[done])
                milliseconds.append(1e3 * (time.perf_counter() - start))
                done += 1
                if progress is not None:
                    progress(scene.name, done, total)
            wanted.append(latest if latest is not None and latest.timestamp == moment else tracker.tracks(moment))
            if horizons is not None and latest is not None:
                predicted += _predicted(tracker, moment, horizons, latest.timestamp)
    return TrackedScene(scene, tuple(wanted), tuple(milliseconds), tuple(predicted), compared_clocks(tracker))


def compared_clocks(tracker: OnlineTracker) -> dict[str, SensorTime]:
    """The clocks of a tracker's sensors, where there are several."""
    clocks = tracker.sensor_times if isinstance(tracker, ClockComparing) else {}
    return clocks if len(clocks) > 1 else {}


def _predicted(
    tracker: OnlineTracker, moment: float, horizons: FloatArray, newest: float
) -> tuple[PredictedTracks, ...]:
    """The tracks at times after a moment; none where the newest frame is too far from it."""
    if not isinstance(tracker, PredictingTracker):
        raise InputError("--predict: expected a method that predicts, saga or kf")
    since = np.asarray(horizons + (moment - newest))
    if since[0] < 0 or since[-1] > LONGEST:
        return ()
    return (replace(tracker.predict(since), timestamp=moment, horizons=horizons),)


def track_dataset(
    dataset: Dataset,
    new_tracker: Callable[[], OnlineTracker],
    scenes: Iterable[str] | None = None,
    progress: Progress | None = None,
    horizons: FloatArray | None = None,
) -> Iterator[TrackedScene]:
    """Track some scenes (default: all), each with a tracker of its own, one at a time as they are asked for."""
    for name in dataset.scenes if scenes is None else scenes:
        yield track_scene(scene_with_frames(dataset, name), new_tracker(), progress, horizons)


@contextmanager
def keep_predictions(runs: Iterable[TrackedScene], result: Path, wanted: bool) -> Iterator[Iterator[TrackedScene]]:
    """Yield runs that are passed on; their predictions are kept beside the result, if that is wanted.

    A table of predictions that an earlier run has left there goes. Raises `InputError` where it is not writable.
    """
    path = predictions_path(result)
    if not wanted:
        yield iter(runs)
        path.unlink(missing_ok=True)
        return
    with prediction_writer(path) as write:

        def passed_on() -> Iterator[TrackedScene]:
            for run in runs:
                write(run.scene.name, run.predictions)
                yield run

        yield passed_on()


def scene_with_frames(dataset: Dataset, name: str) -> Scene:
    """Read a scene. Raises `InputError` for one without any frame of detections."""
    scene = dataset.scene(name)
    if not scene.frames:
        raise InputError(f"scene {name}: expected frames of detections, there are none")
    return scene
