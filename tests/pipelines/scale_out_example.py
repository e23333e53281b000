"""A folder of detection files, and tasks that end their worker; workers import this module."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from data_tools.datasets.detection_file_source import DetectionFileSource, table_part
from data_tools.datasets.detection_files import TableImport
from data_tools.datasets.source import Part
from pipelines.config import load_config
from pipelines.scale_out import Job, Outcome, TrackTask, perform
from saga_fg.types.dataset import Dataset

CONFIG = load_config("file")
TRACK = TrackTask(CONFIG, "saga", DetectionFileSource())


def write_recordings(folder: Path, count: int, rows: int = 15) -> list[Part]:
    """Files `a00.csv`, `a01.csv`, ..., each with two cars side by side, faster ones in later files."""
    folder.mkdir(exist_ok=True)
    for number in range(count):
        lines = ["timestamp,label,x,y,score"]
        for k in range(rows):
            x = k * (0.5 + 0.1 * number)
            lines += [f"{k / 10},car,{x},0.0,0.9", f"{k / 10},car,{x + 0.3},4.0,0.8"]
        (folder / f"a{number:02d}.csv").write_text("\n".join(lines) + "\n")
    return [table_part(str(path), TableImport()) for path in sorted(folder.glob("*.csv"))]


def content(output: Path) -> dict[str, bytes]:
    """Every result of a run by name."""
    return {path.name: path.read_bytes() for path in sorted((output / "tracks").iterdir())}


class InThisProcess:
    """The plainest of pools."""

    def outcomes(self, jobs: Iterator[Job], total: int) -> Iterator[Outcome]:
        return map(perform, jobs)


@dataclass(frozen=True)
class Deadly:
    """Tracks, but the worker that does `victim` is killed: for the first `times`, which files in `folder` count."""

    victim: str
    folder: Path
    times: int
    configuration: str = "deadly"

    def run(self, name: str, dataset: Dataset, folder: Path) -> Mapping[str, int]:
        deaths = len(list(self.folder.iterdir()))
        if name == self.victim and deaths < self.times:
            (self.folder / str(deaths)).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return TRACK.run(name, dataset, folder)


@dataclass(frozen=True)
class Broken:
    """A task with a mistake in it."""

    configuration: str = "broken"

    def run(self, name: str, dataset: Dataset, folder: Path) -> Mapping[str, int]:
        raise ZeroDivisionError(name)
