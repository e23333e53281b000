"""`python -m benchmarks coasting`: where are hidden objects, told by their neighbours?"""

from __future__ import annotations

from typing import Annotated

import typer

from data_tools.datasets.source import names
from pipelines.cli.options import Config, Verbose
from pipelines.cli.reporting import progress_bar
from pipelines.cli.tables import JsonFile, show_tables


def coasting(
    data: Annotated[
        list[str],
        typer.Option(
            "--data",
            help="Recordings with their truth: kitti=, nuscenes=, eth_ucy=, argoverse2= with their folder, simulated= "
            "with a number of scenes; repeatable.",
            metavar="KIND=PLACE",
        ),
    ],
    recordings: Annotated[
        str | None, typer.Option("--recordings", help="Recordings of a single --data, with commas between them.")
    ] = None,
    folds: Annotated[int, typer.Option("--folds", min=2, help="Each is tested by what the others taught.")] = 3,
    tested_folds: Annotated[
        int | None, typer.Option("--tested-folds", min=1, help="Test the first folds only; all if left out.")
    ] = None,
    gaps: Annotated[int, typer.Option("--gaps", min=1, help="Gaps judged in a recording, drawn from all.")] = 500,
    network: Annotated[
        bool, typer.Option("--network", help="Train networks too (extra [learn]); minutes a fold.")
    ] = False,
    json_file: JsonFile = None,
    config: Config = None,
    verbose: Verbose = False,
) -> None:
    """Hide one object for 1, 2 and 3 s while its neighbours stay visible: the error when it reappears.

    Independent objects (kf) against the hand-crafted and the learned interactions. Process noise and interactions are
    fitted on other recordings than those that are tested. Intervals are bootstraps over stretches of 10 s.

    \b
    Examples:
      python -m benchmarks coasting --data kitti=data/kitti --json coasting.json
      python -m benchmarks coasting --data eth_ucy=data/eth_ucy --data simulated=6
      python -m benchmarks coasting --data kitti=data/kitti --network --tested-folds 1
    """
    from benchmarks.coasting_trajectories import (
        CLASSES,
        CoastingSettings,
        annotated_source,
        coasting_errors,
        coasting_figures,
        coasting_table,
    )
    from data_tools.figures import write_figures
    from data_tools.files.atomic_files import check_writable
    from pipelines.config import load_config
    from pipelines.learning import trajectories
    from saga_fg.errors import InputError

    if recordings is not None and len(data) != 1:
        raise InputError(f"--recordings {recordings}: goes with a single --data")
    if json_file is not None:
        check_writable(json_file)
    chosen = names("--recordings", recordings) if recordings is not None else None
    figures, settings = {}, CoastingSettings(folds, tested_folds, gaps, network)
    for kind, _, place in (value.partition("=") for value in data):
        if kind not in CLASSES or not place:
            raise InputError(f"--data {kind}={place}: expected KIND=PLACE with a kind of {', '.join(CLASSES)}")
        source = annotated_source(kind, place, chosen)
        found = trajectories(source, with_truth=True)
        if len(found) < 2:
            raise InputError(f"--data {kind}={place}: expected at least two recordings")
        rules = load_config(source.family, config).tracker.edges
        with progress_bar(unit="recordings") as progress:
            errors, learned = coasting_errors(found, CLASSES[kind], rules, settings, progress)
        rows = coasting_figures(errors)
        show_tables([coasting_table(rows, f"{kind}, {len(found)} recordings")])
        figures[kind] = {"recordings": list(found), "figures": rows, "learned": learned}
    if json_file is not None:
        write_figures(json_file, figures)
