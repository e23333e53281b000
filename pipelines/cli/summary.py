"""The line that says what a run of the tracker did."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from pipelines.config import TrackConfig
    from pipelines.tracking import TrackedScene
    from saga_fg.tracking import SensorTime


@dataclass
class Summary:
    """Counts the scenes that pass through it."""

    output: Path
    scenes: int = 0
    frames: int = 0
    boxes: int = 0
    seconds: float = 0.0
    best_score: dict[tuple[str, int], float] = field(default_factory=dict)  # of each track, by scene and id
    milliseconds: dict[str, tuple[float, ...]] = field(default_factory=dict)
    classes: set[str] = field(default_factory=set)
    clocks: dict[str, Mapping[str, SensorTime]] = field(default_factory=dict)  # of the sensors, by scene

    def of(self, runs: Iterable[TrackedScene]) -> Iterator[TrackedScene]:
        """Pass runs on and count them."""
        for run in runs:
            self.scenes += 1
            self.frames += run.frames
            self.seconds += run.seconds
            self.milliseconds[run.scene.name] = run.milliseconds
            if run.clocks:
                self.clocks[run.scene.name] = run.clocks
            self.boxes += sum(len(tracks) for tracks in run.tracks)
            for tracks in run.tracks:
                self.classes.update(tracks.boxes.label.tolist())
                for id_, score in zip(tracks.id.tolist(), tracks.score.tolist(), strict=True):
                    track = (run.scene.name, id_)
                    self.best_score[track] = max(score, self.best_score.get(track, score))
            yield run

    def write_record(self, method: str, settings: TrackConfig, recordings: Mapping[str, Any]) -> None:
        """Write the record of the run beside its result, for reports; recordings: `DatasetSource.kept`."""
        from pipelines.configuration import write_settings
        from pipelines.report.run_record import RunRecord, write_run_record

        rounded = {name: [round(ms, 3) for ms in times] for name, times in self.milliseconds.items()}
        configuration = write_settings(settings, comments=False)
        write_run_record(
            self.output, RunRecord(method, configuration, rounded, recordings=recordings, clocks=self.clocks)
        )

    def show(self) -> None:
        """Print the line on stdout."""
        rate = f", {self.frames / self.seconds:.0f} frames/s" if self.seconds > 0 else ""
        sure = sum(score > 0.5 for score in self.best_score.values())
        tracks = f"{counted(len(self.best_score), 'track')} ({sure} with a score above 0.5)"
        counts = (counted(self.scenes, "scene"), counted(self.frames, "frame"), tracks, counted(self.boxes, "box"))
        typer.echo(f"{self.output}: {', '.join(counts)}{rate}")


def counted(number: int, noun: str) -> str:
    """`1 box`, `2 boxes`."""
    plural = "" if number == 1 else "es" if noun.endswith("x") else "s"
    return f"{number} {noun}{plural}"
