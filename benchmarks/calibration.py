"""Do the ellipses of a table of one's own hold what they say, when nothing is known of its noise?

Tables are made of labelled objects, each detected nine times in ten with white errors of one standard deviation, or are
the detections of a real detector without its name. They are tracked with the settings of one's own tables, as they are
and with the noise of the model left as it is (`calibrate_noise`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
import typer

from benchmarks.recording_sets import recording_set
from benchmarks.runner import Data, Rows, Seed, each
from data_tools.metrics import SceneBoxes, coverages, label_errors
from pipelines.config import TrackConfig, load_config
from pipelines.tracking import track_scene
from saga_fg import Detections, Frame, InputError
from saga_fg.types import DEFAULT, Scene

DETECTED, SCORE = 0.9, 0.9
SENSOR = "table"


def calibration(
    sets: Annotated[str, typer.Option("--sets", help="As of `tracking`, with commas.")] = "simulated",
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Of each set, at most.")] = 4,
    deviations: Annotated[str, typer.Option("--deviations", help="Of made detections, m.")] = "0.1,0.3,1",
    data: Data = None,
    seed: Seed = 0,
) -> Rows:
    """The share of errors that ellipses of 50 and 90 % hold, with and without noise told by the detections.

    \b
    Examples:
      python -m benchmarks calibration
      python -m benchmarks calibration --sets ngsim,megvii,kitti --data data
    """
    file = load_config("file")
    as_assumed = replace(file, sensors={DEFAULT: replace(file.sensors[DEFAULT], calibrate_noise=False)})
    for name in sets.split(","):
        known = recording_set(name, data, scenes)
        parts = [known.scene(one) for one in known.dataset.scenes[:scenes]]
        tables = {
            f"white, {sigma:g} m": [_made(part, sigma, seed) for part in parts] for sigma in positives(deviations)
        }
        tables["as detected"] = [_unnamed(part) for part in parts]
        for kind, made in each(list(tables.items()), name):
            for how, config in (("told by detections", file), ("as assumed", as_assumed)):
                figures = _figures(made, config)
                yield "ellipses of one's own table", {"set": name, "detections": kind, "noise": how, **figures}


def positives(text: str) -> list[float]:
    """Numbers above 0 with commas between them. Raises `InputError` for others."""
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if not found or not all(0 < one < np.inf for one in found):
        raise InputError(f"--deviations: expected numbers > 0 with commas between them, got {text[:40]!r}")
    return found


def _made(scene: Scene, sigma: float, seed: int) -> Scene:
    """A scene whose objects in view are detected with white errors, m."""
    rng, frames = np.random.default_rng(seed), []
    assert scene.ground_truth is not None
    for time, truth in zip(scene.timestamps.tolist(), scene.ground_truth, strict=True):
        boxes = truth.boxes.select(np.flatnonzero(truth.visible & (rng.random(len(truth)) < DETECTED)))
        position = boxes.position + np.column_stack([rng.normal(0, sigma, (len(boxes), 2)), np.zeros(len(boxes))])
        boxes = replace(boxes, position=position, velocity=np.full_like(boxes.velocity, np.nan))
        frames.append(Frame(time, SENSOR, Detections(boxes, np.full(len(boxes), SCORE))))
    return replace(scene, frames=frames)


def _unnamed(scene: Scene) -> Scene:
    """A scene whose detections do not say which detector they are of; logits become probabilities."""
    score = np.concatenate([np.zeros(1), *(frame.detections.score for frame in scene.frames)])
    logits = bool((score > 1).any() or (score < 0).any())

    def renamed(frame: Frame) -> Frame:
        found = frame.detections
        found = replace(found, score=1 / (1 + np.exp(-found.score))) if logits else found
        return replace(frame, sensor=SENSOR, detections=found)

    return replace(scene, frames=[renamed(frame) for frame in scene.frames])


def _figures(scenes: list[Scene], config: TrackConfig) -> dict[str, float]:
    nees, position = [], []
    scale: list[float] = []
    for scene in scenes:
        run = track_scene(scene, config.new_tracker("saga"))
        assert scene.ground_truth is not None
        truth = SceneBoxes.of_annotations(scene.ground_truth, hidden=False)
        errors = label_errors(truth, SceneBoxes.of_tracks(run.tracks), np.full((len(truth), 2), np.nan))
        nees.append(errors.nees[np.isfinite(errors.nees)])
        position.append(errors.position[errors.tracked])
        scale += run.noise.values()
    held = coverages(np.concatenate(nees), (0.5, 0.9))
    error = np.concatenate(position)
    figures = {f"in {share:.0%}": value for share, value in held.items()}
    return {
        "boxes": float(len(error)),
        **figures,
        "RMSE, m": float(np.sqrt(np.mean(error**2))),
        "scale": float(np.median(scale or [1.0])),
    }
