"""Reading the tables of nuScenes: arrays of flat records, one file a table, joined by tokens.

Schema: https://www.nuscenes.org/nuscenes#data-format. The tables of a full download have millions of rows, so they
are walked and only the wanted fields of the wanted rows are kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

from data_tools.files.json_stream import JsonStream, open_json
from saga_fg.errors import InputError

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
