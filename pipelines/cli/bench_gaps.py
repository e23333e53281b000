"""`saga-fg bench gaps`: identity and place of objects that are not detected for some seconds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from data_tools.datasets.source import names
from data_tools.files.error_messages import unknown_name
from pipelines.cli.console import progress_bar
from pipelines.cli.options import Config, Verbose
from pipelines.cli.tables import JsonFile, MarkdownFile, report
from saga_fg.errors import InputError

if TYPE_CHECKING:
    from pipelines.bench.gaps.bench import Contender, Run
    from pipelines.config import TrackConfig


def gaps(
    data: Annotated[
        Path | None, typer.Option("--data", help="Folder with nuscenes/ and kitti/, detections among them.")
    ] = None,
    sets: Annotated[
        str | None,
        typer.Option(
            "--sets",
            help="Of megvii, centerpoint, camera, kitti and simulated, with commas.  [default: all that can be]",
        ),
    ] = None,
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Simulated scenes.")] = 10,
    contenders: Annotated[
        str | None,
        typer.Option(
            "--contenders",
            help="Of saga, kf, turn, stationary, stationary + turn and centerpoint, with commas.  [default: all]",
        ),
    ] = None,
    against: Annotated[str, typer.Option("--against", help="The contender that all others are compared with.")] = "kf",
    own: Annotated[
        list[str] | None,
        typer.Option(
            "--contender",
            help="One more, from a YAML file over the settings; METHOD is saga if left out; repeatable.",
            metavar="NAME[:METHOD]=FILE",
        ),
    ] = None,
    train: Annotated[
        str | None,
        typer.Option("--train", help="Fit noise and edges to these recordings, with commas: two contenders more."),
    ] = None,
    test: Annotated[
        str | None,
        typer.Option("--test", help="Judge these recordings alone, with commas.  [default: all but --train]"),
    ] = None,
    passes: Annotated[
        int, typer.Option("--passes", min=0, help="Runs over each recording with made gaps; 0: real gaps alone.")
    ] = 4,
    life: Annotated[
        Literal["both", "kept", "shipped"],
        typer.Option("--life", help="Tracks kept alive through all gaps, ended as configured, or both."),
    ] = "both",
    by_class: Annotated[bool, typer.Option("--by-class", help="Rows for classes of objects as well.")] = False,
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes.")] = 1,
    config: Config = None,
    json_file: JsonFile = None,
    markdown: MarkdownFile = None,
    verbose: Verbose = False,
) -> None:
    """Objects that are not detected for some seconds: is their identity kept, and where are they?

    Real gaps: a labelled object has no detection for 1 to 6 s, and then again. Made gaps: the detections of one object
    are taken away for 1, 2, 3 or 5 s, while all others stay. Every contender tracks the same detections. A track that
    is lost counts with an error of 10 m. Intervals are paired bootstraps over recordings.

    \b
    Examples:
      saga-fg bench gaps --sets simulated --scenes 4
      saga-fg bench gaps --data data --sets megvii,kitti --workers 2 --json gaps.json
      saga-fg bench gaps --data data --sets kitti --contenders saga,kf --contender trial=trial.yaml
      saga-fg bench gaps --data data --sets kitti --train 0000,0003 --test 0002,0007
    """
    from pipelines.bench.gaps.bench import GapBenchSettings, RecordingSource, bench_gaps
    from pipelines.bench.gaps.contenders import LIVES
    from pipelines.bench.gaps.fitted import fitted_contenders
    from pipelines.bench.gaps.tables import figures, tables
    from pipelines.bench.recordings import SETS, recording_set
    from pipelines.config import load_config

    everything = (*SETS, "simulated") if data is not None else ("simulated",)
    chosen = names("--sets", sets) if sets else everything
    recordings = {name: recording_set(name, data, scenes) for name in chosen}
    taught = names("--train", train) if train else ()
    judged = names("--test", test) if test else ()
    all_scenes = tuple(scene for each in recordings.values() for scene in each.dataset.scenes)
    for option, scene in (*(("--train", each) for each in taught), *(("--test", each) for each in judged)):
        if scene not in all_scenes:
            raise InputError(f"{option}: {unknown_name('recording', scene, all_scenes)}")
    if set(taught) & set(judged):
        raise InputError("--train, --test: expected recordings that are in one of them only")
    settings = GapBenchSettings(passes, LIVES if life == "both" else (life,))
    runs: dict[str, list[Run]] = {}
    with progress_bar(unit="runs") as progress:
        for name, each in recordings.items():
            base = load_config(each.family, config)
            compared = _contenders(contenders, own or [], base)
            teaching = [scene for scene in each.dataset.scenes if scene in taught]
            if teaching:
                compared += fitted_contenders(each.dataset, teaching, base, progress)
            if against not in (known := tuple(c.name for c in compared)):
                raise InputError(f"--against: {unknown_name('contender', against, known)}")
            testing = [s for s in each.dataset.scenes if (s in judged if judged else s not in taught)]
            if testing:
                source = RecordingSource(name, data, scenes)
                runs[name] = bench_gaps(source, testing, compared, settings, workers, progress)
    shown = [table for name, found in runs.items() for table in tables(name, found, against, by_class)]
    report(shown, {name: figures(found, against) for name, found in runs.items()}, json_file, markdown)


def _contenders(chosen: str | None, own: Sequence[str], base: TrackConfig) -> list[Contender]:
    """Those that are compared. Raises `InputError` for an unknown one and a wrong file."""
    from pipelines.bench.gaps.bench import Contender
    from pipelines.bench.gaps.contenders import CONTENDERS
    from pipelines.config import METHODS
    from pipelines.configuration import load_settings

    found = []
    for name in names("--contenders", chosen) if chosen else CONTENDERS:
        if name not in CONTENDERS:
            raise InputError(f"--contenders: {unknown_name('contender', name, tuple(CONTENDERS))}")
        found.append(Contender.of(CONTENDERS[name], base))
    for text in own:
        title, _, path = text.partition("=")
        name, _, method = title.partition(":")
        if not name or not path or method not in ("", *METHODS):
            raise InputError(f"--contender {text}: expected NAME=FILE or NAME:METHOD=FILE, of {', '.join(METHODS)}")
        settings = load_settings(type(base), Path(path), base)
        found.append(Contender(name, next((m for m in METHODS if m == method), "saga"), settings))
    if len({each.name for each in found}) < len(found):
        raise InputError("--contender: expected names that differ from all others")
    return found
