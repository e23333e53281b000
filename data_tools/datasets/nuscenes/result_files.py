"""Reading a nuScenes result file sample by sample, whatever its size."""

from __future__ import annotations

from collections.abc import Container, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

from data_tools.datasets.nuscenes.result_boxes import ResultBoxes, ResultColumns, Task
from data_tools.files.json_stream import JsonStream, open_json
from saga_fg.errors import InputError


@dataclass(frozen=True)
class ResultMeta:
    """Sensors and data that a result uses: the official `meta` of a result file."""

    use_camera: bool = False
    use_lidar: bool = False
    use_radar: bool = False
    use_map: bool = False
    use_external: bool = False

    @classmethod
    def union(cls, *metas: ResultMeta) -> Self:
        """Everything that several results use together."""
        return cls(**{f.name: any(getattr(meta, f.name) for meta in metas) for f in fields(cls)})


@dataclass(frozen=True, eq=False)
class ResultFile:
    meta: ResultMeta
    boxes: ResultBoxes


def read_result_file(
    path: str | Path, task: Task, known: Container[str] | None = None, wanted: Container[str] | None = None
) -> ResultFile:
    """Read the boxes of the `wanted` samples (None: of all).

    Raises `InputError` for a file that cannot be read or is not JSON, for samples that are not among the `known` ones
    (None: any will do), and for boxes of wanted samples that are not as the format says.
    """
    path = Path(path)
    columns = ResultColumns(str(path), task)
    meta = ResultMeta()
    for token, value in result_entries(path):
        if token is None:
            meta = _meta(path, value)
        elif known is not None and token not in known:
            raise InputError(f"{path}: sample {token}: expected samples of the tables, they hold no such sample")
        elif wanted is None or token in wanted:
            columns.add(token, value)
    return ResultFile(meta, columns.finish())


def result_entries(path: Path) -> Iterator[tuple[str | None, Any]]:
    """Each sample's token and its boxes as they stand in the file; None and the file's `meta` in between.

    Raises `InputError` for a file that cannot be read, is not JSON or has no results.
    """
    found = False
    with open_json(path) as file:
        stream = JsonStream(file, str(path))
        for key in stream.members():
            if key == "results":
                found = True
                for token in stream.members():
                    yield token, stream.value()
            else:
                value = stream.value()
                if key == "meta":
                    yield None, value
        stream.end()
    if not found:
        raise InputError(f"{path}: expected a field 'results' with the boxes of each sample")


def _meta(path: Path, value: Any) -> ResultMeta:
    if not isinstance(value, dict):
        raise InputError(f"{path}: meta: expected an object with use_camera, use_lidar, ..., got {str(value)[:40]}")
    return ResultMeta(**{f.name: bool(value.get(f.name, False)) for f in fields(ResultMeta)})
