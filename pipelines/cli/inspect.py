"""`saga-fg inspect` and `saga-fg explain`: how a table is understood, why a track is as it is."""

import shlex
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

import typer

from data_tools.datasets import (
    CLASSES_TEXT,
    COLUMNS_TEXT,
    COORDINATES_TEXT,
    IMPORT_TEXT,
    SORT_TEXT,
    UNITS_TEXT,
    TableImport,
    TableSurvey,
    survey_table,
)
from data_tools.figures import write_figures
from data_tools.files import check_writable
from pipelines.cli.console import JsonFile, counted
from pipelines.cli.options import Verbose
from pipelines.config import load_config
from pipelines.configuration import load_settings
from pipelines.explaining import clock_lines, journal_of, read_track, story
from saga_fg.errors import error_context
from saga_fg.model import acting_classes
from saga_fg.tables import COLUMNS, idle_rules, pairs, usual_classes
from saga_fg.types import FILL_IN, Finding, Mend

MOST = 12  # scenes and classes that are listed
UNREAD = 40  # columns without a meaning that are listed
EPOCH = 1e8  # s, from which times count from 1970


def inspect_table(
    table: Annotated[
        Path,
        typer.Argument(help="Table of detections, tracks or true objects: .csv, .ndjson, .npz, .parquet, .feather."),
    ],
    columns: Annotated[
        str | None,
        typer.Option("--columns", help=COLUMNS_TEXT, metavar="OURS=THEIRS,..."),
    ] = None,
    classes: Annotated[
        str | None,
        typer.Option("--classes", help=CLASSES_TEXT, metavar="THEIRS=OURS,..."),
    ] = None,
    units: Annotated[
        str | None,
        typer.Option("--units", help=UNITS_TEXT, metavar="KIND=UNIT,..."),
    ] = None,
    coordinates: Annotated[
        Literal["world", "ego", "sensor", "camera"] | None,
        typer.Option("--coordinates", help=COORDINATES_TEXT),
    ] = None,
    sort: Annotated[bool, typer.Option("--sort", help=SORT_TEXT)] = False,
    import_file: Annotated[Path | None, typer.Option("--import", help=IMPORT_TEXT, metavar="FILE")] = None,
    verbose: Verbose = False,
) -> None:
    """Look at a table: its columns, units, classes, times, what looks wrong, and the command to run next.

    Nothing is written. The last lines are a command that can be run as it is; what looks wrong is mended in it.

    \b
    Examples:
      saga-fg inspect detections.csv
      saga-fg inspect detections.parquet --columns time=ts_ns,x=pos_x,y=pos_y --units angle=deg
      saga-fg inspect truth.csv
    """
    given = TableImport(
        pairs("--columns", columns), pairs("--classes", classes), pairs("--units", units), coordinates or "", sort
    )
    base = TableImport() if import_file is None else load_settings(TableImport, import_file)
    survey = survey_table(table, given.over(base))
    if not survey.has_identities and base.columns.keys() - set(COLUMNS):  # detections, which have no columns of tracks
        survey = survey_table(table, given.over(base.naming(COLUMNS)))
    _show_columns(survey)
    _show_times(survey)
    findings = (*survey.findings, *survey.how.judged(_show_classes(survey), survey.raw.found.names))
    typer.echo("\nWhat looks wrong:" if survey.faults or findings or not survey.sorted else "\nNothing looks wrong.")
    for fault in survey.faults:
        typer.echo(f"  {fault}")
    for finding in findings:
        typer.echo(f"  {str(finding).removeprefix(f'{table}: ')}")
    if not survey.sorted:
        typer.echo("  rows are not in order of time; add --sort")
    if survey.raw.present("ego_x").any() and "coordinates" not in survey.raw.columns and not survey.how.coordinates:
        typer.echo("\nPositions are taken for world coordinates; if the vehicle is their origin: --coordinates ego")
    if survey.dense_traffic and not survey.has_identities:
        told = "`track`, `smooth` have settings for it; --settings plain: not."
        typer.echo(f"\nDense road traffic: {survey.dense_traffic}. {told}")
    base_option = "" if import_file is None else f" --import {shlex.quote(str(import_file))}"
    _show_next(survey, table, base_option + _mended(survey, findings, given).options())


def _show_columns(survey: TableSurvey) -> None:
    raw = survey.raw
    typer.echo(f"{raw.path}: {counted(raw.length, 'row')}\n\nColumns, and their least, median and largest value:")
    names = raw.found.names
    for ours, theirs in ((ours, names.get(ours, ours)) for ours in raw.columns):
        how = theirs if theirs != ours else ""
        unit = raw.clock.unit if ours == "timestamp" else raw.how.unit(ours, raw.found.units.get(ours)) or ""
        origin = " ".join(part for part in (f"from {how}" if how else "", f"in {unit}" if unit else "") if part)
        numbers = ""
        if ours in survey.ranges:
            low, middle, high = survey.ranges[ours]
            numbers = f"{low:>12.6g} {middle:>12.6g} {high:>12.6g}"
            if ours == "timestamp" and low > EPOCH:
                numbers = f"{_date(low):>38}"
        typer.echo(f"  {ours:<12} {numbers:<39} {origin}".rstrip())
    if "yaw" in survey.ranges and "yaw" not in names:
        low, middle, high = survey.ranges["yaw"]
        typer.echo(f"  {'yaw':<12} {low:>12.6g} {middle:>12.6g} {high:>12.6g} from the quaternion")
    for name, values in list(survey.unread.items())[:UNREAD]:
        typer.echo(f"  {'not read:':<12} {name}: {', '.join(values)}, ...")
    if len(survey.unread) > UNREAD:
        typer.echo(f"  not read: {len(survey.unread)} in all")


def _date(seconds: float) -> str:
    return f"from {datetime.fromtimestamp(seconds, UTC).isoformat(timespec='milliseconds').replace('+00:00', 'Z')}"


def _show_times(survey: TableSurvey) -> None:
    typer.echo("\nFrames, by scene and sensor:")
    for each in survey.times[:MOST]:
        rate = f"{1 / each.step:.3g} Hz" if each.step > 0 else "one moment"
        pause = f", {counted(each.pauses, 'pause')}, the longest of {each.longest:.3g} s" if each.pauses else ""
        length = each.last - each.first
        typer.echo(f"  {each.scene}, {each.sensor}: {counted(each.frames, 'frame')} in {length:.6g} s, {rate}{pause}")
    if len(survey.times) > MOST:
        typer.echo(f"  ... {len(survey.times)} in all")


def _show_classes(survey: TableSurvey) -> list[Finding]:
    """List the classes; return what is doubtful about those that no edge rule acts on."""
    acting = acting_classes(load_config("file").tracker.edges)
    mapped = {name: survey.how.classes.get(name, name) for name in survey.classes}
    typer.echo("\nClasses, with rows and median length, width, height:")
    for name in sorted(survey.classes, key=lambda name: -survey.classes[name])[:MOST]:
        size = " x ".join("?" if x != x else f"{x:.2f}" for x in survey.sizes[name].tolist())
        ours = mapped[name]
        role = "left out" if not ours else "with interactions" if ours in acting else "without interactions"
        renamed = f", read as {ours}" if ours not in ("", name) else ""
        typer.echo(f"  {name}: {survey.classes[name]}, {size} m{renamed}, {role}")
    if len(survey.classes) > MOST:
        typer.echo(f"  ... {len(survey.classes)} in all")
    idle = None if survey.has_identities else idle_rules(acting, set(mapped.values()) - {""})
    meant = usual_classes(sorted(set(mapped.values())), acting)
    if idle is not None:
        return [idle]
    what = f"no edge rule acts on {', '.join(meant)}"
    return [Finding("edges", what, "name them as the rules do", Mend(classes=meant))] if meant else []


def _mended(survey: TableSurvey, findings: Sequence[Finding], given: TableImport) -> TableImport:
    """The options that were given, with those that mend what looks wrong."""
    mends = [finding.mend for finding in findings if finding.mend is not None]
    if survey.raw.clock.guessed:
        mends.insert(0, Mend(units={"time": survey.raw.clock.unit}))
    mends.append(survey.raw.found.open)
    names, how, changed = survey.raw.found.names, survey.how, {"sort"}
    for mend in mends:
        how = how.mended(mend, names)
        changed |= {name for name, value in vars(mend).items() if value}
    return replace(given, **{name: getattr(how, name) for name in changed})


def _show_next(survey: TableSurvey, table: Path, options: str) -> None:
    name = shlex.quote(str(table))
    command = survey.raw.argoverse_command()
    to_mend = survey.faults and not survey.raw.found.open.columns
    unknown = FILL_IN in options + command
    text = ", when the table is mended" if to_mend else f", with what fits in place of {FILL_IN}" if unknown else ""
    typer.echo(f"\nNext{text}:")
    if command:
        typer.echo(f"  {command}")
    elif survey.has_identities:
        typer.echo("  these are tracks or true objects; as the truth beside tracks, or as tracks beside the truth:")
        typer.echo(f"  saga-fg evaluate file tracks.csv --truth {name}{options}")
        typer.echo(f"  saga-fg evaluate file {name} --truth truth.csv{options}")
    else:
        typer.echo(f"  saga-fg track file {name}{options} --output tracks.csv")
        typer.echo(f"  saga-fg report file tracks.csv --detections {name} --output report.html")


def explain(
    result: Annotated[Path, typer.Argument(help="What `saga-fg track ... --explain` wrote.")],
    track: Annotated[str, typer.Option("--track", help="Number of the track, or SCENE-NUMBER as in nuScenes results.")],
    scene: Annotated[str | None, typer.Option("--scene", help="The scene, where there are several.")] = None,
    json_file: JsonFile = None,
    verbose: Verbose = False,
) -> None:
    """Tell the life of a track: what it came from, what it took and what it did not, who influenced it, why it ended.

    Detections are named by their place in the frame, from 0. Distances are in standard deviations of the innovation.
    `saga-fg view` draws the graph that runs.

    \b
    Examples:
      saga-fg explain tracks.json --track scene-0103-17
      saga-fg explain results --scene 0011 --track 4 --json events.json
    """
    journal = journal_of(result)
    if json_file is not None:
        check_writable(json_file)
    events, clocks = read_track(journal, track, scene)
    with error_context(str(journal)):
        lines = [*clock_lines(clocks), *story(events)]
    for line in lines:
        typer.echo(line)
    if json_file is not None:
        write_figures(json_file, events)
