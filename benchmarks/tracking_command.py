"""`python -m benchmarks tracking`: the methods and the components of the tracker, on the same recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.gaps_command import LengthsOption, chosen_lengths
from data_tools.datasets.source import names
from pipelines.cli.console import progress_bar
from pipelines.cli.options import Config, Verbose
from pipelines.cli.tables import JsonFile, MarkdownFile, report
from saga_fg.errors import InputError


def tracking(
    data: Annotated[
        Path | None,
        typer.Option("--data", help="Folder with nuscenes/, kitti/ and others that --sets names."),
    ] = None,
    sets: Annotated[
        str | None,
        typer.Option(
            "--sets",
            help="Of megvii, centerpoint, camera, kitti, simulated, ngsim, openacc.  [default: all but the last two]",
        ),
    ] = None,
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Simulated scenes.")] = 10,
    viewpoint: Annotated[
        str | None,
        typer.Option(
            "--viewpoint",
            help="Of the sensors in the sets ngsim and openacc: mast, above, vehicle, the id of one, or X,Y,Z in m.  "
            "[default: mast, vehicle]",
        ),
    ] = None,
    test: Annotated[
        str | None, typer.Option("--test", help="Track these recordings alone, with commas.  [default: all]")
    ] = None,
    passes: Annotated[
        int,
        typer.Option(
            "--passes",
            min=0,
            help="Track each recording so often with made gaps, in the sets simulated, ngsim and openacc; see bench "
            "gaps.  [default: 0, as detected]",
            show_default=False,
        ),
    ] = 0,
    lengths: LengthsOption = None,
    components: Annotated[bool, typer.Option(help="Switch the components off one by one as well.")] = True,
    contenders: Annotated[
        bool,
        typer.Option(
            help="Graph matching, and interactions learned on other recordings of the set, as well, and HOTA of cars "
            "(needs the extra [eval])."
        ),
    ] = False,
    draws: Annotated[int, typer.Option("--draws", min=0, help="Drawn sets of scenes for intervals; 0: none.")] = 200,
    config: Config = None,
    json_file: JsonFile = None,
    markdown: MarkdownFile = None,
    verbose: Verbose = False,
) -> None:
    """Track the same recordings by every method, and with every component off; compare accuracy and time.

    The file of --config changes the shipped settings of every kind of data.

    \b
    Examples:
      python -m benchmarks tracking --sets simulated --scenes 4 --draws 0
      python -m benchmarks tracking --data data --json figures.json --markdown tables.md
      python -m benchmarks tracking --data data --sets kitti --no-components
      python -m benchmarks tracking --data data --sets ngsim --passes 4 --lengths 2,3 --contenders --no-components
      python -m benchmarks tracking --data data --sets megvii,centerpoint,kitti --contenders --no-components
    """
    from benchmarks.gaps.hidden_recordings import with_made_gaps
    from benchmarks.recordings import SETS, TRAFFIC_SETS, chosen_recordings, recording_set
    from benchmarks.tracking import TrackingBenchSettings, bench_set
    from benchmarks.tracking_tables import figures, tables
    from pipelines.config import load_config

    if lengths is not None and passes == 0:
        raise InputError("--lengths: expected --passes of 1 or more, they are those of made gaps")
    everything = (*SETS, "simulated") if data is not None else ("simulated",)
    wanted = names("--sets", sets) if sets else everything
    if viewpoint is not None and not set(wanted) & set(TRAFFIC_SETS):
        raise InputError(f"--viewpoint: expected {' or '.join(TRAFFIC_SETS)} among --sets, others do not use it")
    chosen = [recording_set(name, data, scenes, viewpoint) for name in wanted]
    if test is not None:
        chosen = chosen_recordings(chosen, names("--test", test))
    settings = TrackingBenchSettings(components, contenders, draws)
    results, hidden_for = [], chosen_lengths(lengths)
    with progress_bar(unit="variants") as progress:
        for recordings in chosen:
            base = load_config(recordings.family, config)
            compared = with_made_gaps(recordings, base.sensors, passes, hidden_for) if passes else recordings
            results.append(bench_set(compared, base, settings, progress))
    shown = [table for result in results for table in tables(result)]
    report(shown, {result.name: figures(result) for result in results}, json_file, markdown)
