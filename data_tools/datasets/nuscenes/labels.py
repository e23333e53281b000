"""Labels as tables of nuScenes: a version of the dataset whose annotations are the labels.

    DIRECTORY/VERSION/sample_annotation.json, instance.json   made from the labels
    DIRECTORY/VERSION/category.json                           the dataset's, and the categories of the labels
    DIRECTORY/VERSION/*.json                                  copies of the dataset's other tables
    DIRECTORY/maps/*                                          copies of its map masks, which the development kit loads

Readers of nuScenes read them as annotations. An annotation has five additional fields: `label_score`, `label_source`,
`label_quality`, `position_covariance` (xx, xy, yy, m^2) and `yaw_variance` (rad^2). Points are not counted:
`num_lidar_pts` is 1 in detected boxes and 0 in filled ones. `visibility_token` and `attribute_tokens` are empty.
Objects of unknown size or heading are left out.

Schema: https://www.nuscenes.org/nuscenes#data-format.
"""

from __future__ import annotations

import json
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from data_tools.datasets.nuscenes.records import (
    CATEGORY_OF_CLASS,
    Record,
    box_fields,
    instance_record,
    linked,
    token,
)
from data_tools.datasets.nuscenes.tables import read_table, table_folder
from data_tools.files.atomic_files import atomic_directory, atomic_file, write_text
from data_tools.files.error_messages import error_context
from data_tools.files.input_files import open_bytes
from data_tools.files.json_stream import open_json, parsed_json
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import upper_triangle
from saga_fg.types.dataset import Scene

if TYPE_CHECKING:
    from saga_fg.smoothing import Labels

LabelledObject = tuple[str, list[Record]]
"""The class of an object, and its annotations in order of time."""


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
    """Write some scenes as input of `merge_label_parts`: one line `[class, [annotation, ...]]` for each object.

    Raises `InputError` as `write_nuscenes_labels` does.
    """
    with atomic_file(path) as file:
        for one in _objects(str(path), scenes):
            file.write(json.dumps(one, allow_nan=False).encode() + b"\n")


def merge_label_parts(directory: str | Path, dataroot: str | Path, version: str, parts: Iterable[str | Path]) -> None:
    """Write the tables of `write_nuscenes_labels` from files that `write_label_part` has written."""
    _write_tables(directory, dataroot, version, (one for part in parts for one in _read_part(Path(part))))


def _read_part(path: Path) -> Iterator[LabelledObject]:
    with open_json(path) as file:
        for line in file:
            label, records = parsed_json(line, str(path))
            yield label, records


def _objects(where: str, scenes: Iterable[tuple[Scene, Sequence[Labels]]]) -> Iterator[LabelledObject]:
    """The objects of some scenes; a class that nuScenes does not have is an `InputError`."""
    for scene, frames in scenes:
        with error_context(f"{where}: scene {scene.name}"):
            if len(frames) != len(scene):
                raise InputError(f"expected labels for {len(scene)} samples, got {len(frames)}")
            for label, records in _annotations(scene, frames):
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
                category = categories.setdefault(name, token("label", "category", name))
                instance(instance_record(records[0]["instance_token"], category, records))
        with open_json(source / "category.json") as file:
            known: list[Record] = parsed_json(file.read(), str(source / "category.json"))
        there = {record["token"] for record in known}
        known += [
            {"token": category, "name": name, "description": ""}
            for name, category in categories.items()
            if category not in there
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


def _annotations(scene: Scene, frames: Sequence[Labels]) -> list[LabelledObject]:
    """The class of each object, and its annotations in order of time, linked."""
    records: dict[int, list[Record]] = defaultdict(list)
    class_of: dict[int, str] = {}
    for sample, labels in zip(scene.tokens, frames, strict=True):
        boxes = labels.tracks.boxes
        rows = np.flatnonzero(np.isfinite(boxes.size).all(axis=1) & np.isfinite(boxes.yaw))
        tracks = labels.tracks.select(rows)
        columns = zip(
            tracks.id.tolist(),
            tracks.boxes.label.tolist(),
            box_fields(tracks.boxes, 6),
            tracks.score.tolist(),
            labels.source[rows].tolist(),
            labels.quality[rows].tolist(),
            upper_triangle(tracks.position_covariance).tolist(),
            labels.yaw_variance[rows].tolist(),
            strict=True,
        )
        for id_, label, box, score, source, quality, covariance, variance in columns:
            if class_of.setdefault(id_, label) != label:
                raise InputError(f"sample {sample}: object {id_}: expected one class, got {class_of[id_]} and {label}")
            records[id_].append(
                {
                    "token": token("label", "sample_annotation", sample, id_),
                    "sample_token": sample,
                    "instance_token": token("label", "instance", scene.name, id_),
                    "visibility_token": "",
                    "attribute_tokens": [],
                    **box,
                    "num_lidar_pts": int(source != "filled"),
                    "num_radar_pts": 0,
                    "label_score": score,
                    "label_source": source,
                    "label_quality": quality,
                    "position_covariance": covariance,
                    "yaw_variance": None if variance != variance else variance,
                }
            )
    return [(class_of[id_], linked(records[id_])) for id_ in sorted(records)]
