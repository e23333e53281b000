"""Labels as tables of nuScenes: a version of the dataset whose annotations are the labels.

    DIRECTORY/VERSION/sample_annotation.json, instance.json   made from the labels
    DIRECTORY/VERSION/category.json                           the dataset's, with what labels need besides
    DIRECTORY/VERSION/*.json                                  the dataset's other tables, as they are
    DIRECTORY/maps/*                                          its map masks, which the development kit loads

so that whatever reads nuScenes reads the labels. An annotation has five fields more, which readers of the format leave
alone: `label_score`, `label_source`, `label_quality`, `position_covariance` (xx, xy, yy, m^2) and `yaw_variance`
(rad^2). Nobody counted points: `num_lidar_pts` is 1 where the object was detected and 0 in filled boxes.
`visibility_token` is empty, `attribute_tokens` too. Objects of unknown size or heading are left out.

Schema: https://www.nuscenes.org/nuscenes#data-format.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets.nuscenes.tables import read_table, table_folder
from data_tools.files.atomic_files import atomic_directory, atomic_file, write_text
from data_tools.files.input_files import open_bytes
from data_tools.files.json_stream import open_json, parsed_json
from data_tools.files.located import located
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import upper_triangle
from saga_fg.numerics.geometry import yaw_quaternion
from saga_fg.smoothing import Labels
from saga_fg.types.dataset import Scene

Record = dict[str, Any]

LabelledObject = tuple[str, list[Record]]
"""The class of an object, and its annotations in order of time."""

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


def write_nuscenes_labels(
    directory: str | Path,
    dataroot: str | Path,
    version: str,
    scenes: Iterable[tuple[Scene, Sequence[Labels]]],
) -> None:
    """Write the labels of some scenes of dataroot/version to directory/version; the files appear when all is done.

    The tables hold all scenes of the version; those that are not among `scenes` have no annotations. Raises
    `InputError` for tables that are missing, a directory that is not writable, labels that do not fit their scene.
    """
    _write_tables(directory, dataroot, version, _objects(str(directory), scenes))


def write_label_part(path: str | Path, scenes: Iterable[tuple[Scene, Sequence[Labels]]]) -> None:
    """Write what `merge_label_parts` needs of some scenes: a line `[class, [annotation, ...]]` an object.

    Raises `InputError` as `write_nuscenes_labels` does.
    """
    with atomic_file(path) as file:
        for one in _objects(str(path), scenes):
            file.write(json.dumps(one, allow_nan=False).encode() + b"\n")


def merge_label_parts(directory: str | Path, dataroot: str | Path, version: str, parts: Iterable[str | Path]) -> None:
    """The same as `write_nuscenes_labels`, of files that `write_label_part` has written."""
    _write_tables(directory, dataroot, version, (one for part in parts for one in _read_part(Path(part))))


def _read_part(path: Path) -> Iterator[LabelledObject]:
    with open_json(path) as file:
        for line in file:
            label, records = parsed_json(line, str(path))
            yield label, records


def _objects(where: str, scenes: Iterable[tuple[Scene, Sequence[Labels]]]) -> Iterator[LabelledObject]:
    """The objects of some scenes; a class that nuScenes does not have is an `InputError`."""
    for scene, moments in scenes:
        with located(f"{where}: scene {scene.name}"):
            if len(moments) != len(scene):
                raise InputError(f"expected labels for {len(scene)} samples, got {len(moments)}")
            for label, records in _annotations(scene, moments):
                if label not in CATEGORY_OF_CLASS:
                    raise InputError(f"class {label}: expected one of {', '.join(CATEGORY_OF_CLASS)}")
                yield label, records


def _write_tables(directory: str | Path, dataroot: str | Path, version: str, objects: Iterable[LabelledObject]) -> None:
    """Write all tables; those of annotations and instances object by object."""
    source = table_folder(dataroot, version)
    categories = dict(read_table(source, "category", ("name", "token")))
    with atomic_directory(directory) as folder:
        tables = folder / version
        tables.mkdir()
        for path in sorted(source.glob("*.json")):
            if path.stem not in ("sample_annotation", "instance", "category"):
                _copy(path, tables / path.name)
        for (name,) in read_table(source, "map", ("filename",)):
            mask = Path(dataroot) / name
            if mask.is_file() and Path(name).parts[0] == "maps" and ".." not in Path(name).parts:
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                _copy(mask, folder / name)
        with _array(tables / "sample_annotation.json") as annotation, _array(tables / "instance.json") as instance:
            for label, records in objects:
                name = CATEGORY_OF_CLASS[label]
                for record in records:
                    annotation(record)
                instance(_instance(records, categories.setdefault(name, _token("category", name))))
        with open_json(source / "category.json") as file:
            known: list[Record] = parsed_json(file.read(), str(source / "category.json"))
        there = {record["token"] for record in known}
        known += [
            {"token": token, "name": name, "description": ""}
            for name, token in categories.items()
            if token not in there
        ]
        write_text(tables / "category.json", json.dumps(known) + "\n")


def _copy(source: Path, target: Path) -> None:
    with open_bytes(source) as file, target.open("wb") as copy:
        shutil.copyfileobj(file, copy)


@contextmanager
def _array(path: Path) -> Iterator[Callable[[Record], None]]:
    """A function that appends a record to the JSON array that the file is."""
    first = True
    with path.open("w", encoding="utf-8") as file:

        def append(record: Record) -> None:
            nonlocal first
            file.write(("[\n" if first else ",\n") + json.dumps(record, allow_nan=False))
            first = False

        yield append
        file.write("[]\n" if first else "\n]\n")


def _annotations(scene: Scene, moments: Sequence[Labels]) -> list[LabelledObject]:
    """The class of each object, and its annotations in order of time, linked."""
    of_object: dict[int, list[Record]] = defaultdict(list)
    class_of: dict[int, str] = {}
    for sample, moment in zip(scene.tokens, moments, strict=True):
        tracks, boxes = moment.tracks, moment.tracks.boxes
        whole = np.flatnonzero(np.isfinite(boxes.size).all(axis=1) & np.isfinite(boxes.yaw))
        columns = zip(
            tracks.id[whole].tolist(),
            boxes.label[whole].tolist(),
            boxes.position[whole].round(6).tolist(),
            boxes.size[whole][:, [1, 0, 2]].round(6).tolist(),
            yaw_quaternion(boxes.yaw[whole]).tolist(),
            tracks.score[whole].tolist(),
            moment.source[whole].tolist(),
            moment.quality[whole].tolist(),
            upper_triangle(tracks.position_covariance[whole]).tolist(),
            moment.yaw_variance[whole].tolist(),
            strict=True,
        )
        for id_, label, position, size, rotation, score, origin, quality, covariance, variance in columns:
            if class_of.setdefault(id_, label) != label:
                raise InputError(f"sample {sample}: object {id_}: expected one class, got {class_of[id_]} and {label}")
            of_object[id_].append(
                {
                    "token": _token("sample_annotation", sample, id_),
                    "sample_token": sample,
                    "instance_token": _token("instance", scene.name, id_),
                    "visibility_token": "",
                    "attribute_tokens": [],
                    "translation": position,
                    "size": size,
                    "rotation": rotation,
                    "num_lidar_pts": int(origin != "filled"),
                    "num_radar_pts": 0,
                    "label_score": score,
                    "label_source": origin,
                    "label_quality": quality,
                    "position_covariance": covariance,
                    "yaw_variance": None if variance != variance else variance,
                }
            )
    for records in of_object.values():
        tokens = ["", *(record["token"] for record in records), ""]
        for record, before, after in zip(records, tokens[:-2], tokens[2:], strict=True):
            record |= {"prev": before, "next": after}
    return [(class_of[id_], records) for id_, records in sorted(of_object.items())]


def _instance(records: list[Record], category: str) -> Record:
    return {
        "token": records[0]["instance_token"],
        "category_token": category,
        "nbr_annotations": len(records),
        "first_annotation_token": records[0]["token"],
        "last_annotation_token": records[-1]["token"],
    }


def _token(*parts: object) -> str:
    """The token of a record: a hash of what it names."""
    return hashlib.md5("/".join(("label", *map(str, parts))).encode(), usedforsecurity=False).hexdigest()
