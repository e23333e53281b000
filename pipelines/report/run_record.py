"""The record of a run, written beside its result for reports: method, version, configuration and times.

{"method": "saga", "version": "0.1.0", "configuration": YAML, "milliseconds": {scene: [of each frame]},
 "recordings": how they were read, "clocks": {scene: {sensor: its clock}} where there are several}
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from data_tools.datasets.source import DatasetSource
from data_tools.files.atomic_files import write_text
from data_tools.files.input_files import read_bytes
from data_tools.files.json_stream import parsed_json
from saga_fg.errors import InputError
from saga_fg.tracking import SensorTime


@dataclass(frozen=True)
class RunRecord:
    """method; version of saga-fg; configuration, YAML; milliseconds in the tracker for every frame, by scene.

    recordings  how the dataset was read, `DatasetSource.kept`
    clocks      of the sensors by scene
    """

    method: str
    configuration: str
    milliseconds: Mapping[str, Sequence[float]]
    version: str = version("saga-fg")
    recordings: Mapping[str, Any] = field(default_factory=dict)
    clocks: Mapping[str, Mapping[str, SensorTime]] = field(default_factory=dict)


def record_path(result: Path) -> Path:
    """Return the path of a result's record: beside a file, or in a folder of results."""
    return result / "run.json" if result.is_dir() else result.with_name(f"{result.stem}.run.json")


def write_run_record(result: Path, record: RunRecord) -> None:
    """Write the record of a result that has just been written."""
    write_text(record_path(result), json.dumps(asdict(record)) + "\n")


def read_run_record(result: Path) -> RunRecord | None:
    """Read the record of a result, None if it has none. Raises `InputError` for a broken one."""
    path = record_path(result)
    if not path.is_file():
        return None
    raw = parsed_json(read_bytes(path), str(path))
    try:
        milliseconds = {str(name): [float(ms) for ms in times] for name, times in raw["milliseconds"].items()}
        kept = dict(raw.get("recordings", {}))
        clocks = {
            str(name): {str(k): SensorTime(**v) for k, v in of.items()} for name, of in raw.get("clocks", {}).items()
        }
        return RunRecord(str(raw["method"]), str(raw["configuration"]), milliseconds, str(raw["version"]), kept, clocks)
    except (ValueError, OverflowError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: expected the record of a run: {error}") from error


def as_recorded(source: DatasetSource, result: Path) -> DatasetSource:
    """A dataset, read as it was for a result, where its options do not say otherwise."""
    record = read_run_record(result)
    return source if record is None else source.with_kept(record.recordings)
