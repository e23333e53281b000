"""Labels in the form of labelling tools, written and read back.

    openlabel      SCENE.json                            ASAM OpenLABEL 1.0.0
    cvat           SCENE/annotations/default.json        Datumaro, which CVAT takes as "Datumaro 3D 1.0"
    sustechpoints  SCENE/label/000000.json, 000001.json  a file for each frame

All of them hold one table: boxes by frame, which is the number of a moment of the scene, object, class, centre, size
and rotation, in coordinates of the vehicle at that moment (x ahead, y left, z up: ISO 8855). Boxes stand upright: of a
rotation that a tool gives, the angle about z counts. Where scans are at hand, the two tools for point clouds get them
in the same coordinates.

Boxes of unknown size are left out; an unknown heading is written as 0. Classes that differ in capitals are the same.

Sources: https://www.asam.net/standards/detail/openlabel (schema 1.0.0: a cuboid's `val` is x, y, z, qx, qy, qz, qw, or
rx, ry, rz, and sx, sy, sz); https://docs.cvat.ai/docs/dataset_management/formats/format-datumaro (`track_id` and
`keyframe` make tracks of boxes); https://github.com/naurril/SUSTechPOINTS, doc/data-format.md (Euler angles XYZ).
"""

import json
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from data_tools.datasets.results import SceneResult
from data_tools.files import isolated, parsed_json, read_text
from data_tools.metrics import SceneBoxes
from saga_fg.errors import InputError, error_context, unknown_name
from saga_fg.numerics import (
    IntArray,
    checked_quaternions,
    inverse_transform,
    quaternion_yaw,
    rotation_quaternion,
    yaw_quaternion,
)
from saga_fg.types import MAX_POSITION, Boxes, Scene

ToolBox = tuple[str, str, list[float]]
"""Object, class, and x, y, z, length, width, height, m, heading, rad."""

EGO, WORLD = "vehicle-iso8855", "world"  # coordinate systems of OpenLABEL
KINDS = {dict: "an object", list: "a list", str: "a text", int: "a whole number"}

T = TypeVar("T")


@dataclass(frozen=True)
class ToolFormat:
    """A scene in the form of a tool.

    suffix  of the file of a scene; "" for a folder
    write   takes the path, the scene, and its boxes by frame in coordinates of the vehicle
    read    yields the frames of a path, by name, and their boxes
    inside  what the folder of a scene holds; "" for a file
    clouds  folder of the point clouds in that of the scene, "" for none
    """

    suffix: str
    write: Callable[[Path, Scene, Sequence[Sequence[ToolBox]]], None]
    read: Callable[[Path], Iterator[tuple[str, list[ToolBox]]]]
    inside: str = ""
    clouds: str = ""

    def scene_path(self, folder: Path, name: str) -> Path:
        """Return the file or folder of a scene by its name as a file, whether it is there or not."""
        return folder / f"{name}{self.suffix}"

    def holds(self, folder: Path, name: str) -> bool:
        """Return whether a scene is there."""
        return (self.scene_path(folder, name) / self.inside).exists()


def tool_format(name: str) -> ToolFormat:
    """The form of a tool, by its name. Raises `InputError` for an unknown one."""
    if name not in _FORMATS:
        raise InputError(unknown_name("labelling tool", name, tuple(_FORMATS)))
    return _FORMATS[name]


def tools_of(folder: Path, names: Iterable[str]) -> list[str]:
    """The tools in whose form a folder holds scenes, by their names as files."""
    scenes = tuple(names)
    return [tool for tool, form in _FORMATS.items() if any(form.holds(folder, name) for name in scenes)]


def exchanged(result: SceneResult) -> SceneResult:
    """The boxes that tools can hold: those of known size, unknown headings as 0."""
    rows = np.flatnonzero(np.isfinite(result.found.boxes.size).all(axis=1))
    found = result.found.select(rows)
    found = replace(found, boxes=replace(found.boxes, yaw=np.nan_to_num(found.boxes.yaw)))
    return SceneResult(result.scene, found, coasting=None if result.coasting is None else result.coasting[rows])


def write_for_tool(path: Path, tool: str, result: SceneResult) -> int:
    """Write the boxes of a scene to a file or folder with the suffix of the tool's files; return their number."""
    scene, found = result.scene, exchanged(result).found
    frames = []
    for mine, ego_T_world in zip(found.by_frame(len(scene)), inverse_transform(scene.world_T_ego), strict=True):
        boxes = mine.boxes.transformed(ego_T_world)
        numbers = np.column_stack([boxes.position, boxes.size, boxes.yaw]).tolist()
        frames.append(list(zip(mine.id.tolist(), boxes.label.tolist(), numbers, strict=True)))
    tool_format(tool).write(path, scene, frames)
    return len(found)


def read_from_tool(
    path: Path, tool: str, scene: Scene, classes: Collection[str], open_classes: bool = False
) -> tuple[SceneBoxes, IntArray]:
    """Read the boxes of a scene, world coordinates, and which of its frames the tool handed back.

    classes  that there are, however they are capitalised; open_classes: others are taken as they are

    Raises `InputError` for a broken file, a frame that the scene has not, and a class that is not among `classes`.
    """
    known = {label.casefold(): label for label in classes}
    found: dict[int, tuple[list[str], Boxes]] = {}
    for name, rows in isolated(f"expected labels as {tool} has them", tool_format(tool).read, path):
        with error_context(f"{path}: frame {name[:40]}"):
            k = int(name) if name.isdecimal() and len(name) < 10 else -1
            if not 0 <= k < len(scene) or k in found:
                raise InputError(f"expected each frame once, of the recording's 0 to {len(scene) - 1}")
            for _, label, _ in rows:
                if label.casefold() not in known and not open_classes:
                    raise InputError(unknown_name("class", label, tuple(known.values())))
            numbers = np.array([row for _, _, row in rows]).reshape(-1, 7)
            labels = [known.get(label.casefold(), label) for _, label, _ in rows]
            boxes = Boxes.of(labels, numbers[:, :3], numbers[:, 3:6], numbers[:, 6])
            ids = [id_ or f"{k} {n}" for n, (id_, _, _) in enumerate(rows)]  # a box without a name is an object
            found[k] = ids, boxes.transformed(scene.world_T_ego[k])
    frames = np.array(sorted(found), dtype=np.int64)
    ids = [id_ for k in frames.tolist() for id_ in found[k][0]]
    frame = np.repeat(frames, [len(found[k][0]) for k in frames.tolist()])
    boxes = Boxes.concatenate([found[k][1] for k in frames.tolist()])
    with error_context(str(path)):
        return SceneBoxes(frame, np.array(ids, dtype=np.str_), boxes, np.ones(len(ids))), frames


def _write_json(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")


def _field(record: Any, name: str, kind: type[T], default: T | None = None) -> T:
    """A field of a record. Raises `InputError` where it is missing, unless it has a default, or is of another kind."""
    value = record.get(name, default) if isinstance(record, dict) else None
    if not isinstance(value, kind):
        raise InputError(f"{name}: expected {KINDS[kind]}, got {str(value)[:40]!r}")
    return value


def _numbers(values: Any, name: str, *counts: int) -> list[float]:
    """A list of so many finite numbers. Raises `InputError` for anything else."""
    listed = values if isinstance(values, list) else []
    usable = all(isinstance(value, int | float) and abs(value) <= MAX_POSITION for value in listed)
    if len(listed) not in counts or not usable:
        expected = " or ".join(map(str, counts))
        raise InputError(f"{name}: expected {expected} finite numbers, got {str(values)[:60]!r}")
    return [float(value) for value in listed]


def _upright(record: Any) -> list[float]:
    """The box of a record with position, scale and rotation, each a list or x, y and z."""
    parts = []
    for name in ("position", "scale", "rotation"):
        value = record.get(name) if isinstance(record, dict) else None
        parts.append(_numbers([value.get(axis) for axis in "xyz"] if isinstance(value, dict) else value, name, 3))
    return [*parts[0], *parts[1], parts[2][2]]


def _write_openlabel(path: Path, scene: Scene, frames: Sequence[Sequence[ToolBox]]) -> None:
    quaternions = np.roll(rotation_quaternion(scene.world_T_ego[:, :3, :3]), -1, axis=1).tolist()
    objects, written = {}, {}
    for k, boxes in enumerate(frames):
        pose = {"quaternion": quaternions[k], "translation": scene.world_T_ego[k, :3, 3].tolist()}
        moved = {f"{EGO}_to_{WORLD}": {"src": EGO, "dst": WORLD, "transform_src_to_dst": pose}}
        shapes = {}
        for id_, label, (*place, length, width, height, yaw) in boxes:
            w, *xyz = yaw_quaternion(yaw).tolist()
            cuboid = {"name": "shape", "coordinate_system": EGO, "val": [*place, *xyz, w, length, width, height]}
            shapes[id_] = {"object_data": {"cuboid": [cuboid]}}
            objects[id_] = {"name": f"{label} {id_}", "type": label}
        properties = {"timestamp": float(scene.timestamps[k]), "transforms": moved}
        written[str(k)] = {"frame_properties": properties, "objects": shapes}
    systems = {
        WORLD: {"type": "scene_cs", "parent": "", "children": [EGO]},
        EGO: {"type": "local_cs", "parent": WORLD, "children": []},
    }
    about = {"metadata": {"schema_version": "1.0.0", "name": scene.name}, "coordinate_systems": systems}
    _write_json(path, {"openlabel": {**about, "objects": objects, "frames": written}})


def _read_openlabel(path: Path) -> Iterator[tuple[str, list[ToolBox]]]:
    with error_context(str(path)):
        content = _field(parsed_json(read_text(path), str(path)), "openlabel", dict)
        objects = _field(content, "objects", dict, {})
        for frame, shown in _field(content, "frames", dict).items():
            boxes = []
            for id_, shape in _field(shown, "objects", dict, {}).items():
                with error_context(f"frame {frame[:40]}: object {id_[:40]}"):
                    label = _field(_field(objects, id_, dict), "type", str)
                    cuboids = _field(_field(shape, "object_data", dict), "cuboid", list)
                    boxes += [(id_, label, _openlabel_box(cuboid)) for cuboid in cuboids]
            yield frame, boxes


def _openlabel_box(cuboid: Any) -> list[float]:
    val = _numbers(_field(cuboid, "val", list), "val", 9, 10)
    if (system := _field(cuboid, "coordinate_system", str, EGO)) != EGO:
        raise InputError(f"coordinate_system: expected {EGO}, got {system[:40]!r}")
    if len(val) == 9:
        return [*val[:3], *val[-3:], val[5]]
    (rotation,) = checked_quaternions("val: rotation", [[val[6], *val[3:6]]])
    return [*val[:3], *val[-3:], float(quaternion_yaw(rotation))]


def _write_cvat(path: Path, scene: Scene, frames: Sequence[Sequence[ToolBox]]) -> None:
    labels = sorted({label for boxes in frames for _, label, _ in boxes})
    items = []
    for k, boxes in enumerate(frames):
        annotations = [
            {
                "id": n,
                "type": "cuboid_3d",
                "group": 0,
                "label_id": labels.index(label),
                "attributes": {"track_id": int(id_), "keyframe": True, "outside": False, "occluded": False},
                "position": place,
                "rotation": [0.0, 0.0, yaw],
                "scale": [length, width, height],
            }
            for n, (id_, label, (*place, length, width, height, yaw)) in enumerate(boxes)
        ]
        items.append({"id": f"{k:06d}", "annotations": annotations, "attr": {"frame": k}})
    named = [{"name": label, "parent": "", "attributes": []} for label in labels]
    categories = {"label": {"labels": named, "attributes": ["occluded"]}}
    _write_json(path / "annotations" / "default.json", {"info": {}, "categories": categories, "items": items})


def _read_cvat(path: Path) -> Iterator[tuple[str, list[ToolBox]]]:
    file = path / "annotations" / "default.json"
    with error_context(str(file)):
        content = parsed_json(read_text(file), str(file))
        known = _field(_field(_field(content, "categories", dict), "label", dict), "labels", list)
        labels = [_field(one, "name", str) for one in known]
        for item in _field(content, "items", list):
            name, boxes = Path(_field(item, "id", str)).name, []
            for n, one in enumerate(_field(item, "annotations", list)):
                with error_context(f"frame {name[:40]}: annotation {n}"):
                    attributes, number = _field(one, "attributes", dict, {}), _field(one, "label_id", int)
                    if not 0 <= number < len(labels):
                        raise InputError(f"label_id: expected 0 to {len(labels) - 1}, got {number}")
                    if not attributes.get("outside"):
                        boxes.append((str(attributes.get("track_id", "")), labels[number], _upright(one)))
            yield name, boxes


def _write_sustechpoints(path: Path, scene: Scene, frames: Sequence[Sequence[ToolBox]]) -> None:
    def along(x: float, y: float, z: float) -> dict[str, float]:
        return {"x": x, "y": y, "z": z}

    for k, boxes in enumerate(frames):
        content = [
            {
                "obj_id": id_,
                "obj_type": label,
                "psr": {"position": along(x, y, z), "scale": along(*size), "rotation": along(0.0, 0.0, yaw)},
            }
            for id_, label, (x, y, z, *size, yaw) in boxes
        ]
        _write_json(path / "label" / f"{k:06d}.json", content)


def _read_sustechpoints(path: Path) -> Iterator[tuple[str, list[ToolBox]]]:
    files = sorted((path / "label").glob("*.json"))
    if not files:
        raise InputError(f"{path / 'label'}: expected a file for each frame, there is none")
    for file in files:
        with error_context(str(file)):
            content, boxes = parsed_json(read_text(file), str(file)), []
            if not isinstance(content, list):
                raise InputError("expected a list of objects")
            for n, one in enumerate(content):
                with error_context(f"object {n}"):
                    kind = _field(one, "obj_type", str)
                    boxes.append((str(one.get("obj_id", "")), kind, _upright(one.get("psr"))))
            yield file.stem, boxes


_FORMATS = {
    "openlabel": ToolFormat(".json", _write_openlabel, _read_openlabel),
    "cvat": ToolFormat("", _write_cvat, _read_cvat, "annotations", "pointcloud"),
    "sustechpoints": ToolFormat("", _write_sustechpoints, _read_sustechpoints, "label", "lidar"),
}
