"""The manifest of a run: one JSON file a scene, `manifest/NAME.json`, which says how its results came about.

    {"scene": "scene-0001", "status": "done", "reason": "", "inputs": {"lidar": SHA256, ...}, "configuration": SHA256,
     "version": "0.1.0", "results": {"tracks/scene-0001.json": SHA256, ...}, "counts": {"tracks": 31, ...},
     "seconds": 1.25}

A record is written, whole or not at all, after the results it names; so results without a valid record are those of a
run that was killed, and are made anew. Letters that file names cannot have are written as in URLs (%2F).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any
from urllib.parse import quote

from data_tools.atomic_files import remove_leftovers, write_bytes, write_text
from pipelines.scale_out.job import Outcome, sha256
from saga_fg.errors import InputError


@dataclass(frozen=True)
class Record:
    """A line of the manifest; all hashes are SHA-256.

    inputs         of each part of the scene's input
    configuration  of the text of everything else that the results depend on
    results        of every file, by its path relative to the output
    """

    scene: str
    status: str
    reason: str
    inputs: Mapping[str, str]
    configuration: str
    version: str
    results: Mapping[str, str]
    counts: Mapping[str, int]
    seconds: float


def file_name(scene: str) -> str:
    """A scene's name as a file may have it."""
    return quote(scene, safe=" ()+,;=@[]{}!#$&'^~")


class Manifest:
    """The records and results in a folder."""

    def __init__(self, output: Path) -> None:
        """Make the folders, where they are missing. Raises `InputError` where that is not possible."""
        self._output, self._folder = output, output / "manifest"
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{output}: not writable: {error.strerror}; expected a folder for the results") from error

    def clean(self) -> None:
        """Remove what a killed run left under temporary names."""
        remove_leftovers(self._output.resolve().parent, self._output.resolve().name)
        for folder in (self._output, *(path for path in self._output.rglob("*") if path.is_dir())):
            remove_leftovers(folder)

    def record(self, scene: str) -> Record | None:
        """What is known of a scene; None where there is no record, or none that can be read."""
        try:
            raw: Any = json.loads((self._folder / f"{file_name(scene)}.json").read_bytes())
            return Record(**{field.name: raw[field.name] for field in fields(Record)})
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def valid(self, scene: str, configuration: str, version: str) -> Mapping[str, str] | None:
        """The hashes of the inputs whose results are there, complete and unharmed; None if there are none."""
        record = self.record(scene)
        if record is None or (record.status, record.configuration, record.version) != ("done", configuration, version):
            return None
        for name, expected in record.results.items():
            try:
                if sha256((self._output / name).read_bytes()) != expected:
                    return None
            except OSError:
                return None
        return record.inputs

    def take(self, outcome: Outcome, configuration: str) -> Record:
        """Write the results of a job that was done or failed, then its record."""
        before = self.record(outcome.name)
        for name in before.results if before is not None else ():
            if name not in outcome.files:
                (self._output / name).unlink(missing_ok=True)
        for name, content in outcome.files.items():
            path = self._output / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, content)
        record = Record(
            scene=outcome.name,
            status=outcome.status,
            reason=outcome.reason,
            inputs=outcome.digests,
            configuration=configuration,
            version=outcome.version,
            results={name: sha256(content) for name, content in outcome.files.items()},
            counts=outcome.counts,
            seconds=round(outcome.seconds, 3),
        )
        text = json.dumps(asdict(record), indent=1, ensure_ascii=False) + "\n"
        write_text(self._folder / f"{file_name(outcome.name)}.json", text)
        return record
