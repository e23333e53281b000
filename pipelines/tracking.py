"""Online tracking of recorded scenes, with observers: frames into a tracker, tracks at every moment of the scene.

At a moment t of the scene, every frame up to and including t has been taken in; the tracks reported are the tracker's
state at t, predicted there where the last frame is older. Nothing later than t has any influence.

With horizons, the tracks reported at t are predicted to t plus each of them as well.

Of this process, the threads of its linear algebra and its memory: for matrices as small as a filter's, threads cost
more than they bring.
"""

import ctypes
import resource
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from data_tools.datasets.detection_files import prediction_writer, predictions_path
from saga_fg import Dataset, GreedyTracker, InputError, PredictedTracks, Scene, Tracker, Tracks
from saga_fg.numerics import FloatArray
from saga_fg.tracking import SensorTime, Stage, TrackerView
from saga_fg.types import HIDDEN, within_reach

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc
LARGE = 2**18  # bytes


@contextmanager
def one_thread() -> Iterator[None]:
    """Linear algebra on one thread, which also keeps sums in one order."""
    with threadpool_limits(limits=1):
        yield


def return_large_blocks() -> None:
    """Give memory of large blocks back to the system when they are freed.

    Only with glibc as C library, which otherwise keeps ever larger ones (mallopt(3)).
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return
    for parameter in (M_MMAP_THRESHOLD, M_TRIM_THRESHOLD):
        mallopt(parameter, LARGE)


def resident_memory() -> float:
    """Return the resident memory of this process, MB."""
    status = Path("/proc/self/statm")
    if status.exists():
        return int(status.read_text().split()[1]) * resource.getpagesize() / 1e6
    return peak_memory()  # elsewhere


def peak_memory() -> float:
    """Return the largest resident memory that this process has had, MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak / 1e3


Progress = Callable[[str, int, int], None]
"""Called with the scene's name, the number of its frames done, and the number of all its frames."""


OnlineTracker = Tracker | GreedyTracker
"""A tracker that takes one frame at a time, of any sensor."""


@dataclass(frozen=True, eq=False)
class TrackedScene:
    """A scene and its tracks, one table for each of its timestamps.

    milliseconds  that the tracker took for each frame
    predictions   made at its timestamps, where horizons were given
    clocks        of its sensors, at the end, where there are several
    noise         that was found of sensors, in units of what their models say
    """

    scene: Scene
    tracks: tuple[Tracks, ...]
    milliseconds: tuple[float, ...]
    predictions: tuple[PredictedTracks, ...] = ()
    clocks: Mapping[str, SensorTime] = field(default_factory=dict)
    noise: Mapping[str, float] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        """Number of frames that were taken in."""
        return len(self.milliseconds)


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
                predicted += _predicted(tracker, wanted[-1], horizons, latest.timestamp)
    clocks, noise = compared_clocks(tracker), {name: one.scale for name, one in tracker.sensor_noise.items()}
    return TrackedScene(scene, tuple(wanted), tuple(milliseconds), tuple(predicted), clocks, noise)


def compared_clocks(tracker: OnlineTracker) -> dict[str, SensorTime]:
    """The clocks of a tracker's sensors, where there are several."""
    clocks = tracker.sensor_times
    return clocks if len(clocks) > 1 else {}


def _predicted(tracker: OnlineTracker, now: Tracks, horizons: FloatArray, newest: float) -> tuple[PredictedTracks, ...]:
    """The tracks `now` at times after it, hidden ones with modes; none where the newest frame is too far from it."""
    if isinstance(tracker, GreedyTracker):
        raise InputError("--predict: expected a method that predicts, saga or kf")
    if not within_reach(horizons + (now.timestamp - newest)):
        return ()
    return (tracker.predict(horizons, since=now.timestamp, hypotheses=bool((now.coasting > HIDDEN).any())),)


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
        raise InputError(f"scene {name}: expected frames of detections (option --detections), there are none")
    return scene


class InnovationRecorder:
    """Squared distances of tracks and the detections they took, in sigmas (NIS, 2 degrees of freedom), by class."""

    def __init__(self) -> None:
        self._parts: dict[str, list[FloatArray]] = {}

    def after(self, stage: Stage, view: Callable[[], TrackerView]) -> None:
        """Record the matches of a frame."""
        if stage != "associate":
            return
        now = view()
        assert now.matching is not None
        labels = now.table.label[now.matching.track]
        for label in np.unique(labels).tolist():
            self._parts.setdefault(label, []).append(now.matching.distance[labels == label])

    @property
    def by_class(self) -> Mapping[str, FloatArray]:
        """The squared distances of each class that was ever matched."""
        return {label: np.concatenate(parts) for label, parts in sorted(self._parts.items())}
