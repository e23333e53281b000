"""Results read back: the tracks that a file or folder holds for the scenes of a dataset."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from data_tools.datasets.detection_files import TableImport, TrackRows
from data_tools.metrics import SceneBoxes
from data_tools.metrics.misalignment import misalignment
from saga_fg.errors import InputError, error_context, unknown_name
from saga_fg.numerics import FloatArray, IntArray, refuse
from saga_fg.tables import NAME, option_text, usual_class
from saga_fg.types import Dataset, Mend, Scene, known_velocities

if TYPE_CHECKING:
    from data_tools.evaluation import Evaluation, Metric

log = logging.getLogger(__name__)

_SAME_TIME = 1e-4  # s
_FEW = 0.1  # of the moments, which a tracker may need to begin
_NEAR_TIME = 0.02  # s between a moment of the truth and the tracks of another clock


@dataclass(frozen=True, eq=False)
class SceneResult:
    """A scene, with detections and ground truth where there are some, and the tracks found in it, world coordinates.

    coasting  (N,) s since the last detection, NaN where unknown; None if nothing is known of it
    """

    scene: Scene
    found: SceneBoxes
    coasting: FloatArray | None = field(default=None, kw_only=True)


def clear_figures(
    scenes: Mapping[str, SceneResult],
    hota: bool = False,
    innovations: Mapping[str, FloatArray] | None = None,
    sweep: bool = False,
) -> Evaluation:
    """Score tracks by CLEAR figures and RMSE; sweep: at every score, too."""
    from data_tools.evaluation import evaluate_tracks

    return evaluate_tracks([(each.scene, each.found) for each in scenes.values()], hota, innovations, sweep=sweep)


@dataclass(frozen=True, eq=False)
class Results:
    """The result of any tracker by scene, with ground truth, and how this is scored.

    score  of scenes, whether with HOTA, and the squared distances of the run by class, or None
    """

    scenes: Mapping[str, SceneResult]
    score: Callable[[Any, bool, Mapping[str, FloatArray] | None], Evaluation] = clear_figures

    def only(self, names: Collection[str]) -> Results:
        """Some of the scenes."""
        return replace(self, scenes={name: each for name, each in self.scenes.items() if name in names})

    def evaluate(
        self,
        hota: bool = False,
        innovations: Mapping[str, FloatArray] | None = None,
        metrics: Sequence[str | Metric] = (),
    ) -> Evaluation:
        """Score the tracks, and warn where hardly any matches, with what would have matched.

        innovations  squared distances of the run, by class; metrics: a user's own
        """
        evaluation = self.score(self.scenes, hota, innovations)
        pairs = [(each.scene, each.found) for each in self.scenes.values()]
        if why := misalignment(pairs):
            log.warning("%s", why)
        if not metrics:
            return evaluation
        from data_tools.evaluation import own_figures

        return replace(evaluation, own=own_figures(pairs, metrics))


def table_results(
    rows: TrackRows,
    path: Path,
    dataset: Dataset | None,
    every_scene: bool = False,
    how: TableImport | None = None,
    judged: bool = False,
    own_times: bool = False,
) -> dict[str, SceneResult]:
    """A table of tracks in those scenes of a dataset that it has; rows of other scenes are left out.

    path         of the table, for errors
    every_scene  include scenes without a row, in which nothing was found; an empty table always has all scenes
    how          what it took to understand the table
    judged       these are anybody's tracks beside the ground truth of the dataset: rows at other times are left out,
                 and the only scene of the one is that of the other
    own_times    the times of rows are moments too, whether or not they are some of the scene

    Without a dataset, the scenes are those of the table: their moments are the times of its rows, and the vehicle
    stands amid all tracks. Logs a warning where scenes are left out. Raises `InputError` for a broken table, for one
    that has none of the scenes, for times that are no moments of their scene, and for judged tracks where hardly a
    moment has some near its time.
    """
    there = tuple(dict.fromkeys(rows.scene.tolist()))
    if dataset is None:
        return {name: scene_result(_scene(rows, name), rows, path) for name in there}
    if len(there) == len(dataset.scenes) == 1 and (judged or not rows.named):
        rows, there = replace(rows, scene=np.full(len(rows.scene), dataset.scenes[0])), tuple(dataset.scenes)
    if there and not set(there) & set(dataset.scenes):
        whose = " (scenes of the ground truth)" if judged else ""
        raise InputError(f"{path}: {unknown_name('scene', there[0], dataset.scenes)}{whose}")
    chosen = [name for name in dataset.scenes if every_scene or not there or name in there]
    if len(chosen) < len(dataset.scenes):
        whose = "scenes with ground truth" if judged else "scenes of the dataset, the others are left out"
        log.warning("%s: has tracks in %d of the %d %s", path, len(chosen), len(dataset.scenes), whose)
    results = {}
    for name in chosen:
        scene = dataset.scene(name)
        scene = _with_times(scene, rows) if own_times else scene
        results[name] = scene_result(*(_at_moments(rows, scene, path) if judged else (scene, rows)), path)
    if judged:
        _warn_of_classes(results, path, how or TableImport())
    return results


def _with_times(scene: Scene, rows: TrackRows) -> Scene:
    """The scene with the times of its rows as further moments, the vehicle where it is at the nearest one."""
    times = np.unique(rows.timestamp[rows.scene == scene.name])
    if not len(times) or not len(scene):
        return scene
    new = times[np.abs(scene.timestamps[nearest_rows(scene.timestamps, times)] - times) > _SAME_TIME]
    order = np.argsort(np.append(scene.timestamps, new))
    at = nearest_rows(scene.timestamps, new)
    return replace(
        scene,
        timestamps=np.append(scene.timestamps, new)[order],
        world_T_ego=np.concatenate([scene.world_T_ego, scene.world_T_ego[at]])[order],
        tokens=tuple([*scene.tokens, *[""] * len(new)][k] for k in order.tolist()),
        ground_truth=None,
    )


def _at_moments(rows: TrackRows, scene: Scene, path: Path) -> tuple[Scene, TrackRows]:
    """The rows at the times that are nearest to the moments of a scene, if near enough, with these as their times.

    Where tracks come at a lower rate, the scene has the moments of both.
    """
    mine = np.flatnonzero(rows.scene == scene.name)
    times = np.unique(rows.timestamp[mine])
    if not len(times) or not len(scene):
        return scene, rows.select(mine)
    step = float(np.median(np.diff(scene.timestamps))) if len(scene) > 1 else 1.0
    reach = min(_NEAR_TIME, step / 4)
    nearest = times[nearest_rows(times, scene.timestamps)]
    near = np.abs(nearest - scene.timestamps) <= reach
    within = (scene.timestamps >= times[0] - step) & (scene.timestamps <= times[-1] + step)
    if not near.any() or near[within].mean() < 0.5:
        steps = np.diff(times)
        usual = float(np.median(steps)) if near.sum() > 0.8 * len(times) > 2 else step
        if usual > 1.5 * step and np.mean(np.abs(steps - usual) < 0.25 * usual) > 0.8:
            what = f"tracks are {usual:.3g} s apart, the truth {step:.3g} s: judged at the {near.sum()} moments of both"
            log.warning("%s: scene %s: %s", path, scene.name, what)
            return _at_moments(rows, _with_moments(scene, np.flatnonzero(near)), path)
        later = scene.timestamps[0] - times[0]
        moved = times[nearest_rows(times + later, scene.timestamps)] + later
        fits = (np.abs(moved - scene.timestamps) <= reach).mean() >= 0.5
        raise InputError(
            f"{path}: scene {scene.name}: expected tracks at the times of the ground truth, {scene.timestamps[0]:.3f} "
            f"to {scene.timestamps[-1]:.3f} s every {step:.3g} s; they are at {times[0]:.3f} to {times[-1]:.3f} s, and "
            f"{near.sum()} of {len(scene)} moments have one within {reach:.3g} s"
            + (f"; {later:+.6g} s later they would fit" if fits else "")
        )
    moment_of = dict(zip(nearest[near].tolist(), scene.timestamps[near].tolist(), strict=True))
    moved = np.array([moment_of.get(time, np.nan) for time in rows.timestamp[mine].tolist()])
    kept = np.isfinite(moved)
    missing = int((~near).sum())
    if missing > _FEW * len(scene):
        log.warning("%s: scene %s: no tracks at %d of %d moments of the truth", path, scene.name, missing, len(scene))
    return scene, replace(rows.select(mine[kept]), timestamp=moved[kept])


def _with_moments(scene: Scene, moments: IntArray) -> Scene:
    """A scene with some of its moments alone."""
    truth = scene.ground_truth
    return replace(
        scene,
        timestamps=scene.timestamps[moments],
        world_T_ego=scene.world_T_ego[moments],
        tokens=tuple(scene.tokens[k] for k in moments.tolist()),
        ground_truth=None if truth is None else [truth[k] for k in moments.tolist()],
    )


def nearest_rows(times: FloatArray, moments: FloatArray) -> IntArray:
    """The rows of the ascending times that are nearest to each moment."""
    after = np.minimum(np.searchsorted(times, moments), len(times) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(moments - times[before]) <= np.abs(times[after] - moments), before, after)


def _warn_of_classes(results: Mapping[str, SceneResult], path: Path, how: TableImport) -> None:
    """Warn of classes that tracks or true objects alone have: nothing of them can match."""
    found = {label for each in results.values() for label in each.found.boxes.label.tolist()}
    true = {
        label for each in results.values() for t in each.scene.ground_truth or () for label in t.boxes.label.tolist()
    }
    tracked, missed = sorted(found - true), sorted(true - found)
    if not found or not true or not (tracked or missed):
        return
    whose = {"tracks": tracked, "true objects": missed}
    alone = " and ".join(f"{who} of {', '.join(names)}" for who, names in whose.items() if names)
    alike = {name: each for name in missed for each in tracked if usual_class(name) == usual_class(each) is not None}
    if len(tracked) == len(missed) == 1 and None in (usual_class(tracked[0]), usual_class(missed[0])):
        alike = {missed[0]: tracked[0]}
    named = how.mended(Mend(classes=alike), {})
    mend = option_text(named.values(), "how") if path == Path(NAME) else named.options().strip()
    hint = f"; name them alike: {mend}" if alike else ""
    log.warning("%s: %s have no counterpart of their class, nothing of them can match%s", path, alone, hint)


def _scene(rows: TrackRows, name: str) -> Scene:
    mine = rows.scene == name
    times = np.unique(rows.timestamp[mine])
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :2, 3] = np.median(rows.boxes.position[mine, :2], axis=0)
    return Scene(name, times, poses)


def scene_result(scene: Scene, rows: TrackRows, path: str | Path) -> SceneResult:
    """The rows of a scene at its moments. Raises `InputError` for other times; `path` is named."""
    mine: IntArray = np.flatnonzero(rows.scene == scene.name)
    moment = np.searchsorted(scene.timestamps, rows.timestamp[mine] - _SAME_TIME)
    at = np.minimum(moment, len(scene) - 1)
    strange = np.abs(scene.timestamps[at] - rows.timestamp[mine]) > _SAME_TIME
    expected = f"{path}: scene {scene.name}: expected the times of the detections"
    refuse(strange, lambda row: InputError(f"{expected}, they have none at {rows.timestamp[mine[row]]} s"))
    order = np.argsort(moment, kind="stable")
    chosen = mine[order]
    boxes = rows.boxes.select(chosen)
    boxes = replace(boxes, velocity=known_velocities(boxes.velocity, rows.velocity_covariance[chosen]))
    with error_context(f"{path}: scene {scene.name}"):
        found = SceneBoxes(moment[order], rows.id[chosen], boxes, rows.score[chosen], rows.position_covariance[chosen])
    return SceneResult(scene, found, coasting=rows.coasting[chosen])
