"""`saga-fg explain`: why a track was born, kept, updated, ended."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.options import Verbose
from pipelines.cli.tables import JsonFile


def explain(
    result: Annotated[Path, typer.Argument(help="What `saga-fg track ... --explain` wrote.")],
    track: Annotated[str, typer.Option("--track", help="Number of the track, or SCENE-NUMBER as in nuScenes results.")],
    scene: Annotated[str | None, typer.Option("--scene", help="Its scene, where several have such a track.")] = None,
    json_file: JsonFile = None,
    verbose: Verbose = False,
) -> None:
    """Tell the life of a track: what it came from, what it took and what it did not, who influenced it, why it ended.

    Detections are named by their place in the frame, from 0. Distances are in standard deviations of the innovation.

    \b
    Examples:
      saga-fg explain tracks.json --track scene-0103-17
      saga-fg explain results --scene 0011 --track 4 --json events.json
    """
    from data_tools.atomic_files import check_writable
    from data_tools.located import located
    from pipelines.explaining import journal_of, read_track, story
    from pipelines.figures import write_figures

    if json_file is not None:
        check_writable(json_file)
    journal = journal_of(result)
    events = read_track(journal, track, scene)
    with located(str(journal)):
        lines = story(events)
    for line in lines:
        typer.echo(line)
    if json_file is not None:
        write_figures(json_file, events)
