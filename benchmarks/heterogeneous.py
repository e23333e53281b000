"""What nodes of other kinds are worth: predictions with lights, lanes, cones and couplings against cars alone.

For every kind of scene the same frames go to four trackers, which are asked every half second where the objects will be
in two seconds:

    full     everything that the configuration declares
    cars     the same settings without the edges that cones, the roadside and couplings take part in
    shipped  the graph of cars as shipped for simulated traffic
    kf       no edges
    floor    at junctions and road works: the estimates of `full`, predicted by who knows how drivers drive, when the
             lights change, and who is hidden (`benchmarks.foreseeing`)

*Affected* are the moving objects that a closed light, cones or a coupling concerns at the moment of the question,
whatever they do later; all other moving objects are the *others*, whom the additional nodes must not harm. Compared are
objects that have been in view for a while and that all trackers follow. *Hidden* are parts of coupled pairs that were
not seen for two seconds while the other part was (`benchmarks.hidden_parts`). Intervals are paired bootstraps over
scenes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.affected import affected
from benchmarks.foreseeing import Foreseeing
from benchmarks.hidden_parts import COUPLED, HIDDEN, hidden_errors, hidings, without_parts
from benchmarks.predictions import FOLLOWED, Asked, in_view, moving, prediction_errors
from data_tools.metrics import Interval, paired_bootstrap, ratio_of_sums
from data_tools.simulator.scenarios import ScenarioName, scenario_settings
from data_tools.simulator.scene import scene_from_world
from data_tools.simulator.world import build_world
from pipelines.config import TrackConfig, load_config
from pipelines.figures import FigureTable, cell
from pipelines.tracking import OnlineTracker, Progress
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.numerics.arrays import FloatArray

HORIZON = 2.0  # s
FIRST, EVERY = 2.0, 0.5  # s: the first question, and from one to the next
RATE = 5.0  # frames a second of either sensor
GROUPS = ("affected", "others", "hidden")
BASELINES = ("cars", "shipped", "kf")


@dataclass(frozen=True, eq=False)
class GroupFigures:
    """Of one group of objects in one kind of scenes.

    count    predictions
    mean, rmse, median  errors by method, m
    change   of the mean error of `full` against each baseline, less 1
    floor    of the mean error of the floor against `cars`, less 1; None where there is no floor
    """

    count: int
    mean: Mapping[str, float]
    rmse: Mapping[str, float]
    median: Mapping[str, float]
    change: Mapping[str, Interval]
    floor: Interval | None


@dataclass(frozen=True, eq=False)
class KindFigures:
    """One kind of scenes: its seeds, and the figures by group."""

    kind: ScenarioName
    seeds: tuple[int, ...]
    groups: Mapping[str, GroupFigures]


def contenders(config: TrackConfig) -> dict[str, TrackConfig]:
    """The configurations by name, see the module."""
    return {
        "full": config,
        "cars": cars_alone(config),
        "shipped": load_config("simulated"),
        "kf": config.of_method("kf"),
    }


def cars_alone(config: TrackConfig) -> TrackConfig:
    """The same without the edges that anything but moving objects, each by itself, takes part in."""
    edges = tuple(
        replace(edge, cones=None) if isinstance(edge, Following) else edge
        for edge in config.tracker.edges
        if isinstance(edge, Following | Neighbours)
    )
    return replace(config, tracker=replace(config.tracker, edges=edges))


def heterogeneous(
    config: TrackConfig,
    kinds: Sequence[ScenarioName],
    seeds: Sequence[int],
    duration: float,
    progress: Progress | None = None,
) -> list[KindFigures]:
    """Simulate scenes of `duration` s and compare the predictions."""
    methods = contenders(config)
    results, done = [], 0
    for kind in kinds:
        errors: dict[str, list[dict[str, list[float]]]] = {group: [] for group in GROUPS}
        for seed in seeds:
            for group, found in _errors_of_scene(kind, seed, duration, methods).items():
                errors[group].append(found)
            done += 1
            if progress is not None:
                progress(kind, done, len(kinds) * len(seeds))
        results.append(KindFigures(kind, tuple(seeds), {group: _figures(parts) for group, parts in errors.items()}))
    return results


def _errors_of_scene(
    kind: ScenarioName, seed: int, duration: float, methods: Mapping[str, TrackConfig]
) -> dict[str, dict[str, list[float]]]:
    """Errors, m, by group and method, of the same questions for all methods."""
    settings = replace(scenario_settings(kind), duration=duration)
    sensors = {name: replace(sensor, rate=RATE) for name, sensor in settings.sensors.items()}
    settings = replace(settings, sensors=sensors)
    world = build_world(settings, seed)
    scene = scene_from_world(world, settings, seed)
    assert scene.ground_truth is not None
    ahead, step = (round(time * settings.keyframe_rate) for time in (HORIZON, EVERY))
    rows = list(range(round(FIRST * settings.keyframe_rate), len(scene) - ahead, step))
    offset = float(scene.timestamps[0]) - world.start
    concerned = {row: set(affected(world, float(scene.timestamps[row]) - offset).tolist()) for row in rows}
    back = round(FOLLOWED * settings.keyframe_rate)
    truth = scene.ground_truth
    followed = {row: np.intersect1d(moving(truth[row]), in_view(truth[row - back : row + 1])) for row in rows}
    trackers: dict[str, OnlineTracker] = {name: method.new_tracker("saga") for name, method in methods.items()}
    if kind not in COUPLED:
        trackers["floor"] = Foreseeing(methods["full"].new_tracker("saga"), world, settings, offset)
    answers = {
        name: prediction_errors(scene, tracker, HORIZON, rows, followed.__getitem__)
        for name, tracker in trackers.items()
    }
    affected_ones: set[Asked] = {(name, row) for row in rows for name in concerned[row]}
    hidden: dict[str, Mapping[Asked, float]] = {name: {} for name in methods}
    if kind in COUPLED:
        times = hidings(scene, COUPLED[kind])
        frames = without_parts(scene, world, times)
        hidden = {name: hidden_errors(scene, frames, cfg.new_tracker("saga"), times) for name, cfg in methods.items()}
    return {
        "affected": _of_all(answers, lambda asked: asked in affected_ones),
        "others": _of_all(answers, lambda asked: asked not in affected_ones),
        "hidden": _of_all(hidden, lambda asked: True),
    }


def _of_all(answers: Mapping[str, Mapping[Asked, float]], wanted: Callable[[Asked], bool]) -> dict[str, list[float]]:
    """The errors of the wanted questions that all methods answer, in one order."""
    common = sorted(filter(wanted, set.intersection(*(set(found) for found in answers.values()))))
    return {name: [found[q] for q in common] for name, found in answers.items()}


def _figures(scenes: Sequence[Mapping[str, Sequence[float]]]) -> GroupFigures:
    names = tuple(scenes[0])
    pooled = {name: np.concatenate([np.asarray(scene[name], dtype=np.float64) for scene in scenes]) for name in names}
    sums = {name: np.array([[sum(scene[name]), len(scene[name])] for scene in scenes], dtype=float) for name in names}
    count = len(pooled["full"])

    def each(figure: Any) -> dict[str, float]:
        return {name: float(figure(errors)) if count else float("nan") for name, errors in pooled.items()}

    change = {name: paired_bootstrap(sums["full"], sums[name], ratio_of_sums) for name in BASELINES}
    floor = paired_bootstrap(sums["floor"], sums["cars"], ratio_of_sums) if "floor" in names else None
    return GroupFigures(count, each(np.mean), each(_rms), each(np.median), change, floor)


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def tables(results: Sequence[KindFigures]) -> list[FigureTable]:
    """For people: errors, and what the full graph changes in the mean error."""
    found = []
    for group in GROUPS:
        columns = (
            "scenes",
            "predictions",
            "full",
            "cars",
            "shipped",
            "kf",
            *(f"full / {name} - 1" for name in BASELINES),
            "floor / cars - 1",
        )
        rows = []
        for result in results:
            figures = result.groups[group]
            if figures.count:
                means = (cell(figures.mean[name], 2) for name in ("full", *BASELINES))
                changes = (_percent(figures.change[name]) for name in BASELINES)
                floor = "" if figures.floor is None else _percent(figures.floor)
                rows.append((result.kind, str(figures.count), *means, *changes, floor))
        what = f"predictions over {HORIZON:g} s" if group != "hidden" else f"places after {HIDDEN:g} s unseen"
        title = f"{group}: mean error of {what}, m; change with its 95 % interval"
        if rows:
            found.append(FigureTable(title, columns, tuple(rows)))
    return found


def _percent(change: Interval) -> str:
    return f"{100 * change.estimate:+.0f} % [{100 * change.low:+.0f}, {100 * change.high:+.0f}]"
