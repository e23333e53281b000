"""Boxes of other trackers, or of annotations, in the place of detections.

Of a tracker's result, boxes are detections with identities, and each result is a sensor. A track's velocity is no
measurement, it follows from the boxes; so it is left out. So are boxes that are known to be predictions, where the
table says so (`coasting`).

Recordings that have ground truth and no detections take these from a table, or from the annotations.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from data_tools.datasets.results import SceneResult
from data_tools.datasets.source import (
    DatasetSource,
    HeldScene,
    OpenedPart,
    Part,
    Parts,
    scene_digests,
)
from saga_fg.errors import InputError
from saga_fg.tables import DetectionTable
from saga_fg.types import Dataset, Detections, Frame, Scene

SENSOR = "tracks"
"""Name of the first result as a sensor; the others are tracks_2, tracks_3, ..."""

GivenTracks = Sequence[Mapping[str, SceneResult]]
"""The results of several trackers, by scene."""


def read_given_tracks(source: DatasetSource, files: Sequence[Path]) -> GivenTracks:
    """Read results of trackers for the chosen scenes of a dataset, whose ground truth is not read.

    Raises `InputError` for one that is missing or broken, or that has no track in these scenes.
    """
    for number, file in enumerate(files):
        if file.resolve() in [other.resolve() for other in files[:number]]:
            raise InputError(f"--tracks {file}: expected each result once")
    results: list[Mapping[str, SceneResult]] = []
    for file in files:
        found = source.read_results(file, truth=False).scenes
        if not any(len(each.found) for each in found.values()):
            raise InputError(f"--tracks {file}: expected tracks of the chosen scenes, there are none")
        results.append(found)
    return results


def sensor_names(count: int) -> list[str]:
    """The names of so many results as sensors."""
    return [SENSOR if number == 1 else f"{SENSOR}_{number}" for number in range(1, count + 1)]


def of_scene(results: GivenTracks, scene: str) -> dict[str, SceneResult]:
    """The results of those that have a scene, by their names as sensors."""
    named = zip(sensor_names(len(results)), results, strict=True)
    return {name: result[scene] for name, result in named if scene in result}


def with_tracks(results: Mapping[str, SceneResult], scene: Scene | None = None) -> Scene:
    """A scene with the boxes of results, by their names as sensors, as frames beside the frames it has.

    Its moments are those of all results. scene: with frames of detections; that of the first result if left out
    """
    given = list(results.values())
    scene = given[0].scene if scene is None else scene
    timestamps = np.concatenate([each.scene.timestamps for each in given])
    timestamps, first = np.unique(timestamps, return_index=True)
    poses = np.concatenate([each.scene.world_T_ego for each in given])[first]
    tokens = [token for each in given for token in each.scene.tokens]
    frames = list(scene.frames)
    for name, each in results.items():
        frames += _frames(name, each)
    frames.sort(key=lambda frame: frame.timestamp)
    return replace(
        scene,
        timestamps=timestamps,
        world_T_ego=poses,
        tokens=tuple(tokens[row] for row in first.tolist()),
        frames=tuple(frames),
        ground_truth=None,
    )


def _frames(sensor: str, result: SceneResult) -> Iterator[Frame]:
    """A frame for every moment."""
    found, scene = result.found, result.scene
    if result.coasting is not None:
        found = found.select(np.flatnonzero(~(result.coasting > 0)))
    _, identity = np.unique(found.id, return_inverse=True)
    boxes = replace(found.boxes, velocity=np.full((len(found), 2), np.nan))
    bounds = np.searchsorted(found.frame, np.arange(len(scene) + 1)).tolist()
    for k, time in enumerate(scene.timestamps.tolist()):
        rows = np.arange(bounds[k], bounds[k + 1])
        seen = Detections(boxes.select(rows), found.score[rows], identity=identity[rows])
        yield Frame(time, sensor, seen, scene.world_T_ego[k])


@dataclass(frozen=True, eq=False)
class TrackedRecordings:
    """Scenes with the boxes of results as frames; those of `recordings` that no result has are left out.

    recordings: the dataset; one without scenes leaves them to the results
    """

    recordings: Dataset
    results: GivenTracks

    @property
    def scenes(self) -> tuple[str, ...]:
        """The names of scenes that some result has."""
        named = dict.fromkeys(name for result in self.results for name in result)
        return tuple(name for name in self.recordings.scenes or named if name in named)

    def scene(self, name: str) -> Scene:
        """A scene with its own frames, and those of the results."""
        own = self.recordings.scene(name) if self.recordings.scenes else None
        return with_tracks(of_scene(self.results, name), own)


@contextmanager
def _opened(part: Part, results: GivenTracks) -> Iterator[OpenedPart]:
    """Open a part of a dataset with the boxes of results, and their digests too."""
    given = {
        f"{SENSOR} {name} {number}": _digest(each)
        for number, result in enumerate(results)
        for name, each in result.items()
    }
    with part.opened() as there:
        yield OpenedPart({**there.digests, **given}, lambda: TrackedRecordings(there.read(), results))


def _digest(result: SceneResult) -> str:
    """SHA-256 of the boxes as frames."""
    return scene_digests(with_tracks({SENSOR: result}, replace(result.scene, frames=())))[SENSOR]


def tracked_parts(parts: Parts, results: GivenTracks) -> Parts:
    """The parts of a dataset with the boxes of results; parts that are one scene each, and these if there is none."""
    there = dict.fromkeys(name for result in results for name in result)
    if not parts.names:
        return Parts([*there], (HeldScene(with_tracks(of_scene(results, name))).part for name in there), parts.dataset)

    def chosen() -> Iterator[Part]:
        for part in parts.parts:
            if part.name in there:
                own = [{name: result[name] for name in [part.name] if name in result} for result in results]
                yield Part(part.name, partial(_opened, part, own))

    return Parts([name for name in parts.names if name in there], chosen(), parts.dataset)


ANNOTATED = "annotations"


class DetectedScenes:
    """The scenes of a dataset with the detections of a table, or with their annotations as detections."""

    def __init__(self, dataset: Dataset, table: DetectionTable | None) -> None:
        self._dataset, self._table = dataset, table
        self.scenes = dataset.scenes

    def scene(self, name: str) -> Scene:
        """Read one of the scenes; raises `InputError` where the table does not have it."""
        scene = self._dataset.scene(name)
        return replace(scene, frames=detected(scene) if self._table is None else self._table.scene(name).frames)


def detected(scene: Scene) -> list[Frame]:
    """A frame for each moment, of sensor "annotations": its visible boxes, of score 1, without ids and velocities.

    Where moments are missing, since nothing is annotated, there are empty frames at the pace of the others. Raises
    `InputError` for a scene without ground truth.
    """
    if scene.ground_truth is None:
        raise InputError(f"scene {scene.name}: expected ground truth to take detections from")
    frames: list[Frame] = []
    period = float(np.median(np.diff(scene.timestamps))) if len(scene) > 1 else np.inf
    for time, pose, truth in zip(scene.timestamps.tolist(), scene.world_T_ego, scene.ground_truth, strict=True):
        if frames:
            last = frames[-1]
            missing = np.arange(1, round((time - last.timestamp) / period)) * period + last.timestamp
            frames += [Frame(at, ANNOTATED, Detections.empty(), last.world_T_ego) for at in missing.tolist()]
        boxes = truth.boxes.select(truth.visible)
        unknown = replace(boxes, velocity=np.full((len(boxes), 2), np.nan))
        frames.append(Frame(time, ANNOTATED, Detections(unknown, np.ones(len(boxes))), pose))
    return frames
