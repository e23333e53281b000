"""Sets of recordings to compare trackers on, each with the figures that its kind is judged by.

Figures of a nuScenes result class by class: ranks, ghosts by kind, objects of two classes, and oracles.

Scores are the means over tracks, by which the official evaluation judges.

left out      least and largest AMOTA with one scene left out
rank          probability that a box of an object scores higher than one of none; one half: scores say nothing
ghosts        boxes of no object from the score of the best MOTA on, by the first of these that is so:
              beside        within the gate of an object of their class, which another box has
              other class   within the gate of an object of another class
              coasting      without a detection of their class within the gate
              clutter       all others
two classes   a frame with two boxes of different classes whose bird's-eye IoU is above `TWICE`, both from the
              score of the best MOTA of their classes on; in brackets, of labelled boxes
matching      an oracle: only the tracks that come within the gate of a labelled object of their class at some time
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import inf
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.crossings import simulated_crossings
from benchmarks.recordings.argoverse2 import argoverse_logs
from benchmarks.recordings.crowds import RATE, recorded_crowds, simulated_crowds
from benchmarks.recordings.dut import dut_clips
from benchmarks.recordings.ngsim import ngsim_windows
from benchmarks.recordings.openacc import openacc_platoons
from benchmarks.recordings.sources import ABOVE, MAST, VEHICLE, TrafficScenes, default_sensors, sensed_scene
from benchmarks.recordings.traffic import Recordings, overlapping
from benchmarks.runner import chosen
from data_tools.datasets.kitti import KittiTracking, write_kitti_results
from data_tools.datasets.kitti.source import CLASSES, kitti_label_errors, read_scored_sequences
from data_tools.datasets.nuscenes import NuScenes, read_scored_scenes, split_scenes, write_tracking_results
from data_tools.datasets.nuscenes.source import in_range, nuscenes_label_errors
from data_tools.datasets.source import ChosenScenes
from data_tools.metrics import (
    KittiTrackingSequence,
    LabelErrors,
    NuScenesTrackingScene,
    PlacedBoxes,
    SceneBoxes,
    SceneMetrics,
    best_thresholds,
    kitti_tracking_metrics,
    label_errors,
    nuscenes_tracking_metrics,
    placed_detections,
    scene_metrics,
)
from data_tools.metrics.scene_boxes import near_pairs, nearest_pairs, track_means
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.config import Family
from pipelines.tracking import TrackedScene
from saga_fg.errors import InputError
from saga_fg.numerics import BoolArray, FloatArray, StrArray
from saga_fg.types import Dataset, Scene, paired_bev_iou, touching_pairs

TWICE = 0.2
LOW_SCORE = 0.1  # hidden objects at places that are hardly known have less
GATE = 2.0  # m, that of the official evaluation
OBJECT = "object"
GHOSTS = ("beside", "other class", "coasting", "clutter")


def class_rows(
    scenes: Sequence[NuScenesTrackingScene], detections: Sequence[PlacedBoxes]
) -> Iterator[Mapping[str, Any]]:
    """A row of figures for each class with labels, and their mean and label-weighted mean; detections: by scene."""
    found = nuscenes_tracking_metrics(scenes)
    matching = nuscenes_tracking_metrics([replace(s, found=s.found.select(_matching(s))) for s in scenes])
    others = [nuscenes_tracking_metrics([s for s in scenes if s is not out]) for out in scenes if len(scenes) > 1]
    thresholds = best_thresholds(found)
    judged_by = [replace(s, found=replace(s.found, score=_means(s.found))) for s in scenes]
    rows: list[dict[str, Any]] = []
    for label, one in found.per_class.items():
        if one.gt > 0:
            judged = [_judged(*pair, label) for pair in zip(judged_by, detections, strict=True)]
            score, kind = (np.concatenate(columns) for columns in zip(*judged, strict=True))
            left_out = [each.per_class[label].amota for each in others if each.per_class[label].gt > 0]
            means = {"AMOTA": one.amota, "AMOTA, matching tracks": matching.per_class[label].amota, "MOTA": one.mota}
            means["rank"] = rank_quality(score[kind == OBJECT], score[kind != OBJECT])
            sums = {"labels": one.gt, "false": one.fp, "missed": one.fn, "IDS": one.ids}
            sums |= {name: int(((kind == name) & (score >= thresholds[label])).sum()) for name in GHOSTS}
            rows.append({"class": label, **means, "left out": _span(left_out), **sums})
    yield from rows
    labels = np.array([row["labels"] for row in rows])
    frames = [len(each.timestamps) for each in scenes]
    labelled = [frames_with_two_classes(each.truth, dict.fromkeys(thresholds, 0.0)) for each in scenes]
    twice = [frames_with_two_classes(each.found, thresholds) for each in judged_by]
    share = "{:.3f} ({:.3f})".format(*np.average([twice, labelled], axis=1, weights=frames))
    for name, weight in (("mean", np.ones(len(rows))), ("by labels", labels)):
        means = {key: float(np.average([row[key] for row in rows], weights=weight)) for key in list(rows[0])[1:5]}
        left_out = [each.overall.amota for each in others] if name == "mean" else []
        sums = {key: sum(row[key] for row in rows) for key in list(rows[0])[6:]}
        yield {"class": name, **means, "left out": _span(left_out), **sums, "frames with two classes": share}


def _span(values: Sequence[float]) -> str:
    return f"{min(values):.3f} to {max(values):.3f}" if values else "-"


def _means(found: SceneBoxes) -> FloatArray:
    return track_means(found.score, np.unique(found.id, return_inverse=True)[1])


def rank_quality(true: FloatArray, false: FloatArray) -> float:
    """The probability that the score of a true box (n,) is above that of a false one (m,), ties counted half; NaN
    where there are none of either (Mann and Whitney 1947)."""
    if not len(true) or not len(false):
        return float("nan")
    ordered = np.sort(false)
    below, up_to = np.searchsorted(ordered, true, "left"), np.searchsorted(ordered, true, "right")
    return float((below + up_to).mean() / (2 * len(false)))


def _judged(scene: NuScenesTrackingScene, detections: PlacedBoxes, label: str) -> tuple[FloatArray, StrArray]:
    """Scores (n,) of the boxes of a class, and whether each is of an object, or what kind of ghost."""
    true, found = in_range(scene)
    found = found.select(np.flatnonzero(found.boxes.label == label))
    mine, kind = (found.frame, found.boxes), np.full(len(found.frame), "clutter", dtype="<U12")
    truth = (true.frame, true.boxes)
    detected = np.isin(np.arange(len(kind)), near_pairs(mine, detections, GATE)[0])
    any_class = (true.frame, replace(true.boxes, label=np.full(len(true.frame), label)))
    kind[~detected] = "coasting"
    kind[near_pairs(mine, any_class, GATE)[0]] = "other class"
    kind[near_pairs(mine, truth, GATE)[0]] = "beside"
    kind[nearest_pairs(mine, truth, GATE)[0]] = OBJECT
    return found.score, kind


def _matching(scene: NuScenesTrackingScene) -> BoolArray:
    """(N,) which boxes are of tracks that some labelled object of their class is ever near."""
    found = scene.found
    near, _, _ = near_pairs((found.frame, found.boxes), (scene.truth.frame, scene.truth.boxes), GATE)
    return np.isin(found.id, found.id[near])


def frames_with_two_classes(result: SceneBoxes, thresholds: Mapping[str, float] | None = None) -> float:
    """Share of the frames with boxes in which a place is reported as two classes.

    thresholds  least score by class, `LOW_SCORE` where it is not known
    """
    scores = [(thresholds or {}).get(label, LOW_SCORE) for label in result.boxes.label.tolist()]
    shown, frames = result.score >= np.array(scores), np.unique(result.frame)
    twice = 0
    for frame in frames:
        boxes = result.boxes.select(np.flatnonzero((result.frame == frame) & shown))
        a, b = touching_pairs(boxes, boxes)
        other = boxes.label[a] < boxes.label[b]
        twice += bool((paired_bev_iou(boxes.select(a[other]), boxes.select(b[other])) > TWICE).any())
    return twice / max(len(frames), 1)


VERSION = "v1.0-mini"
Runs = Mapping[str, TrackedScene]
"""A tracker's output by scene."""


@dataclass(frozen=True)
class RecordingOptions:
    """Recordings that are tracked."""

    sets: Annotated[
        str | None,
        typer.Option(
            "--sets",
            help="Of megvii, centerpoint, camera, kitti, simulated; either LiDAR on the camera's scene, alone and with "
            "it: megvii_alone, megvii_fused, centerpoint_alone, centerpoint_fused; confused (classes); with made "
            "detections ngsim, ngsim_without_road (no lanes, no lights), openacc, dut, av2, crossings (simulated, "
            "no signals), eth_ucy and crowds (simulated).  [default: the first five]",
        ),
    ] = None
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Simulated scenes.")] = 10
    viewpoint: Annotated[
        str | None,
        typer.Option(
            "--viewpoint",
            help="Of the sensors in the sets ngsim, openacc, dut, av2 and crossings: mast, above, where nothing is "
            "hidden, vehicle, the id of one, or X,Y,Z in m.  [default: above in gaps, else mast, vehicle, above]",
        ),
    ] = None
    test: Annotated[str | None, typer.Option("--test", help="Take these recordings alone, with commas.")] = None


@dataclass(frozen=True, eq=False)
class Score:
    """Headline figures of some scenes, by their numbers, of which any may occur more than once; errors at the labels,
    scene by scene; figures class by class, where there are such."""

    figures_of: Callable[[Sequence[int]], dict[str, float]]
    errors: tuple[LabelErrors, ...]
    class_rows: Callable[[], Iterable[Mapping[str, Any]]] = tuple


@dataclass(frozen=True, eq=False)
class RecordingSet:
    """Scenes of one kind, with ground truth.

    score     judges a tracker's output on all scenes
    clusters  for each scene the first of those that overlap with it in time; none where none do
    """

    name: str
    family: Family
    dataset: Dataset
    score: Callable[[Runs], Score]
    clusters: Mapping[str, str] = field(default_factory=dict)

    def scene(self, recording: str) -> Scene:
        """Read a recording."""
        return self.dataset.scene(recording)

    @property
    def units(self) -> list[list[int]]:
        """The scenes by their numbers, those that overlap together."""
        found: dict[str, list[int]] = {}
        for row, name in enumerate(self.dataset.scenes):
            found.setdefault(self.clusters.get(name, name), []).append(row)
        return list(found.values())


def _nuscenes(name: str, split: str, files: Mapping[str, str], data: Path) -> RecordingSet:
    """nuScenes with the detections of each sensor from its file."""
    root = data / "nuscenes"
    detections = {sensor: root / "detections" / file for sensor, file in files.items()}
    dataset = NuScenes(root, VERSION, detections, split_scenes(root, VERSION, split), ground_truth=True)

    def score(runs: Runs) -> Score:
        """Write the official result, read it back, and score it."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "tracks.json"
            write_tracking_results(path, ((run.scene, run.tracks) for run in runs.values()), dataset.meta)
            scored = read_scored_scenes(path, root, VERSION, tuple(runs))
        scenes = [each.tracking for each in scored.values()]

        def figures_of(rows: Sequence[int]) -> dict[str, float]:
            f = nuscenes_tracking_metrics([scenes[row] for row in rows]).overall
            return {"AMOTA": f.amota, "AMOTP": f.amotp, "MOTA": f.mota, "IDS": f.ids, "FRAG": f.frag}

        placed = [placed_detections(runs[name].scene) for name in scored]
        errors = tuple(nuscenes_label_errors(*pair) for pair in zip(scenes, placed, strict=True))
        return Score(figures_of, errors, partial(class_rows, scenes, placed))

    return RecordingSet(name, "nuscenes", dataset, score)


def _kitti(data: Path) -> RecordingSet:
    root, detections = data / "kitti", data / "kitti" / "detections" / "pointrcnn"
    dataset = KittiTracking(root, detections, None, ground_truth=True)

    def score(runs: Runs) -> Score:
        """Write the official results, read them back, and score them, in 3D and averaged over recall."""
        with tempfile.TemporaryDirectory() as folder:
            results = Path(folder) / "results"
            write_kitti_results(results, dataset, ((run.scene, run.tracks) for run in runs.values()))
            scored = read_scored_sequences(results, root, tuple(runs), detections)
        pairs = [KittiTrackingSequence(each.labels, each.result) for each in scored.values()]

        def figures_of(rows: Sequence[int]) -> dict[str, float]:
            figures: dict[str, float] = {}
            for label, iou in (*((label, 0.25) for label in CLASSES), ("car", 0.5)):
                f = kitti_tracking_metrics([pairs[row] for row in rows], label, iou)
                if f is not None:
                    name = label if iou == 0.25 else f"{label} at {iou:g}"
                    own = {"sAMOTA": f.samota, "safe sAMOTA": f.samota_safe, "AMOTA": f.amota, "MOTA": f.mota}
                    figures |= {f"{name} {key}": value for key, value in (own | {"IDS": float(f.ids)}).items()}
            return figures

        return Score(figures_of, tuple(kitti_label_errors(each) for each in scored.values()))

    return RecordingSet("kitti", "kitti", dataset, score)


def exact_set(name: str, family: Family, dataset: Dataset, clusters: Mapping[str, str] | None = None) -> RecordingSet:
    """Scenes with the exact truth at every frame, hidden objects by the track that last followed them."""
    return RecordingSet(name, family, dataset, _against_truth, clusters or {})


def _against_truth(runs: Runs) -> Score:
    metrics, errors, found = [], [], []
    for run in runs.values():
        truth = run.scene.ground_truth
        assert truth is not None
        metrics.append(scene_metrics(truth, run.tracks))
        labels = SceneBoxes.of_annotations(truth, hidden=False)
        found.append(SceneBoxes.of_tracks(run.tracks))
        errors.append(label_errors(labels, found[-1], labels.boxes.velocity))
    twice = [frames_with_two_classes(each) for each in found]

    def figures_of(rows: Sequence[int]) -> dict[str, float]:
        m = SceneMetrics.pool(metrics[row] for row in rows)
        share = float(np.mean([twice[row] for row in rows]))
        return {"MOTA": m.mota, "IDS": float(m.switches), "hidden RMSE": m.carried.rmse, "two classes": share}

    return Score(figures_of, tuple(errors))


def simulated_set(scenes: int, seed: int = 0, settings: SimulatorSettings | None = None) -> RecordingSet:
    """Simulated traffic."""
    return exact_set("simulated", "simulated", SimulatedTraffic(settings, scenes, seed))


def confused_set(scenes: int) -> RecordingSet:
    """Simulated traffic whose sensors take cars, trucks and buses for one another."""
    settings = SimulatorSettings()
    right = {"lidar": 0.9, "camera": 0.7}
    sensors = {name: replace(settings.sensors[name], class_accuracy=share) for name, share in right.items()}
    return replace(simulated_set(scenes, settings=replace(settings, sensors=sensors)), name="confused")


def recording_set(
    name: str, data: Path | None, scenes: int, viewpoint: str | None = None, longest: float = inf
) -> RecordingSet:
    """A set by name; `data` holds a folder for each kind of recordings, `scenes` simulated ones are made.

    viewpoint  of the sensors that see recorded traffic, see `benchmarks.recordings.sources`; None: the set's own
    longest    of recorded traffic, s, from the middle of longer recordings

    Raises `InputError` for missing recordings.
    """
    if name == "simulated":
        return simulated_set(scenes)
    if name == "confused":
        return confused_set(scenes)
    if name == "crowds":
        return _crowded(name, simulated_crowds(scenes).middle(longest), viewpoint)
    if name == "crossings":
        return _sensed(name, simulated_crossings(scenes).middle(longest), viewpoint or ABOVE)
    if data is None:
        raise InputError(f"set {name}: expected --data DIR with the folders of recordings")
    if name in SETS | FUSION_SETS:
        return (SETS | FUSION_SETS)[name](data)
    if name == "eth_ucy":
        return _crowded(name, recorded_crowds(data / name).middle(longest), viewpoint)
    traffic, usual = TRAFFIC_SETS[name]
    recordings = traffic(data / name.removesuffix(WITHOUT_ROAD)).middle(longest)
    clusters = overlapping(map(recordings.read, recordings.names)) if name.startswith("ngsim") else {}
    return _sensed(name, recordings, viewpoint or usual, clusters)


def _sensed(
    name: str, recordings: Recordings, viewpoint: str, clusters: Mapping[str, str] | None = None
) -> RecordingSet:
    sensed = partial(sensed_scene, viewpoint=viewpoint, settings=None, seed=0)
    return exact_set(name, "traffic", TrafficScenes(recordings, sensed), clusters)


def _crowded(name: str, recordings: Recordings, viewpoint: str | None) -> RecordingSet:
    """Pedestrians seen at the rate of annotated recordings."""
    settings = default_sensors()
    settings = replace(settings, sensors={key: replace(one, rate=RATE) for key, one in settings.sensors.items()})
    sensed = partial(sensed_scene, viewpoint=viewpoint or MAST, settings=settings, seed=0)
    return exact_set(name, "traffic", TrafficScenes(recordings, sensed))


def chosen_sets(
    sets: str | None,
    data: Path | None,
    scenes: int,
    test: str | None = None,
    viewpoint: str | None = None,
    longest: float | None = None,
    usual: str | None = None,
) -> list[RecordingSet]:
    """The sets that options name, or all that need no --sets; with `test` those of its recordings alone.

    usual  viewpoint where none is named, in place of that of a set

    Raises `InputError` for a recording that no set has, and for options of recorded traffic without it.
    """
    wanted = (
        chosen(
            "--sets",
            sets,
            (*SETS, *FUSION_SETS, *TRAFFIC_SETS, "eth_ucy", "simulated", "confused", "crowds", "crossings"),
        )
        if sets
        else (*(SETS if data is not None else ()), "simulated")
    )
    trajectories = (*TRAFFIC_SETS, "eth_ucy", "crowds", "crossings")
    for option, value in (("--viewpoint", viewpoint), ("--longest", longest)):
        if value is not None and not set(wanted) & set(trajectories):
            raise InputError(f"{option}: expected {' or '.join(trajectories)} among --sets, others do not use it")
    found = [recording_set(name, data, scenes, viewpoint or usual, longest or inf) for name in wanted]
    if test is None:
        return found
    named = chosen("--test", test, [name for one in found for name in one.dataset.scenes])
    mine = ((one, [name for name in one.dataset.scenes if name in named]) for one in found)
    return [replace(one, dataset=ChosenScenes(one.dataset, ",".join(some))) for one, some in mine if some]


_MEGVII, _CENTERPOINT = {"lidar": "megvii_lidar.json"}, {"lidar": "centerpoint_lidar.json"}
_CAMERA = {"camera": "fastbev_camera.json"}
SETS: dict[str, Callable[[Path], RecordingSet]] = {
    "megvii": partial(_nuscenes, "megvii", "mini_train", _MEGVII),
    "centerpoint": partial(_nuscenes, "centerpoint", "lidar_centerpoint", _CENTERPOINT),
    "camera": partial(_nuscenes, "camera", "camera", _CAMERA),
    "kitti": _kitti,
}
FUSION_SETS: dict[str, Callable[[Path], RecordingSet]] = {
    "megvii_alone": partial(_nuscenes, "megvii alone", "camera", _MEGVII),
    "megvii_fused": partial(_nuscenes, "megvii and camera", "camera", _MEGVII | _CAMERA),
    "centerpoint_alone": partial(_nuscenes, "centerpoint alone", "camera", _CENTERPOINT),
    "centerpoint_fused": partial(_nuscenes, "centerpoint and camera", "camera", _CENTERPOINT | _CAMERA),
}
WITHOUT_ROAD = "_without_road"  # of a name: neither lanes nor lights are given
TRAFFIC_SETS: dict[str, tuple[Callable[[Path], Recordings], str]] = {
    "ngsim": (ngsim_windows, MAST),
    "ngsim" + WITHOUT_ROAD: (partial(ngsim_windows, road="none"), MAST),
    "openacc": (openacc_platoons, VEHICLE),
    "dut": (dut_clips, MAST),
    "av2": (argoverse_logs, MAST),
}
"""Recorded traffic, whose detections are made, and the usual viewpoint; taken only where it is asked for."""
