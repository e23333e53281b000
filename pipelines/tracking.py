"""Online tracking of recorded scenes: frames in order of time into a tracker, tracks at every moment of the scene.

At a moment t of the scene, every frame up to and including t has been taken in; the tracks reported are the tracker's
state at t, predicted there where the last frame is older. Nothing later than t has any influence.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

from pipelines.process import one_thread
from saga_fg.errors import InputError
from saga_fg.types.dataset import Dataset, Scene
from saga_fg.types.frame import Frame
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


@dataclass(frozen=True, eq=False)
class TrackedScene:
    """A scene and its tracks, one table for each of its timestamps.

    milliseconds  that the tracker took for each frame
    """

    scene: Scene
    tracks: tuple[Tracks, ...]
    milliseconds: tuple[float, ...]

    @property
    def frames(self) -> int:
        """Number of frames that were taken in."""
        return len(self.milliseconds)

    @property
    def seconds(self) -> float:
        """Time spent in the tracker."""
        return sum(self.milliseconds) / 1e3


def track_scene(scene: Scene, tracker: OnlineTracker, progress: Progress | None = None) -> TrackedScene:
    """Track one scene with a fresh tracker. Frames after the last timestamp of the scene are left out."""
    wanted: list[Tracks] = []
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
    return TrackedScene(scene, tuple(wanted), tuple(milliseconds))


def track_dataset(
    dataset: Dataset,
    new_tracker: Callable[[], OnlineTracker],
    scenes: Iterable[str] | None = None,
    progress: Progress | None = None,
) -> Iterator[TrackedScene]:
    """Track some scenes (default: all), each with a tracker of its own, one at a time as they are asked for."""
    for name in dataset.scenes if scenes is None else scenes:
        yield track_scene(scene_with_frames(dataset, name), new_tracker(), progress)


def scene_with_frames(dataset: Dataset, name: str) -> Scene:
    """Read a scene. Raises `InputError` for one without any frame of detections."""
    scene = dataset.scene(name)
    if not scene.frames:
        raise InputError(f"scene {name}: expected frames of detections, there are none")
    return scene
