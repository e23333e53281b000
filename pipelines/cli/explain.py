"""`saga-fg explain`: why a track was initiated, kept, updated, deleted."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.options import Verbose
from pipelines.cli.tables import JsonFile


def explain(
    result: Annotated[Path, typer.Argument(help="What `saga-fg track ... --explain` wrote.")],
    track: Annotated[
        str | None, typer.Option("--track", help="Number of the track, or SCENE-NUMBER as in nuScenes results.")
    ] = None,
    scene: Annotated[str | None, typer.Option("--scene", help="The scene, where there are several.")] = None,
    graph: Annotated[bool, typer.Option("--graph", help="Draw the running graph, around the track if given.")] = False,
    time: Annotated[float, typer.Option("--time", help="Of the graph, s from the scene's first frame.")] = 0.0,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Picture of the graph: .png, .svg or .pdf.", metavar="FILE")
    ] = None,
    json_file: JsonFile = None,
    verbose: Verbose = False,
) -> None:
    """Tell the life of a track: what it came from, what it took and what it did not, who influenced it, why it ended.

    Detections are named by their place in the frame, from 0. Distances are in standard deviations of the innovation.
    With --graph, draw the graph that runs at a time: variables where they are, and factors by kind.

    \b
    Examples:
      saga-fg explain tracks.json --track scene-0103-17
      saga-fg explain results --scene 0011 --track 4 --json events.json
      saga-fg explain tracks.json --scene scene-0103 --graph --time 3.4 --output graph.png
    """
    from data_tools.figures import write_figures
    from data_tools.files.atomic_files import atomic_file, check_writable
    from data_tools.files.error_messages import error_context
    from pipelines.explaining import clock_lines, graph_picture, journal_of, read_graphs, read_track, story
    from saga_fg.errors import InputError

    journal = journal_of(result)
    if graph:
        if output is None or output.suffix not in (".png", ".svg", ".pdf"):
            raise InputError("--graph: expected --output FILE, a name that ends in .png, .svg or .pdf")
        graphs = read_graphs(journal)
        with error_context(str(journal)):
            figure = graph_picture(graphs, scene, time, track)
        with atomic_file(output) as file:
            figure.savefig(file, format=output.suffix[1:], dpi=130)
        return
    if track is None:
        raise InputError("expected --track, or --graph")
    if json_file is not None:
        check_writable(json_file)
    events, clocks = read_track(journal, track, scene)
    with error_context(str(journal)):
        lines = [*clock_lines(clocks), *story(events)]
    for line in lines:
        typer.echo(line)
    if json_file is not None:
        write_figures(json_file, events)
