"""The tables of nuScenes: flat records joined by tokens, splits, classes, and records to write.

Reading the tables of nuScenes: arrays of flat records, one file a table, joined by tokens.

Schema: https://www.nuscenes.org/nuscenes#data-format. The tables of a full download have millions of rows, so they
are walked and only the wanted fields of the wanted rows are kept.

Scenes of the splits.

The tables do not say it. The official splits are lists of scenes published with the development kit
(https://github.com/nutonomy/nuscenes-devkit, `utils/splits.py`); scene names are numbered, and of the scenes of
v1.0-trainval a few number ranges are `val` and `train_detect`, the rest `train` and `train_track`. Splits of one's own
are lists of scene names in `splits.json` beside the tables, the place the development kit looks in.

The classes of nuScenes.

Detections have ten classes, tracks seven of them; annotations have 23 categories, of which eleven map onto the seven.
Source: the official definitions of the detection and tracking tasks, https://www.nuscenes.org/tracking, and
https://github.com/nutonomy/nuscenes-devkit/tree/master/python-sdk/nuscenes/eval.

Records of nuScenes tables and result files to write: tokens, boxes, links, instances.

Schema: https://www.nuscenes.org/nuscenes#data-format.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

from data_tools.files.input_files import unknown_name
from data_tools.files.readers import JsonStream, open_json
from saga_fg.errors import InputError
from saga_fg.numerics.geometry import yaw_quaternion
from saga_fg.types.boxes import Boxes

_TEXT_FIELDS = ("name", "channel", "next")  # and all that end in "token"


def table_folder(dataroot: str | Path, version: str) -> Path:
    """The folder of the tables; raises `InputError` naming the versions that are there."""
    folder = Path(dataroot) / version
    if not version or not folder.is_dir():
        root = Path(dataroot)
        present = sorted(p.parent.name for p in root.glob("*/scene.json")) if root.is_dir() else []
        there = f"; versions there: {', '.join(present)}" if present else ""
        raise InputError(f"{folder}: expected the folder of the nuScenes tables{there}")
    return folder


def read_table(folder: Path, table: str, fields: tuple[str, ...]) -> Iterator[tuple[Any, ...]]:
    """The `fields` of every row; names, channels and tokens are strings.

    Raises `InputError` for a missing table, broken JSON, a row without a field.
    """
    path = folder / f"{table}.json"
    if not path.is_file():
        raise InputError(f"{path}: missing table {table!r}")
    pick = itemgetter(*fields)
    text = [i for i, field in enumerate(fields) if field.endswith("token") or field in _TEXT_FIELDS]
    with open_json(path) as file:
        stream = JsonStream(file, str(path))
        for number, row in enumerate(stream.array()):
            try:
                values = pick(row)
            except (KeyError, TypeError, IndexError) as error:
                raise InputError(_broken(path, number, row, fields)) from error
            if len(fields) == 1:
                values = (values,)
            for i in text:
                if not isinstance(values[i], str):
                    raise InputError(f"{path}: record {number}: {fields[i]}: expected a string, got {values[i]!r}")
            yield values
        stream.end()


def _broken(path: Path, number: int, row: Any, fields: tuple[str, ...]) -> str:
    if not isinstance(row, dict):
        return f"{path}: record {number}: expected an object with fields {', '.join(fields)}"
    missing = next(field for field in fields if field not in row)
    return f"{path}: record {number} ({row.get('token', 'no token')}): field {missing!r} is missing"


_MINI_VAL = {"scene-0103", "scene-0916"}

_VAL = (
    *((3, 3), (12, 18), (35, 39), (92, 110), (221, 221), (268, 278), (329, 346), (519, 524), (552, 565), (625, 638)),
    *((770, 784), (794, 802), (904, 931), (962, 972), (1059, 1073)),
)
_TRAIN_DETECT = (
    *((1, 2), (41, 76), (161, 176), (190, 214), (254, 264), (283, 324), (347, 375), (382, 382), (420, 439), (457, 480)),
    *((566, 583), (665, 689), (739, 769), (868, 903), (945, 961), (975, 991), (1011, 1025), (1074, 1105)),
)

_VERSION_OF_SPLIT = {
    "mini_train": "mini",
    "mini_val": "mini",
    "train": "trainval",
    "train_detect": "trainval",
    "train_track": "trainval",
    "val": "trainval",
    "test": "test",
}


def split_scenes(dataroot: str | Path, version: str, split: str) -> tuple[str, ...]:
    """The names of the scenes of a split that the tables hold, in the order of the tables.

    Reads the scene table and `splits.json` alone. Raises `InputError` for an unknown split, an official one that does
    not belong to this version, and one of which no scene is present.
    """
    folder = table_folder(dataroot, version)
    scenes = [name for (name,) in read_table(folder, "scene", ("name",))]
    own = _own_splits(folder)
    if split in _VERSION_OF_SPLIT:
        wanted_version = _VERSION_OF_SPLIT[split]
        if not version.endswith(wanted_version):
            raise InputError(f"split {split} belongs to v1.0-{wanted_version}, the tables read are {version}")
        chosen = [name for name in scenes if _in_official_split(name, split)]
    elif split in own:
        chosen = [name for name in scenes if name in own[split]]
    else:
        official = [name for name, kind in _VERSION_OF_SPLIT.items() if version.endswith(kind)]
        raise InputError(f"{folder / 'splits.json'}: {unknown_name('split', split, (*official, *own))}")
    if not chosen:
        raise InputError(f"{folder / 'scene.json'}: expected scenes of split {split}, the table holds none of them")
    return tuple(chosen)


def _in_official_split(name: str, split: str) -> bool:
    if split == "test":
        return True
    if split.startswith("mini"):
        return (name in _MINI_VAL) == (split == "mini_val")
    number = name.removeprefix("scene-")
    if not number.isdecimal() or len(number) > 9:
        raise InputError(f"scene {name[:40]}: expected a name scene-NNNN to find its place in split {split}")
    val = _within(int(number), _VAL)
    detect = _within(int(number), _TRAIN_DETECT)
    return {"val": val, "train": not val, "train_detect": detect, "train_track": not (val or detect)}[split]


def _within(number: int, ranges: Iterable[tuple[int, int]]) -> bool:
    return any(first <= number <= last for first, last in ranges)


def _own_splits(folder: Path) -> dict[str, frozenset[str]]:
    path = folder / "splits.json"
    if not path.exists():
        return {}
    with open_json(path) as file:
        stream = JsonStream(file, str(path))
        splits = stream.value()
        stream.end()
    if not isinstance(splits, dict) or not all(
        isinstance(names, list) and all(isinstance(name, str) for name in names) for names in splits.values()
    ):
        raise InputError(f"{path}: expected an object of lists of scene names")
    return {split: frozenset(names) for split, names in splits.items()}


TRACKING_CLASSES = ("bicycle", "bus", "car", "motorcycle", "pedestrian", "trailer", "truck")

DETECTION_CLASSES = (*TRACKING_CLASSES, "barrier", "construction_vehicle", "traffic_cone")

CATEGORY_TO_TRACKING_CLASS = {
    "human.pedestrian.adult": "pedestrian",
    "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian",
    "human.pedestrian.police_officer": "pedestrian",
    "vehicle.bicycle": "bicycle",
    "vehicle.bus.bendy": "bus",
    "vehicle.bus.rigid": "bus",
    "vehicle.car": "car",
    "vehicle.motorcycle": "motorcycle",
    "vehicle.trailer": "trailer",
    "vehicle.truck": "truck",
}


Record = dict[str, Any]

CATEGORY_OF_CLASS = {
    "barrier": "movable_object.barrier",
    "bicycle": "vehicle.bicycle",
    "bus": "vehicle.bus.rigid",
    "car": "vehicle.car",
    "construction_vehicle": "vehicle.construction",
    "motorcycle": "vehicle.motorcycle",
    "pedestrian": "human.pedestrian.adult",
    "traffic_cone": "movable_object.trafficcone",
    "trailer": "vehicle.trailer",
    "truck": "vehicle.truck",
}


def token(*parts: object) -> str:
    """The token of a record: a hash of the parts that identify it."""
    return hashlib.md5("/".join(map(str, parts)).encode(), usedforsecurity=False).hexdigest()


def box_fields(boxes: Boxes, decimals: int) -> list[Record]:
    """`translation`, `size` (width, length, height) and `rotation` of each box, m, rounded to `decimals`."""
    columns = zip(
        boxes.position.round(decimals).tolist(),
        boxes.size[:, [1, 0, 2]].round(decimals).tolist(),
        yaw_quaternion(boxes.yaw).tolist(),
        strict=True,
    )
    return [{"translation": position, "size": size, "rotation": rotation} for position, size, rotation in columns]


def linked(records: list[Record]) -> list[Record]:
    """The records, which are in order of time, with the tokens of their neighbours as `prev` and `next`."""
    tokens = ["", *(record["token"] for record in records), ""]
    return [
        {**record, "prev": before, "next": after}
        for record, before, after in zip(records, tokens[:-2], tokens[2:], strict=True)
    ]


def instance_record(instance: str, category: str, annotations: list[Record]) -> Record:
    """The `instance` of an object: its token, that of its category, and its annotations in order of time."""
    return {
        "token": instance,
        "category_token": category,
        "nbr_annotations": len(annotations),
        "first_annotation_token": annotations[0]["token"],
        "last_annotation_token": annotations[-1]["token"],
    }
