"""Runs a task over many scenes in a pool of workers; results and manifest go to a folder.

A scene is skipped if the manifest has it as done with the same inputs, configuration and version, and its results are
unchanged. One run at a time may write to a folder.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Protocol

from data_tools.datasets.parts import Part
from data_tools.files.atomic_files import remove_leftovers
from pipelines.scale_out.folder import OutputFolder
from pipelines.scale_out.job import Job, Outcome, SceneTask, sha256
from pipelines.scale_out.manifest import Manifest, Record
from saga_fg.errors import InputError

log = logging.getLogger(__name__)


class Pool(Protocol):
    """Workers that perform jobs: processes of this machine, or a cluster."""

    def outcomes(self, jobs: Iterator[Job], total: int) -> Iterator[Outcome]:
        """Yield the outcomes of all jobs as they come."""
        ...


@dataclass
class RunSummary:
    """Names of the scenes by status; reasons of the failed ones; counts over all results."""

    done: list[str] = field(default_factory=list)
    unchanged: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)

    @property
    def scenes(self) -> int:
        """Number of scenes."""
        return len(self.done) + len(self.unchanged) + len(self.failed)


def run_scenes(
    inputs: Iterable[Part],
    total: int,
    task: SceneTask,
    output: Path,
    new_pool: Callable[[Path], Pool],
    progress: Callable[[str, int, int], None] | None = None,
    finish: Callable[[RunSummary], None] | None = None,
) -> RunSummary:
    """Perform a task on every input, in any order; results in `output`, records in `output`/manifest.

    new_pool  makes the workers, given a folder for their temporary files
    progress  is called with the name of a scene that is finished, how many are, and `total`
    finish    is called at the end, while no other run may write to the folder

    Failed scenes are in the report and in the manifest; the others go on. Raises `InputError` for two inputs of one
    name, and if another run writes to the folder.
    """
    folder, report = OutputFolder(output), RunSummary()
    manifest = Manifest(folder)
    configuration, here = sha256(task.configuration.encode()), version("saga-fg")
    with folder.held():
        remove_leftovers(output.resolve().parent, output.resolve().name)
        folder.remove_leftovers()
        scratch = folder.new_folder(".scratch")
        try:
            folder.write("configuration.yaml", task.configuration.encode())
            jobs = _jobs(inputs, task, manifest, configuration, here)
            for outcome in new_pool(scratch).outcomes(jobs, total):
                if outcome.status != "failed" and outcome.version != here:
                    reason = f"the worker has saga-fg {outcome.version}, expected {here}"
                    outcome = Outcome(outcome.name, "failed", outcome.digests, reason=reason)
                _count(report, outcome, manifest, configuration)
                if progress is not None:
                    progress(outcome.name, report.scenes, total)
        finally:
            folder.remove_folder(".scratch")
        if finish is not None:
            finish(report)
    return report


def _jobs(inputs: Iterable[Part], task: SceneTask, manifest: Manifest, configuration: str, here: str) -> Iterator[Job]:
    names: set[str] = set()
    for scene in inputs:
        if scene.name in names:
            raise InputError(f"scene {scene.name}: expected a name of its own for every scene, it occurs again")
        names.add(scene.name)
        yield Job(scene, task, manifest.valid(scene.name, configuration, here))


def _count(report: RunSummary, outcome: Outcome, manifest: Manifest, configuration: str) -> None:
    """Write the results and the record of an outcome, and count it."""
    record: Record | None
    if outcome.status == "unchanged":
        report.unchanged.append(outcome.name)
        record = manifest.record(outcome.name)
    else:
        record = manifest.take(outcome, configuration)
        if outcome.status == "done":
            report.done.append(outcome.name)
        else:
            report.failed[outcome.name] = outcome.reason
            log.info("%s failed: %s", outcome.name, outcome.reason)
    for name, number in record.counts.items() if record is not None else ():
        report.counts[name] = report.counts.get(name, 0) + number
