"""Scenes as data of the page's player: tracks, road, camera images, score threshold.

Scenes as data of the page's player: rows of whole numbers, centimetres and milliradians, about the scene's start.

    scene   {"name", "start": s, "origin": [x, y] in m, "times": [s], "ego": [[x, y, yaw]], "labels": [class],
             "methods": {name: {"ids": [name],
             "moments": [[track, ...]], "edges": [[[target id, source id, rate, relation], ...]], "relations": [name],
             "horizons": [ms], "predictions": [[prediction, ...]], [] without, "modes": [name]}},
             "truth": [[object, ...]], "detections": [[detection, ...]], "road": see below,
             "map": {"areas": [[kind, ring, ...]], "lines": [[x, y, ...]]} or null, "cameras": {name: [JPEG]},
             "comparisons": [{"reference": name of a method, null for the truth, "found": name, "events": [event]}]}
    track      [id, class, x, y, length, width, yaw, vx, vy, score, cov_xx, cov_xy, cov_yy, coasting]
    prediction [id, horizon, x, y, cov_xx, cov_xy, cov_yy, mode, probability]; mode 0: the mean of all
    object     [class, x, y, length, width, yaw, visible]
    detection  [class, x, y, length, width, yaw, score]
    event      [kind, first moment, last moment, x, y, id of the reference, id found, id found before]

Lengths in cm, yaw in mrad, velocities in cm/s, scores, rates, probabilities in thousandths, covariances in cm^2,
coasting and horizons in ms; null is unknown. `ids`, `labels`, `relations`, `modes` are counted from 0. Ids of events
are names. The kinds of events are `SWITCH`, `UNMATCHED`, a box of the reference without one found, and `ADDED`, one
found without a box of it.

The road of a scene as the page's player wants it: lanes, stop lines and lights that its frames brought along.

    road  {"lanes": [[width, x, y, x, y, ...]], "lines": [[light, x, y, x, y]], "lights": [[x, y]],
           "colours": [[colour of each light]]}, or null where no frame brought a map

Lengths in cm about the scene's start; lights are counted from 0. A colour is 0 red, 1 amber, 2 green
(`saga_fg.types.road_map.COLOURS`), the one last reported at or before the moment; null before the first report. A
report is of the light nearest to it, or of none if that is further than `SignalSettings.max_distance` is by default.
"""

import base64
import io
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets import AreaMap, Images, PredictionRows
from data_tools.files import isolated
from data_tools.metrics import SceneBoxes, best_thresholds, match_scene, score_sweep
from pipelines.report.figures import unseen_for
from pipelines.tracking import TrackedScene
from saga_fg import Boxes, ConstantVelocity, Frame, NodeType, Scene, Sensor
from saga_fg.model import EdgeRule, NodeTable, sensor_model
from saga_fg.numerics import FloatArray, IntArray, StrArray, yaw_of
from saga_fg.types import COLOUR_LABELS, MAX_LIGHT_DISTANCE, RELATIONS, Annotations, Lane, StopLine, TrafficLight

Thumbnails = Mapping[str, list[str | None]]
QUALITY = 60  # of JPEG, in percent


def thumbnails(images: Images, width: int) -> Thumbnails:
    """Return the images of a scene by camera, `width` pixels wide or less. Raises `InputError` for a broken one."""
    return {
        camera: [None if file is None else _isolated(file, width) for file in files] for camera, files in images.items()
    }


def _isolated(file: Path, width: int) -> str:
    return "".join(isolated("expected an image", _thumbnail, file, width))


def _thumbnail(file: Path, width: int) -> Iterator[str]:
    from PIL import Image

    buffer = io.BytesIO()
    with Image.open(file) as image:
        image.draft("RGB", (2 * width, 2 * width))  # JPEG is then decoded at a fraction of its size
        small = image.convert("RGB")
        small.thumbnail((width, width))
        small.save(buffer, "JPEG", quality=QUALITY)
    yield base64.b64encode(buffer.getvalue()).decode("ascii")


Colours = list[list[int | None]]


def road_data(frames: Iterable[Frame], detections: Sequence[Boxes], origin: FloatArray) -> dict[str, Any] | None:
    """Return the data of the road, ready for JSON; see the module's docstring.

    detections  of each moment, in world coordinates and in order of time
    origin      (2,) place of the scene's start, m
    """
    lanes: dict[str, Lane] = {}
    lines: dict[str, StopLine] = {}
    lights: dict[str, TrafficLight] = {}
    maps = {id(frame.road_map): frame.road_map for frame in frames if frame.road_map is not None}  # most bring the same
    for known in maps.values():
        for light in known.lights:  # the first entry of a name stays, as in the tracker
            lights.setdefault(light.name, light)
        for line in known.stop_lines:
            lines.setdefault(line.name, line)
        for lane in known.lanes:
            lanes.setdefault(lane.name, lane)
    if not lanes and not lights and not lines:
        return None
    number = {name: k for k, name in enumerate(lights)}
    places = np.array([light.position for light in lights.values()]).reshape(-1, 2)
    return {
        "lanes": [[round(100 * lane.width), *_centimetres(lane.centre, origin)] for lane in lanes.values()],
        "lines": [[number.get(line.light, -1), *_centimetres(line.ends, origin)] for line in lines.values()],
        "lights": [_centimetres(place, origin) for place in places],
        "colours": _colours(places, detections),
    }


def map_data(known: AreaMap, origin: FloatArray) -> dict[str, Any]:
    """Return areas and lines, ready for JSON, in cm about the scene's start."""
    return {
        "areas": [[kind, *(_centimetres(ring, origin) for ring in rings)] for kind, rings in known.areas],
        "lines": [_centimetres(line, origin) for line in known.lines],
    }


def _colours(lights: FloatArray, detections: Sequence[Boxes]) -> Colours:
    """Return for each moment the colour last reported of each light; lights (L, 2)."""
    reach = MAX_LIGHT_DISTANCE
    now: list[int | None] = [None] * len(lights)
    colours = []
    for boxes in detections:
        reported = boxes.select(np.flatnonzero(np.isin(boxes.label, COLOUR_LABELS)))
        if len(lights) and len(reported):
            now = now.copy()
            apart = np.linalg.norm(reported.position[:, None, :2] - lights, axis=2)
            nearest = apart.argmin(axis=1)
            for label, light, far in zip(reported.label, nearest.tolist(), apart.min(axis=1), strict=True):
                if far < reach:
                    now[light] = COLOUR_LABELS.index(str(label))
        colours.append(now)
    return colours


def _centimetres(points: Any, origin: FloatArray) -> list[int]:
    """Return points (..., 2), flattened."""
    flat: list[float] = (100 * (np.asarray(points) - origin)).ravel().tolist()
    return [round(value) for value in flat]


Rows = list[list[int | None]]
Edges = tuple[IntArray, IntArray, FloatArray, IntArray]
"""Targets and sources (E,), rows of the table, rates (E,), 1/s, and numbers (E,) of the rules that found them."""
SWITCH, UNMATCHED, ADDED = range(3)
_SAME_TIME = 1e-4  # s
MOVING = 2.0  # m/s, from which a track has moved
VELOCITY_VARIANCE = 1.0  # (m/s)^2, results do not give it
UNMEASURED = 1.0  # side of the cube an object of unknown size is drawn as, m


@dataclass(frozen=True, eq=False)
class ReportScene:
    """A scene and the tracks of one or several trackers.

    scene     with its detections, and ground truth where there is one
    tracks    by the tracker's name
    coasting  by the tracker's name, s since the last detection, (N,) of its tracks; found from detections if left out
    rules     find the edges between the tracks of a moment
    sensors   models by name, which place detections in the world
    predictions  by the tracker's name, of its tracks; may be left out
    map       of the place; cameras: thumbnails of images for each moment, by camera
    relations  by the tracker's name, rows of `saga_fg.types.Relations` by time, s; may be left out
    """

    scene: Scene
    tracks: Mapping[str, SceneBoxes]
    coasting: Mapping[str, FloatArray]
    rules: Sequence[EdgeRule] = ()
    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    predictions: Mapping[str, PredictionRows] = field(default_factory=dict)
    map: AreaMap | None = None
    cameras: Thumbnails = field(default_factory=dict)
    relations: Mapping[str, Mapping[float, Sequence[Sequence[Any]]]] = field(default_factory=dict)


def scene_of_run(
    runs: Mapping[str, TrackedScene], rules: Sequence[EdgeRule], sensors: Mapping[str, Sensor]
) -> ReportScene:
    """Return a scene with the tracks of `runs`, by the trackers' names."""
    return ReportScene(
        next(iter(runs.values())).scene,
        {name: SceneBoxes.of_tracks(run.tracks) for name, run in runs.items()},
        {name: np.concatenate([np.empty(0), *(t.coasting for t in run.tracks)]) for name, run in runs.items()},
        rules,
        sensors,
        {name: PredictionRows.from_moments(run.predictions) for name, run in runs.items() if run.predictions},
        relations={name: {each.timestamp: each.relations.rows() for each in run.tracks} for name, run in runs.items()},
    )


def scene_data(report: ReportScene) -> dict[str, Any]:
    """Return the data of a scene, ready for JSON; see the module's docstring."""
    scene = report.scene
    origin = scene.world_T_ego[0, :2, 3] if len(scene) else np.zeros(2)
    shown = latest_detections(scene, report.sensors)
    truth = [t.boxes for t in scene.ground_truth] if scene.ground_truth is not None else None
    names = [table.boxes.label for table in report.tracks.values()] + [b.label for b in (*(truth or ()), *shown[0])]
    labels = np.unique(np.concatenate([np.empty(0, dtype="<U1"), *names]))
    coasting = dict(report.coasting)
    for name, table in report.tracks.items() if scene.frames else ():
        if name not in coasting:
            coasting[name] = unseen_for(table, scene.timestamps, shown[0])
    ego = np.column_stack([scene.world_T_ego[:, :2, 3] - origin, yaw_of(scene.world_T_ego[:, :3, :3])])
    return {
        "name": scene.name,
        "start": float(scene.timestamps[0]) if len(scene) else 0.0,
        "origin": origin.tolist(),
        "times": (scene.timestamps - scene.timestamps[:1]).round(6).tolist(),
        "ego": _whole(ego * [100, 100, 1000]),
        "labels": labels.tolist(),
        "methods": {
            name: _method(
                table,
                coasting.get(name),
                labels,
                origin,
                scene.timestamps,
                report.rules,
                report.relations.get(name, {}),
            )
            | predictions_data(report.predictions.get(name), table, scene.timestamps, origin)
            for name, table in report.tracks.items()
        },
        "truth": None
        if truth is None or scene.ground_truth is None
        else [
            _whole(np.column_stack([_box_columns(boxes, labels, origin), t.visible]))
            for boxes, t in zip(truth, scene.ground_truth, strict=True)
        ],
        "detections": [
            _whole(np.column_stack([_box_columns(boxes, labels, origin), 1000 * score]))
            for boxes, score in zip(*shown, strict=True)
        ],
        "road": road_data(scene.frames, shown[0], origin),
        "map": None if report.map is None else map_data(report.map, origin),
        "cameras": dict(report.cameras),
    }


def _method(
    table: SceneBoxes,
    coasting: FloatArray | None,
    labels: StrArray,
    origin: FloatArray,
    times: FloatArray,
    rules: Sequence[EdgeRule],
    relations: Mapping[float, Sequence[Sequence[Any]]],
) -> dict[str, Any]:
    ids, number = np.unique(table.id, return_inverse=True)
    covariance = table.position_covariance
    columns = [
        number,
        _box_columns(table.boxes, labels, origin),
        100 * table.boxes.velocity,
        1000 * table.score,
        1e4 * np.stack([covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]], axis=-1),
        1000 * (np.full(len(table), np.nan) if coasting is None else coasting),
    ]
    rows = _whole(np.column_stack(columns))
    starts = np.searchsorted(table.frame, np.arange(len(times) + 1)).tolist()
    edges = edges_of_frames(table, len(times), rules)
    others = relations_data(relations, ids.tolist(), times, len(rules))
    return {
        "ids": ids.tolist(),
        "moments": [rows[a:b] for a, b in pairwise(starts)],
        "edges": [
            _whole(np.column_stack([number[target], number[source], 1000 * rate, rule])) + more
            for (target, source, rate, rule), more in zip(edges, others, strict=True)
        ],
        "relations": [*relation_names(rules), *RELATIONS],
    }


def relations_data(
    found: Mapping[float, Sequence[Sequence[Any]]], ids: Sequence[str], times: FloatArray, rules: int
) -> list[Rows]:
    """Return the relations of tracks at each moment as edges, of kinds that follow those of the `rules`."""
    kind = {name: rules + k for k, name in enumerate(RELATIONS)}
    number = _numbers(ids)
    moments: list[Rows] = [[] for _ in times]
    for time, rows in found.items():
        k = int(np.searchsorted(times, time - _SAME_TIME))
        if k < len(times) and times[k] < time + _SAME_TIME:
            known = (
                (number.get(str(a)), number.get(str(b)), round(1000 * p), kind.get(name)) for a, b, name, p in rows
            )
            moments[k] = [list(row) for row in known if None not in row]
    return moments


def comparisons(report: ReportScene, thresholds: Mapping[str, float]) -> list[dict[str, Any]]:
    """Return where each method differs from the truth, and from the methods before it.

    The tracks count whose mean scores are at least the `thresholds`.

    Ready for JSON; see the module's docstring.
    """
    scene = report.scene
    origin = scene.world_T_ego[0, :2, 3] if len(scene) else np.zeros(2)
    found = {name: table.select(table.track_score >= thresholds[name]) for name, table in report.tracks.items()}
    references: dict[str | None, Sequence[Annotations]] = {}
    if scene.ground_truth is not None:
        references[None] = scene.ground_truth
    result = []
    for name, table in found.items():
        for reference, boxes in references.items():
            events = differences(boxes, table.by_frame(len(scene)), origin)
            result.append({"reference": reference, "found": name, "events": events})
        references[name] = table.annotations(len(scene))
    return result


def differences(reference: Sequence[Annotations], found: Sequence[SceneBoxes], origin: FloatArray) -> list[list[Any]]:
    """Return the differences of boxes from a reference, matched as for the evaluation, in order of time.

    A box without a counterpart is one event for as long as it lasts. See the module's docstring.
    """
    events: list[list[Any]] = []
    lasting: dict[tuple[int, str], list[Any]] = {}
    partner: dict[str, str] = {}
    matches = match_scene(reference, found)
    for k, (true, boxes, match) in enumerate(zip(reference, found, matches, strict=True)):
        missed = np.setdiff1d(np.flatnonzero(true.visible), match.object_row)
        added = np.setdiff1d(np.arange(len(boxes)), match.track_row)
        now = dict(zip(true.id[match.object_row].tolist(), boxes.id[match.track_row].tolist(), strict=True))
        for kind, of, rows in (
            (SWITCH, true, match.object_row[match.switched]),
            (UNMATCHED, true, missed),
            (ADDED, boxes, added),
        ):
            places = _centimetres(of.boxes.position[rows, :2], origin)
            for id_, x, y in zip(of.id[rows].tolist(), places[::2], places[1::2], strict=True):
                event = lasting.get((kind, id_))
                if event is not None and kind != SWITCH and event[2] == k - 1:
                    event[2] = k
                    continue
                names = [None, id_] if kind == ADDED else [id_, now.get(id_)]
                lasting[kind, id_] = event = [kind, k, k, x, y, *names, partner.get(id_)]
                events.append(event)
        partner |= now
    return events


def predictions_data(
    found: PredictionRows | None, table: SceneBoxes, times: FloatArray, origin: FloatArray
) -> dict[str, Any]:
    """Return the predictions of the tracks of a table; see the module's docstring."""
    if found is None:
        return {"horizons": [], "predictions": [], "modes": []}
    number = _numbers(np.unique(table.id).tolist())
    ids = np.array([number.get(id_, -1) for id_ in found.id.tolist()], dtype=np.int64)
    found, ids = found.select(ids >= 0), ids[ids >= 0]
    P, (modes, mode) = found.covariance, np.unique(["", *found.mode], return_inverse=True)
    columns = [
        ids,
        1000 * found.horizon,
        100 * (found.position - origin),
        1e4 * np.stack([P[:, 0, 0], P[:, 0, 1], P[:, 1, 1]], axis=-1),
        mode[1:],
        1000 * found.probability,
    ]
    order = np.lexsort((found.horizon, mode[1:], ids, found.timestamp))
    rows = _whole(np.column_stack(columns)[order])
    starts = np.searchsorted(found.timestamp[order], [*(times - _SAME_TIME), np.inf]).tolist()
    horizons = np.unique((1000 * found.horizon).round()).astype(np.int64)
    moments = [rows[a:b] for a, b in pairwise(starts)]
    return {"horizons": horizons.tolist(), "predictions": moments, "modes": modes.tolist()}


def _numbers(ids: Sequence[str]) -> dict[str, int]:
    """The rows of tracks by the tracker's own numbers: nuScenes has SCENE-NUMBER."""
    return {id_.rpartition("-")[2]: k for k, id_ in enumerate(ids)}


def _box_columns(boxes: Boxes, labels: StrArray, origin: FloatArray) -> FloatArray:
    """Return columns (N, 6): class, x, y, length, width, yaw."""
    size = np.where(np.isfinite(boxes.size[:, :2]), boxes.size[:, :2], UNMEASURED)
    place = 100 * (boxes.position[:, :2] - origin)
    return np.column_stack([np.searchsorted(labels, boxes.label), place, 100 * size, 1000 * np.nan_to_num(boxes.yaw)])


def edges_of_frames(table: SceneBoxes, frames: int, rules: Sequence[EdgeRule]) -> Iterator[Edges]:
    """Yield the edges that rules find between the reported tracks of each frame; see `relation_names`.

    A result does not hold the graph of its tracks; but rules need only what a result has.
    """
    node_type = NodeType("track", ConstantVelocity())
    moved: set[str] = set()
    for k in range(frames):
        rows = np.flatnonzero(table.frame == k)
        boxes = table.boxes.select(rows)
        velocity = np.nan_to_num(boxes.velocity)
        ids = table.id[rows]
        moved.update(ids[np.hypot(*velocity.T) > MOVING].tolist())
        heading = np.where(np.isfinite(boxes.yaw), boxes.yaw, np.arctan2(velocity[:, 1], velocity[:, 0]))
        nodes = NodeTable(
            id=np.arange(len(rows)),
            label=boxes.label,
            types=(node_type,) * len(rows),
            position=boxes.position[:, :2],
            velocity=velocity,
            heading=heading,
            length=np.nan_to_num(boxes.size[:, 0]),
            velocity_variance=np.full(len(rows), VELOCITY_VARIANCE),
            has_moved=np.array([id_ in moved for id_ in ids.tolist()], dtype=np.bool_),
        )
        pairs = [rule.pairs(nodes) for rule in rules] if len(rows) > 1 else []
        none = np.empty(0, dtype=np.int64)
        yield (
            np.concatenate([none, *(rows[p.target] for p in pairs)]),
            np.concatenate([none, *(rows[p.source] for p in pairs)]),
            np.concatenate([np.empty(0), *(p.rate for p in pairs)]),
            np.repeat(np.arange(len(pairs)), [len(p.rate) for p in pairs]),
        )


def relation_names(rules: Sequence[EdgeRule]) -> list[str]:
    """Return what the edges of each rule say of their target: that it follows the source, say."""
    return [getattr(rule, "relation", type(rule).__name__) for rule in rules]


def latest_detections(scene: Scene, sensors: Mapping[str, Sensor]) -> tuple[list[Boxes], list[FloatArray]]:
    """Return for each moment the boxes of all frames since the moment before, and their scores."""
    times = np.array([frame.timestamp for frame in scene.frames])
    at = np.searchsorted(scene.timestamps, times - 1e-6)
    boxes, scores = [], []
    for k in range(len(scene)):
        frames = [scene.frames[i] for i in np.flatnonzero(at == k).tolist()]
        found = [sensor_model(sensors, frame.sensor).in_world(frame) for frame in frames]
        boxes.append(Boxes.concatenate([each.boxes for each in found]))
        scores.append(np.concatenate([np.empty(0), *(each.score for each in found)]))
    return boxes, scores


def _whole(rows: FloatArray) -> Rows:
    return [[None if x != x else round(x) for x in row] for row in rows.tolist()]


PLAIN = 0.3
"""Threshold without ground truth, or where no score makes tracks better than none."""


def start_thresholds(scenes: Sequence[ReportScene]) -> dict[str, float]:
    """Return the least score to show first, by the tracker's name: that of the class with the most true objects.

    Where all scores are below `PLAIN`, all tracks are shown.
    """
    names = dict.fromkeys(chain.from_iterable(scene.tracks for scene in scenes))
    return {name: _threshold(scenes, name) for name in names}


def _threshold(scenes: Sequence[ReportScene], name: str) -> float:
    mine = [each for each in scenes if name in each.tracks]
    scores = np.concatenate([each.tracks[name].score for each in mine])
    lowest = PLAIN if (scores >= PLAIN).any() else min(0.0, float(scores.min(initial=0.0)))
    judged = [each for each in mine if each.scene.ground_truth is not None]
    if not judged:
        return lowest
    sweep = score_sweep([(each.scene, each.tracks[name]) for each in judged])
    best = best_thresholds(sweep)
    common = Counter({label: int(sweep.per_class[label].gt) for label in best}).most_common(1)
    if not common or not np.isfinite(best[common[0][0]]) or not sweep.per_class[common[0][0]].mota > 0:
        return lowest
    return float(np.floor(100 * best[common[0][0]]) / 100)
