"""The folder of a run: results of scenes, whole or not there, and a manifest of what was done.

The manifest has a JSON file a scene, `manifest/NAME.json`, with the origin of its results.

    {"scene": "scene-0001", "status": "done", "reason": "", "inputs": {"lidar": SHA256, ...}, "configuration": SHA256,
     "version": "0.1.0", "results": {"tracks/scene-0001.json": SHA256, ...}, "counts": {"tracks": 31, ...},
     "seconds": 1.25}

A record is written, whole or not at all, after the results it names; results without a valid record are those of a
killed run, and are made anew. Letters that file names cannot have are written as in URLs (%2F).

Results that a record no longer names are removed when its scene is done again. So that a forged record removes nothing
else, it may only name files of its own scene: `NAME.SUFFIX` in any folder, or what is below `FOLDER/NAME/`. For the
same reason nothing is read, written or removed through a link that somebody has planted in the folder, which may be one
itself: the user names it.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path, PurePosixPath
from urllib.parse import quote

from data_tools.files.atomic_files import remove_leftovers, write_bytes
from data_tools.files.readers import parsed_json
from pipelines.scale_out.pools import Outcome
from saga_fg.errors import InputError


class OutputFolder:
    """Files by their names relative to a folder, with `/` between the parts of a name."""

    def __init__(self, path: Path) -> None:
        """Make the folder where it is missing. Raises `InputError` where that is not possible."""
        self.path = path
        with self._writing(""):
            path.mkdir(parents=True, exist_ok=True)
            self._root = path.resolve()

    def read(self, name: str) -> bytes | None:
        """The content of a regular file; None where there is none, or where a link is on the way."""
        with suppress(OSError):
            path = self._at(name)
            if _is_regular(path):
                return path.read_bytes()
        return None

    def write(self, name: str, content: bytes) -> None:
        """Write a file, whole or not at all. Raises `InputError` where that is not possible without following links."""
        with self._writing(name):
            path = self._at(name)
            path.parent.mkdir(parents=True, exist_ok=True)
            if not _is_regular(path):  # a link or a pipe is replaced
                path.unlink(missing_ok=True)
            write_bytes(path, content)

    def remove(self, name: str) -> None:
        """Remove a file, a link, or a folder with its content, if there is one."""
        with suppress(OSError):
            path = self._at(name)
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()

    def new_folder(self, name: str) -> Path:
        """Make an empty folder in place of anything of its name. Raises `InputError` where that is not possible."""
        self.remove(name)
        with self._writing(name):
            self._at(name).mkdir()
        return self.path / name

    def remove_leftovers(self) -> None:
        """Remove temporary files of killed runs, here, in folders below, and of this folder itself."""
        remove_leftovers(self._root.parent, self._root.name)
        for folder, _, _ in os.walk(self._root):
            remove_leftovers(folder)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold the folder for the block; the system lets go of it when the process ends, however it does.

        Raises `InputError` if another process holds it.
        """
        with self._writing(".lock"):
            lock = os.open(self._at(".lock"), os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
        try:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise InputError(f"{self.path}: another run is writing to this folder") from error
            yield
        finally:
            os.close(lock)

    def _at(self, name: str) -> Path:
        """Path of a file. Raises `OSError` where a link is on the way."""
        path = self._root / name
        if path.parent.resolve() != path.parent:
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
        return path

    @contextmanager
    def _writing(self, name: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            reason = "expected no link on the way" if name and error.errno == errno.ELOOP else error.strerror
            where = self.path / name
            raise InputError(f"{where}: not writable: {reason}; expected a folder for the results") from error


def _is_regular(path: Path) -> bool:
    return path.is_file() and not path.is_symlink()


def is_inside(name: object) -> bool:
    """Return True for the name of a file below a folder: relative, and without `..`."""
    if not isinstance(name, str) or "\0" in name:
        return False
    path = PurePosixPath(name)
    return str(path) == name and not path.is_absolute() and ".." not in path.parts and name != "."


def sha256(content: bytes) -> str:
    """Return the SHA-256 in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


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
