"""Tables of detections and truth with columns of somebody else, and the command on them."""

from __future__ import annotations

import csv
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import Result

from tests.pipelines.command import saga_fg

RNG = np.random.default_rng(11)
T0 = 1_700_000_000_000_000_000


def run_line(line: str) -> Result:
    words = shlex.split(line)
    assert words[0] == "saga-fg"
    return saga_fg(*words[1:])


def rows() -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Detections in no order, with other names, ns, degrees and percent; and true objects."""
    found, true = [], []
    for k in range(40):
        for n in range(6):
            way = 1 if n % 2 else -1
            x, y = 500 + way * (k * 1.1 - 14 * (n // 2)), 50.0 + 4 * (n % 2)
            box = {"l": 4.5, "w": 1.9, "h": 1.6, "hdg": 0.0 if way > 0 else 180.0}
            stamp = T0 + k * 100_000_000
            true.append({"ts_ns": stamp, "object_id": f"v{n}", "category": "VEHICLE", "pos_x": x, "pos_y": y, **box})
            at = {"pos_x": x + RNG.normal(0, 0.1), "pos_y": y + RNG.normal(0, 0.1)}
            found.append({"ts_ns": stamp, "category": "VEHICLE", **at, **box, "conf": RNG.uniform(60, 95)})
    RNG.shuffle(found)
    return found, true


def write(path: Path, table: list[dict[str, Any]]) -> Path:
    if path.suffix == ".csv":
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(table[0]))
            writer.writeheader()
            writer.writerows(table)
    else:
        pa = pytest.importorskip("pyarrow", reason="the extra [parquet] is not installed")
        import pyarrow.parquet

        pyarrow.parquet.write_table(pa.Table.from_pylist(table), path)
    return path
