"""What a second sensor is worth, on simulated traffic seen by a LiDAR and a camera.

* Accuracy: AMOTA of the nuScenes tracking task over all scenes, of each sensor alone and of both; paired bootstrap over
  the scenes. What no sensor can see counts neither for a tracker nor, where it carries it on, against it.
* A gap: the better sensor says nothing for some seconds in the middle. Of the objects that were followed before and
  stay in the other sensor's view, how many are followed by the same track at the end of the gap?
* A poor sensor joins: wide noise, few true detections, much clutter, scores that tell nothing. What does it cost?
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from data_tools.metrics import (
    Interval,
    NuScenesTrackingScene,
    SceneBoxes,
    match_scene,
    nuscenes_tracking_metrics,
)
from data_tools.simulator import SensorSettings, SimulatorSettings, simulate_scene
from pipelines.bench.drawn_differences import FiguresOf, drawn_differences
from pipelines.config import Method, TrackConfig
from pipelines.tracking import Progress, track_scene
from saga_fg.numerics.arrays import BoolArray
from saga_fg.types.by_class import DEFAULT
from saga_fg.types.dataset import Scene
from saga_fg.types.sensor import NoiseModel, ScoreCalibration, Sensor, sensor_model
from saga_fg.types.track import Tracks

DRAWS = 100  # of scenes, for the intervals
BOTH, WITH_POOR, POOR = "both", "both and a poor one", "poor"


@dataclass(frozen=True, eq=False)
class FusionResult:
    """amota: of each contender, over all scenes; better: the better single sensor; gain: of both over it.

    survival  share of objects that kept their track through the gap: with both, and with the better sensor alone
    followed  number of objects these shares are of;  poor_loss: AMOTA with the poor sensor less that without
    """

    amota: dict[str, float]
    better: str
    gain: Interval
    survival: dict[str, float]
    followed: int
    poor_loss: Interval
    seeds: tuple[int, ...]


def poor_sensor() -> SensorSettings:
    """A sensor that sees half of what there is, metres off, and as much that is not there."""
    return SensorSettings(
        rate=8.0,
        offset=0.017,
        range_noise=(1.0, 0.05),
        bearing_noise=(0.5, 0.02),
        height_noise=0.5,
        size_noise=0.3,
        yaw_noise=1.0,
        detection_probability=0.5,
        clutter_rate=15.0,
        true_logit=0.0,
        clutter_logit=0.0,
        logit_noise=1.0,
    )


def poor_model() -> Sensor:
    """What the tracker is told of it."""
    return Sensor(
        noise={DEFAULT: NoiseModel(position=1.0, range_noise=0.06, bearing_noise=0.03, yaw=1.0, height=0.5)},
        detection_probability=0.4,
        calibration={DEFAULT: ScoreCalibration(slope=0.1, offset=-0.5)},
        initiation="confirmed",
    )


def fusion(
    config: TrackConfig,
    seeds: Sequence[int],
    gap: float = 3.0,
    method: Method = "saga",
    simulator: SimulatorSettings | None = None,
    progress: Progress | None = None,
) -> FusionResult:
    """Track the scenes of these seeds with each sensor, with both, through a gap of `gap` s, and with a poor one."""
    simulator = simulator or SimulatorSettings()
    singles = tuple(simulator.sensors)
    with_poor = replace(config, sensors={**config.sensors, POOR: poor_model()})
    compared: dict[str, list[NuScenesTrackingScene]] = {name: [] for name in (*singles, BOTH, WITH_POOR)}
    scenes = []
    for seed in seeds:
        scene = simulate_scene(simulator, seed)
        poor = simulate_scene(replace(simulator, sensors={POOR: poor_sensor()}), seed)
        seen = {name: of_sensors(scene, (name,)) for name in singles} | {BOTH: scene, WITH_POOR: _joined(scene, poor)}
        for name, part in seen.items():
            compared[name].append(on_visible(scene, track_scene(part, with_poor.new_tracker(method)).tracks))
        scenes.append(scene)
        if progress is not None:
            progress("tracking", len(scenes), len(seeds))
    figures = {name: _amota(of_name) for name, of_name in compared.items()}
    amota = {name: figures_of(range(len(scenes)))["AMOTA"] for name, figures_of in figures.items()}
    better = max(singles, key=lambda name: amota[name])
    others = {name: sensor_model(config.sensors, name) for name in singles if name != better}
    kept: dict[str, list[BoolArray]] = {BOTH: [], better: []}
    for done, scene in enumerate(scenes):
        for name, part in ((BOTH, scene), (better, of_sensors(scene, (better,)))):
            tracks = track_scene(without(part, better, gap), config.new_tracker(method)).tracks
            kept[name].append(survived(scene, tracks, others, gap))
        if progress is not None:
            progress("through the gap", done + 1, len(seeds))
    followed = {name: np.concatenate(found) for name, found in kept.items()}
    return FusionResult(
        amota=amota,
        better=better,
        gain=_gain(figures[BOTH], figures[better], len(scenes)),
        survival={name: float(found.mean()) if len(found) else float("nan") for name, found in followed.items()},
        followed=len(followed[BOTH]),
        poor_loss=_gain(figures[WITH_POOR], figures[BOTH], len(scenes)),
        seeds=tuple(seeds),
    )


def of_sensors(scene: Scene, names: Sequence[str]) -> Scene:
    """The scene as these sensors saw it."""
    return replace(scene, frames=tuple(frame for frame in scene.frames if frame.sensor in names))


def without(scene: Scene, sensor: str, gap: float) -> Scene:
    """The scene, where a sensor says nothing for `gap` s in the middle."""
    first, last = _gap(scene, gap)
    silent = [frame.sensor == sensor and first < frame.timestamp <= last for frame in scene.frames]
    return replace(scene, frames=tuple(f for f, off in zip(scene.frames, silent, strict=True) if not off))


def survived(scene: Scene, tracks: Sequence[Tracks], sensors: Mapping[str, Sensor], gap: float) -> BoolArray:
    """Of the objects followed when the gap begins, which have the same track at its end.

    Only those count that are visible and in view of one of `sensors` throughout.
    """
    assert scene.ground_truth is not None
    first, last = _gap(scene, gap)
    before = int(np.searchsorted(scene.timestamps, first, side="right")) - 1
    after = int(np.searchsorted(scene.timestamps, last, side="right")) - 1
    stay = None
    for k in range(before, after + 1):
        truth = scene.ground_truth[k]
        seen = np.zeros(len(truth), dtype=bool)
        for sensor in sensors.values():
            seen |= sensor.sees(truth.boxes.position[:, :2], scene.world_T_ego[k])
        names = set(truth.id[truth.visible & seen].tolist())
        stay = names if stay is None else stay & names
    matchings = match_scene(scene.ground_truth, tracks)
    carriers = []
    for k in (before, after):
        m = matchings[k]
        ids = scene.ground_truth[k].id[m.object_row].tolist()
        carriers.append(dict(zip(ids, tracks[k].id[m.track_row].tolist(), strict=True)))
    followed = sorted(name for name in stay or () if name in carriers[0])
    return np.array([carriers[1].get(name) == carriers[0][name] for name in followed], dtype=np.bool_)


def on_visible(scene: Scene, tracks: Sequence[Tracks]) -> NuScenesTrackingScene:
    """The scene as it is scored: without the objects that no sensor can see, and without the boxes that follow them."""
    assert scene.ground_truth is not None
    scored = []
    for truth, found, pairs in zip(scene.ground_truth, tracks, match_scene(scene.ground_truth, tracks), strict=True):
        counts = np.ones(len(found), dtype=bool)
        counts[pairs.track_row[~truth.visible[pairs.object_row]]] = False
        scored.append(found.select(counts))
    return NuScenesTrackingScene(
        scene.timestamps,
        scene.world_T_ego[:, :2, 3],
        SceneBoxes.of_annotations(scene.ground_truth, hidden=False),
        SceneBoxes.of_tracks(scored),
    )


def _gap(scene: Scene, gap: float) -> tuple[float, float]:
    middle = (scene.timestamps[0] + scene.timestamps[-1]) / 2
    return float(middle - gap / 2), float(middle + gap / 2)


def _joined(scene: Scene, other: Scene) -> Scene:
    frames = sorted((*scene.frames, *other.frames), key=lambda frame: (frame.timestamp, frame.sensor))
    return replace(scene, frames=tuple(frames))


def _amota(scenes: Sequence[NuScenesTrackingScene]) -> FiguresOf:
    """Of drawn scenes; what was drawn before is not scored again."""

    @cache
    def of_rows(rows: tuple[int, ...]) -> Mapping[str, float]:
        return {"AMOTA": nuscenes_tracking_metrics([scenes[row] for row in rows]).overall.amota}

    return lambda rows: of_rows(tuple(rows))


def _gain(a: FiguresOf, b: FiguresOf, scenes: int) -> Interval:
    """AMOTA of `a` less that of `b`."""
    return drawn_differences(a, b, scenes, DRAWS)["AMOTA"]
