"""The coasting error: where are objects that no detection shows for two seconds, while others stay visible?

Objects that are labelled long enough are dealt into a few rounds. In each round every object of its share is hidden for
two seconds, at a random time once it has been followed for a while: the detections near its label are taken away. All
else is seen as ever. The error is that of the track that followed the object when it was last seen, at the moments of
the window; a lost one is charged with the cap. Nothing is given up while it coasts, by any method, so that it is the
prediction that is compared and not how soon a track is ended.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from data_tools.metrics import ErrorSample, SceneMetricSettings, scene_metrics
from pipelines.bench.variants import Variant, changed
from pipelines.config import TrackConfig
from pipelines.tracking import track_scene
from saga_fg.numerics.arrays import BoolArray, FloatArray, IntArray
from saga_fg.types.dataset import Annotations, Scene
from saga_fg.types.frame import Frame

HIDDEN, FOLLOWED = 2.0, 1.5  # s: for so long hidden, after so long in view
ROUNDS = 2
REACH = 2.0  # m from a label to the detections that are taken away
NEVER_GIVEN_UP = {
    "tracker.report_coasting": 2 * HIDDEN,
    "tracker.classes.*.max_coasting": 2 * HIDDEN,
    "tracker.max_out_of_view": inf,
    "tracker.existence.delete_below": 0.0,
    "tracker.existence.report_above": 0.0,
}
CAP = SceneMetricSettings(cap=10.0)


@dataclass(frozen=True, eq=False)
class Windows:
    """W objects by name, each hidden from start to stop (W,), s."""

    name: tuple[str, ...]
    start: FloatArray
    stop: FloatArray


def coasting_errors(scene: Scene, base: TrackConfig, methods: Sequence[Variant], seed: int) -> dict[str, ErrorSample]:
    """The errors of each method on one scene, m. The scene has ground truth."""
    assert scene.ground_truth is not None
    rng = np.random.default_rng(seed)
    windows = _windows(scene, rng)
    shares = np.array_split(rng.permutation(len(windows.name)), ROUNDS)
    errors: dict[str, list[ErrorSample]] = {method.name: [] for method in methods}
    for share in shares:
        if len(share) == 0:
            continue
        chosen = Windows(tuple(windows.name[row] for row in share), windows.start[share], windows.stop[share])
        frames = [_without_hidden(frame, scene, chosen) for frame in scene.frames]
        truth = [
            replace(moment, visible=~_hidden(moment.id.tolist(), time, chosen))
            for moment, time in zip(scene.ground_truth, scene.timestamps.tolist(), strict=True)
        ]
        for method in methods:
            tracker = kept_alive(method.config(base)).new_tracker(method.method)
            tracks = track_scene(replace(scene, frames=frames, ground_truth=truth), tracker).tracks
            errors[method.name].append(scene_metrics(truth, tracks, CAP).carried)
    return {name: ErrorSample.pool(parts) for name, parts in errors.items()}


def kept_alive(config: TrackConfig) -> TrackConfig:
    """The configuration with tracks that live, and are reported, for as long as anything is hidden."""
    for name, value in NEVER_GIVEN_UP.items():
        config = changed(config, name, value)
    return config


def _windows(scene: Scene, rng: np.random.Generator) -> Windows:
    """One window for each object that is labelled, and visible, long enough."""
    assert scene.ground_truth is not None
    seen: dict[str, list[float]] = {}
    for time, moment in zip(scene.timestamps.tolist(), scene.ground_truth, strict=True):
        for name in moment.id[moment.visible].tolist():
            seen.setdefault(name, []).append(time)
    names, starts = [], []
    for name, times in seen.items():
        latest = times[-1] - HIDDEN
        if latest >= times[0] + FOLLOWED:
            names.append(name)
            starts.append(rng.uniform(times[0] + FOLLOWED, latest))
    start = np.array(starts)
    return Windows(tuple(names), start, start + HIDDEN)


def _hidden(names: Sequence[str], time: float, windows: Windows) -> BoolArray:
    """Mask (N,) of the objects that are hidden at a time."""
    now = {n for n, a, b in zip(windows.name, windows.start, windows.stop, strict=True) if a <= time <= b}
    return np.array([name in now for name in names], dtype=np.bool_)


def _without_hidden(frame: Frame, scene: Scene, windows: Windows) -> Frame:
    """The frame without the detections near hidden objects."""
    assert scene.ground_truth is not None
    k = int(np.argmin(np.abs(scene.timestamps - frame.timestamp)))
    moment: Annotations = scene.ground_truth[k]
    rows: IntArray = np.flatnonzero(_hidden(moment.id.tolist(), frame.timestamp, windows))
    if len(rows) == 0 or len(frame) == 0:
        return frame
    boxes = moment.boxes.select(rows)
    there = boxes.position[:, :2] + np.nan_to_num(boxes.velocity) * (frame.timestamp - scene.timestamps[k])
    offset = frame.detections.boxes.position[:, None, :2] - there
    same = frame.detections.boxes.label[:, None] == boxes.label
    near = ((np.hypot(offset[..., 0], offset[..., 1]) < REACH) & same).any(axis=1)
    return replace(frame, detections=frame.detections.select(~near))
