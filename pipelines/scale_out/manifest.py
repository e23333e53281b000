"""The manifest of a run: one JSON file a scene, `manifest/NAME.json`, with the origin of its results.

    {"scene": "scene-0001", "status": "done", "reason": "", "inputs": {"lidar": SHA256, ...}, "configuration": SHA256,
     "version": "0.1.0", "results": {"tracks/scene-0001.json": SHA256, ...}, "counts": {"tracks": 31, ...},
     "seconds": 1.25}

A record is written, whole or not at all, after the results it names; results without a valid record are those of a
killed run, and are made anew. Letters that file names cannot have are written as in URLs (%2F).

Results that a record no longer names are removed when its scene is done again. So that a forged record removes nothing
else, it may only name files of its own scene: `NAME.SUFFIX` in any folder, or what is below `FOLDER/NAME/`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import PurePosixPath
from urllib.parse import quote

from data_tools.files.json_stream import parsed_json
from pipelines.scale_out.folder import OutputFolder, is_inside
from pipelines.scale_out.job import Outcome, sha256
from saga_fg.errors import InputError

OF_THE_RUN = ("manifest", ".lock", ".scratch", "configuration.yaml")  # and of no scene


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

    def __init__(self, output: OutputFolder) -> None:
        self._output = output

    def record(self, scene: str) -> Record | None:
        """Return the record of a scene; None without one, or for an invalid one."""
        try:
            raw = parsed_json(self._output.read(_path(scene)) or b"", scene)
            record = Record(**{field.name: raw[field.name] for field in fields(Record)})
            texts = {**record.inputs, **record.results}.values()
            sound = (
                record.scene == scene
                and all(_belongs(name, scene) for name in record.results)
                and all(isinstance(text, str) for text in texts)
                and all(type(count) is int for count in record.counts.values())
            )
        except (InputError, KeyError, TypeError, AttributeError):
            return None
        return record if sound else None

    def valid(self, scene: str, configuration: str, version: str) -> Mapping[str, str] | None:
        """Return the hashes of the inputs whose results are complete and unchanged; None without such results."""
        record = self.record(scene)
        if record is None or (record.status, record.configuration, record.version) != ("done", configuration, version):
            return None
        for name, expected in record.results.items():
            content = self._output.read(name)
            if content is None or sha256(content) != expected:
                return None
        return record.inputs

    def take(self, outcome: Outcome, configuration: str) -> Record:
        """Write the results of a job that was done or failed, then its record."""
        before = self.record(outcome.name)
        for name in before.results if before is not None else ():
            if name not in outcome.files:
                self._output.remove(name)
        for name, content in outcome.files.items():
            self._output.write(name, content)
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
        self._output.write(_path(outcome.name), text.encode())
        return record


def _belongs(name: object, scene: str) -> bool:
    """Return True for the name of a result of a scene, which contains the scene's name."""
    if not isinstance(name, str) or not is_inside(name):
        return False
    *folders, last = name.split("/")
    own = file_name(scene)
    return (folders or [last])[0] not in OF_THE_RUN and (PurePosixPath(last).stem == own or own in folders[1:])


def _path(scene: str) -> str:
    return f"manifest/{file_name(scene)}.json"
