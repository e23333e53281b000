"""Rows to Parquet, with pyarrow (the extra [parquet])."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice
from pathlib import Path
from typing import Any

from data_tools.files.atomic_files import atomic_file
from saga_fg.errors import MissingExtraError

ROWS_AT_A_TIME = 65536


def write_parquet(
    path: str | Path, columns: tuple[str, ...], rows: Iterable[list[Any]], texts: tuple[str, ...]
) -> None:
    """Write rows as they come; columns in `texts` are text, id is a whole number, all others numbers, None is null.

    Raises `MissingExtraError` without pyarrow, `InputError` for a path that is not writable.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise MissingExtraError(f"{path}: Parquet needs pyarrow: pip install 'saga-fg[parquet]'") from error
    kinds = {name: pa.string() if name in texts else pa.int64() if name == "id" else pa.float64() for name in columns}
    schema = pa.schema(list(kinds.items()))
    source = iter(rows)
    with atomic_file(path) as file, pq.ParquetWriter(file, schema) as writer:
        while block := list(islice(source, ROWS_AT_A_TIME)):
            writer.write_table(pa.table(dict(zip(columns, zip(*block, strict=True), strict=True)), schema=schema))
