"""Sets of recordings to compare trackers on, each with the figures that its kind is judged by."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from pathlib import Path
from types import MappingProxyType
from typing import Protocol

from data_tools.datasets.kitti import KittiTracking, write_kitti_results
from data_tools.datasets.kitti.evaluation import CLASSES, kitti_hota, kitti_label_errors
from data_tools.datasets.kitti.scored_sequences import read_scored_sequences
from data_tools.datasets.ngsim.windows import NgsimWindows
from data_tools.datasets.nuscenes import NuScenes, read_scored_scenes, split_scenes, write_tracking_results
from data_tools.datasets.nuscenes.evaluation import nuscenes_hota, nuscenes_label_errors
from data_tools.datasets.openacc import OpenAccPlatoons
from data_tools.datasets.overlapping import overlapping
from data_tools.datasets.recorded_traffic import Stretches, TrafficRecordings
from data_tools.datasets.source import ChosenScenes
from data_tools.evaluation.hota import HotaRow
from data_tools.evaluation.placed_detections import placed_detections
from data_tools.files.error_messages import unknown_name
from data_tools.metrics import (
    KittiTrackingSequence,
    LabelErrors,
    SceneBoxes,
    SceneMetrics,
    kitti_tracking_metrics,
    label_errors,
    nuscenes_tracking_metrics,
    scene_metrics,
)
from data_tools.metrics.hota import HotaOfScenes
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from data_tools.simulator.recorded_source import SensedRecordings
from data_tools.simulator.recorded_world import MAST, VEHICLE
from pipelines.config import Family
from pipelines.tracking import TrackedScene
from saga_fg.errors import InputError
from saga_fg.types.dataset import Dataset

VERSION = "v1.0-mini"
Runs = Mapping[str, TrackedScene]
"""A tracker's output by scene."""


@dataclass(frozen=True, eq=False)
class Score:
    """Scores of a tracker on a set.

    figures_of  headline figures of some scenes, by their numbers; a number may occur more than once
    errors      at the labels, scene by scene
    hota        HOTA of all scenes by class, where a set has it; raises `MissingExtraError` without trackeval
    hota_of     HOTA of cars of some scenes, where a set has that; raises as above when it is called
    cluster     for each scene the first of those that overlap with it in time; empty where none do
    """

    figures_of: Callable[[Sequence[int]], dict[str, float]]
    errors: tuple[LabelErrors, ...]
    hota: Callable[[], Sequence[HotaRow]] = tuple
    hota_of: Callable[[], HotaOfScenes] | None = None
    cluster: tuple[str, ...] = ()

    def with_hota(self) -> Score:
        """A copy with HOTA of cars among the headline figures, if it is known."""
        if self.hota_of is None:
            return self
        hota, others = self.hota_of(), self.figures_of
        return replace(self, figures_of=lambda rows: others(rows) | {"HOTA car": hota(rows)}, hota_of=None)

    @property
    def units(self) -> list[list[int]]:
        """The scenes by their numbers, those that overlap together."""
        found: dict[str, list[int]] = {}
        for row in range(len(self.errors)):
            found.setdefault(self.cluster[row] if self.cluster else str(row), []).append(row)
        return list(found.values())

    @property
    def figures(self) -> dict[str, float]:
        """Headline figures of all scenes."""
        return self.figures_of(range(len(self.errors)))


class RecordingSet(Protocol):
    """Scenes of one kind, with ground truth."""

    @property
    def name(self) -> str: ...
    @property
    def family(self) -> Family: ...
    @property
    def dataset(self) -> Dataset: ...
    @property
    def clusters(self) -> Mapping[str, str]:
        """For each scene, by name, the first of those that overlap with it in time; none where none do."""
        ...

    def score(self, runs: Runs) -> Score:
        """Judge a tracker's output on all scenes."""
        ...


class NuScenesSet:
    """Scenes in the nuScenes layout, judged by the official metrics."""

    family: Family = "nuscenes"
    clusters: Mapping[str, str] = MappingProxyType({})

    def __init__(self, name: str, dataroot: Path, detections: Mapping[str, Path], split: str) -> None:
        """Raises `InputError` for missing or broken files."""
        self.name, self._dataroot = name, dataroot
        scenes = split_scenes(dataroot, VERSION, split)
        self.dataset = NuScenes(dataroot, VERSION, detections, scenes, ground_truth=True)

    def score(self, runs: Runs) -> Score:
        """Write the official result, read it back, and score it."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "tracks.json"
            write_tracking_results(path, ((run.scene, run.tracks) for run in runs.values()), self.dataset.meta)
            scored = read_scored_scenes(path, self._dataroot, VERSION, tuple(runs))
        scenes = [each.tracking for each in scored.values()]

        def figures_of(rows: Sequence[int]) -> dict[str, float]:
            f = nuscenes_tracking_metrics([scenes[row] for row in rows]).overall
            return {"AMOTA": f.amota, "AMOTP": f.amotp, "MOTA": f.mota, "IDS": f.ids, "FRAG": f.frag}

        errors = (
            nuscenes_label_errors(scene, placed_detections(runs[name].scene))
            for name, scene in zip(scored, scenes, strict=True)
        )
        return Score(figures_of, tuple(errors), lambda: nuscenes_hota(scenes, nuscenes_tracking_metrics(scenes)))


class KittiSet:
    """KITTI sequences, judged by the 3D metrics averaged over recall."""

    family: Family = "kitti"
    clusters: Mapping[str, str] = MappingProxyType({})

    def __init__(self, name: str, dataroot: Path, detections: Path, sequences: Sequence[str] | None = None) -> None:
        """Raises `InputError` for missing files."""
        self.name, self._dataroot, self._detections = name, dataroot, detections
        self.dataset = KittiTracking(dataroot, detections, sequences, ground_truth=True)

    def score(self, runs: Runs) -> Score:
        """Write the official results, read them back, and score them."""
        with tempfile.TemporaryDirectory() as folder:
            results = Path(folder) / "results"
            write_kitti_results(results, self.dataset, ((run.scene, run.tracks) for run in runs.values()))
            scored = read_scored_sequences(results, self._dataroot, tuple(runs), self._detections)
        pairs = [KittiTrackingSequence(each.labels, each.result) for each in scored.values()]

        def figures_of(rows: Sequence[int]) -> dict[str, float]:
            figures: dict[str, float] = {}
            for label, iou in (*((label, 0.25) for label in CLASSES), ("car", 0.5)):
                f = kitti_tracking_metrics([pairs[row] for row in rows], label, iou)
                if f is not None:
                    name = label if iou == 0.25 else f"{label} at {iou:g}"
                    figures |= {
                        f"{name} sAMOTA": f.samota,
                        f"{name} safe sAMOTA": f.samota_safe,
                        f"{name} AMOTA": f.amota,
                    }
                    figures |= {f"{name} MOTA": f.mota, f"{name} IDS": float(f.ids)}
            return figures

        def of_cars() -> Sequence[HotaRow]:
            f = kitti_tracking_metrics(pairs, "car", 0.25)
            return kitti_hota(pairs, {"car": f.threshold_safe}) if f is not None else ()

        return Score(figures_of, tuple(kitti_label_errors(each, CLASSES) for each in scored.values()), of_cars)


@dataclass(frozen=True)
class TrueSet:
    """Scenes with the exact truth at every frame, hidden objects by the track that last followed them.

    clusters  for each scene, by name, the first of those that overlap with it in time; empty where none do
    """

    name: str
    family: Family
    dataset: Dataset
    clusters: Mapping[str, str] = field(default_factory=dict)

    def score(self, runs: Runs) -> Score:
        """Compare with the truth at every frame."""
        metrics, errors, pairs = [], [], []
        for run in runs.values():
            truth = run.scene.ground_truth
            assert truth is not None
            metrics.append(scene_metrics(truth, run.tracks))
            labels = SceneBoxes.of_annotations(truth, hidden=False)
            found = SceneBoxes.of_tracks(run.tracks)
            errors.append(label_errors(labels, found, labels.boxes.velocity))
            pairs.append((SceneBoxes.of_annotations(truth), found))

        def figures_of(rows: Sequence[int]) -> dict[str, float]:
            m = SceneMetrics.pool(metrics[row] for row in rows)
            return {"MOTA": m.mota, "IDS": float(m.switches), "hidden RMSE": m.carried.rmse}

        cluster = tuple(self.clusters.get(name, name) for name in runs)
        return Score(figures_of, tuple(errors), hota_of=lambda: HotaOfScenes(pairs, "car"), cluster=cluster)


def simulated_set(scenes: int, seed: int = 0, settings: SimulatorSettings | None = None) -> RecordingSet:
    """Simulated traffic."""
    return TrueSet("simulated", "simulated", SimulatedTraffic(settings, scenes, seed))


def recording_set(
    name: str, data: Path | None, scenes: int, viewpoint: str | None = None, longest: float = inf
) -> RecordingSet:
    """A set by name; `data` holds a folder for each kind of recordings, `scenes` simulated ones are made.

    viewpoint  of the sensors that see recorded traffic, see `data_tools.simulator.recorded_world`; None: the set's own
    longest    of recorded traffic, s, from the middle of longer recordings

    Raises `InputError` for an unknown name or missing recordings.
    """
    if name == "simulated":
        return simulated_set(scenes)
    if name not in (*SETS, *TRAFFIC_SETS):
        raise InputError(f"unknown set {name!r}: expected some of {', '.join((*SETS, *TRAFFIC_SETS))}, simulated")
    if data is None:
        raise InputError(f"set {name}: expected --data DIR with the folders of recordings")
    if name in SETS:
        return SETS[name](data)
    traffic, usual = TRAFFIC_SETS[name]
    recordings: TrafficRecordings = Stretches(traffic(data), longest)
    clusters = overlapping(map(recordings.recording, recordings.names)) if name in OVERLAPPING else {}
    return TrueSet(name, "traffic", SensedRecordings(recordings, viewpoint or usual, None, seed=0), clusters)


@dataclass(frozen=True)
class ChosenRecordings:
    """Some recordings of a set."""

    whole: RecordingSet
    dataset: Dataset

    @property
    def name(self) -> str:
        """That of the set."""
        return self.whole.name

    @property
    def family(self) -> Family:
        """That of the set."""
        return self.whole.family

    @property
    def clusters(self) -> Mapping[str, str]:
        """The clusters of the whole set."""
        return self.whole.clusters

    def score(self, runs: Runs) -> Score:
        """Judge a tracker's output on them."""
        return self.whole.score(runs)


def chosen_recordings(sets: Sequence[RecordingSet], recordings: Sequence[str]) -> list[RecordingSet]:
    """The sets that have some of the recordings, with these alone. Raises `InputError` for one that none has."""
    known = tuple(name for each in sets for name in each.dataset.scenes)
    unknown = next((name for name in recordings if name not in known), None)
    if unknown is not None:
        raise InputError(f"--test: {unknown_name('recording', unknown, known)}")
    mine = ((each, [name for name in each.dataset.scenes if name in recordings]) for each in sets)
    return [ChosenRecordings(each, ChosenScenes(each.dataset, ",".join(found))) for each, found in mine if found]


def _nuscenes(name: str, split: str, sensor: str, file: str) -> Callable[[Path], RecordingSet]:
    def build(data: Path) -> RecordingSet:
        root = data / "nuscenes"
        return NuScenesSet(name, root, {sensor: root / "detections" / file}, split)

    return build


SETS: dict[str, Callable[[Path], RecordingSet]] = {
    "megvii": _nuscenes("megvii", "mini_train", "lidar", "megvii_lidar.json"),
    "centerpoint": _nuscenes("centerpoint", "lidar_centerpoint", "lidar", "centerpoint_lidar.json"),
    "camera": _nuscenes("camera", "camera", "camera", "fastbev_camera.json"),
    "kitti": lambda data: KittiSet("kitti", data / "kitti", data / "kitti" / "detections" / "pointrcnn"),
}
TRAFFIC_SETS: dict[str, tuple[Callable[[Path], TrafficRecordings], str]] = {
    "ngsim": (lambda data: NgsimWindows(data / "ngsim"), MAST),
    "openacc": (lambda data: OpenAccPlatoons(data / "openacc"), VEHICLE),
}
"""Recorded traffic, whose detections are made, and the usual viewpoint; taken only where it is asked for."""
OVERLAPPING = ("ngsim",)
"""Sets whose recordings may overlap in time."""
