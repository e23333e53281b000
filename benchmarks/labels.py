"""Labels from detections, and from the tracks of other trackers: as they are, refined, with shuffled identities.

as given    tracks of the method, whose table says which boxes are predictions
refined     `saga-fg smooth --tracks`; shuffled: after the identities of every frame were exchanged at random, so that
            the boxes alone are left
together    both methods' tracks refined to one result
detections  labels from the detections that all of them had, by `saga-fg smooth`; tracked: by `saga-fg track`
headings    of these labels: the share that is turned round, of boxes that match a true object, all and handed out
doubt       of these labels: how often what they say with a probability is so
corrected   by an annotator who knows the truth and looks at a tenth of their tracks (`benchmarks.annotator`)
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.annotator import Answers, Corrected, JudgedLabels, judged, moments_of
from benchmarks.recording_sets import RecordingOptions, RecordingSet, chosen_sets
from benchmarks.runner import Data, Row, Rows, Seed, each
from data_tools.datasets.given_tracks import sensor_names, with_tracks
from data_tools.datasets.results import SceneResult
from data_tools.metrics import LabelErrors, SceneBoxes, error_summary
from pipelines.config import Method, load_config
from pipelines.smoothing import for_given_tracks, label_model, load_smooth_config, smooth_scene
from pipelines.tracking import TrackedScene, track_scene
from saga_fg.smoothing import LabelBuilder
from saga_fg.types import Scene, Tracks

METHODS: tuple[Method, ...] = ("centerpoint", "kf")
GRAPH: Method = "saga"


def labels(*, data: Data = None, recorded: RecordingOptions, seed: Seed = 0) -> Rows:
    """Refine the tracks of the methods centerpoint and kf, and label the same detections.

    \b
    Examples:
      python -m benchmarks labels --sets simulated --scenes 4
      python -m benchmarks labels --data data --sets megvii,centerpoint,kitti
    """
    for recordings in chosen_sets(recorded.sets, data, recorded.scenes, recorded.test, recorded.viewpoint):
        yield from set_rows(recordings, seed)


def set_rows(recordings: RecordingSet, seed: int) -> Iterable[Row]:
    """A row for each way to the labels."""
    runs: dict[str, dict[str, TrackedScene]] = {}
    online, offline = load_config(recordings.family), load_smooth_config(recordings.family)
    rng, answers, judgements = np.random.default_rng(seed), Answers(), list[JudgedLabels]()
    corrected = Corrected(np.random.default_rng(seed))
    for name in each(recordings.dataset.scenes, recordings.name):
        scene = recordings.scene(name)
        given: dict[str, SceneResult] = {}
        for method in (GRAPH, *METHODS):
            run = track_scene(scene, online.of_method(method).new_tracker(method))
            runs.setdefault("detections, tracked" if method == GRAPH else f"{method}, as given", {})[name] = run
            coasting = np.concatenate([each.coasting for each in run.tracks])
            given[method] = SceneResult(scene, SceneBoxes.of_tracks(run.tracks), coasting=coasting)
        del given[GRAPH]
        start = time.perf_counter()
        builder = LabelBuilder(offline.tracking.new_tracker(GRAPH), label_model(offline, GRAPH))
        builder.add(scene.frames, scene.timestamps)
        made, _ = builder.finish()
        corrected.add(scene, builder, made, time.perf_counter() - start)
        moments = moments_of(made)
        judgements.append(judged(scene, moments))
        answers.add(judgements[-1], moments)
        runs.setdefault("detections, labels", {})[name] = as_run(scene, [moment.tracks for moment in moments])
        wanted = {f"{method}, refined": [result] for method, result in given.items()}
        wanted |= {f"{method}, shuffled": [shuffled(result, rng)] for method, result in given.items()}
        for variant, results in (wanted | {"together, refined": list(given.values())}).items():
            settings = for_given_tracks(offline, [{name: result} for result in results])
            named = dict(zip(sensor_names(len(results)), results, strict=True))
            labelled = smooth_scene(with_tracks(named, replace(scene, frames=())), settings)
            runs.setdefault(variant, {})[name] = as_run(scene, labelled.tracks)
    for variant, found in sorted(runs.items()):
        yield f"{recordings.name}: {len(found)} scenes", {"labels": variant, **figures(recordings, found)}
    for row in heading_rows(judgements):
        yield f"{recordings.name}: headings", row
    for row in answers.rows():
        yield f"{recordings.name}: doubt", row
    for row in corrected.rows():
        yield f"{recordings.name}: corrected", row


def heading_rows(scenes: Sequence[JudgedLabels]) -> Iterable[dict[str, Any]]:
    """A row for each class."""
    matches = [scene.own >= 0 for scene in scenes]
    label = np.concatenate([scene.found.boxes.label[rows] for scene, rows in zip(scenes, matches, strict=True)])
    turned, kept = (
        np.concatenate([getattr(scene, name)[rows] for scene, rows in zip(scenes, matches, strict=True)])
        for name in ("turned", "kept")
    )
    for name in np.unique(label).tolist():
        mine = label == name
        handed = mine & kept
        shares = {"all": turned[mine].mean(), "handed out": turned[handed].mean() if handed.any() else np.nan}
        yield {"class": name, "boxes": int(mine.sum()), "of them handed out": int(handed.sum()), **shares}


def as_run(scene: Scene, tracks: Sequence[Tracks]) -> TrackedScene:
    """Labels as a tracker's output."""
    return TrackedScene(scene, tuple(tracks), ())


def figures(recordings: RecordingSet, found: Mapping[str, TrackedScene]) -> dict[str, float]:
    """The figures of a set, and the errors at labels, m and m/s."""
    score = recordings.score(found)
    errors = error_summary(LabelErrors.pool(score.errors))
    return {**score.figures_of(range(len(found))), "position": errors.position, "velocity": errors.velocity}


def shuffled(result: SceneResult, rng: np.random.Generator) -> SceneResult:
    """The result with the identities of each frame exchanged at random."""
    found = result.found
    order = np.lexsort((rng.random(len(found)), found.frame))
    return replace(result, found=replace(found, id=found.id[order]))
