"""`python -m benchmarks gaps`: identity and place of objects that are not detected for some seconds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from data_tools.datasets.source import names
from data_tools.files.error_messages import unknown_name
from pipelines.cli.console import progress_bar
from pipelines.cli.options import Config, Verbose
from pipelines.cli.tables import JsonFile, MarkdownFile, PictureFile, report, writable_picture
from pipelines.cli.tracking_options import InteractionsOption, with_interactions
from saga_fg.errors import InputError

LengthsOption = Annotated[
    str | None, typer.Option("--lengths", help="Of made gaps, s, with commas: of 1, 2, 3, 5.  [default: all of them]")
]

if TYPE_CHECKING:
    from benchmarks.gaps.fitted import Fit
    from benchmarks.gaps.sources import RecordingSource
    from pipelines.config import TrackConfig
    from pipelines.learning.gap_runs import Contender, Run


def gaps(
    data: Annotated[
        Path | None,
        typer.Option("--data", help="Folder with nuscenes/ and kitti/, detections among them, and others of --sets."),
    ] = None,
    sets: Annotated[
        str | None,
        typer.Option(
            "--sets",
            help="Of megvii, centerpoint, camera, kitti, simulated; ngsim, openacc, with made detections; argoverse2, "
            "eth_ucy, where the visible annotations are the detections.  [default: the first five]",
        ),
    ] = None,
    scenes: Annotated[int, typer.Option("--scenes", min=1, help="Simulated scenes.")] = 10,
    contenders: Annotated[
        str | None,
        typer.Option(
            "--contenders",
            help="Of saga, without trails, without lights, kf, constant velocity, turn, stationary, stationary + turn "
            "and centerpoint, with commas.  [default: all that differ]",
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
    interactions: InteractionsOption = None,
    train: Annotated[
        str | None,
        typer.Option("--train", help="Fit contenders to these recordings, with commas; see --fit."),
    ] = None,
    test: Annotated[
        str | None,
        typer.Option("--test", help="Judge these recordings alone, with commas.  [default: all but --train]"),
    ] = None,
    folds: Annotated[
        str | None,
        typer.Option(
            "--folds",
            help="Judge each of so many folds of the recordings after a fit to the others; place: each place (site of "
            "ngsim, setting of openacc, sequence or log of others).",
            metavar="N|place",
        ),
    ] = None,
    fit: Annotated[
        str | None,
        typer.Option(
            "--fit",
            help="To --train or the other folds, with commas: the noise of kf, the edges of saga, boosted trees as an "
            "outside judge (needs the extra [bench]).  [default: noise,edges]",
        ),
    ] = None,
    labels: Annotated[
        bool, typer.Option("--labels", help="Take the visible annotations for detections, in all sets.")
    ] = False,
    passes: Annotated[
        int, typer.Option("--passes", min=0, help="Runs over each recording with made gaps; 0: real gaps alone.")
    ] = 2,
    life: Annotated[
        Literal["both", "kept", "shipped"],
        typer.Option("--life", help="Tracks kept alive through all gaps, ended as configured, or both."),
    ] = "both",
    by_class: Annotated[bool, typer.Option("--by-class", help="Rows for classes of objects as well.")] = False,
    situations: Annotated[
        bool,
        typer.Option("--situations", help="Tables by situation as well: leaders, halting, turning, at red, ..."),
    ] = False,
    lengths: LengthsOption = None,
    viewpoint: Annotated[
        str | None,
        typer.Option(
            "--viewpoint",
            help="Of the sensors in the sets ngsim and openacc: above, where nothing is hidden, mast, vehicle, the id "
            "of one, or X,Y,Z in m.  [default: above]",
        ),
    ] = None,
    longest: Annotated[
        float | None,
        typer.Option(
            "--longest", min=1.0, help="Of recordings of ngsim and openacc, s, from the middle of longer ones."
        ),
    ] = None,
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes.")] = 1,
    config: Config = None,
    plot: PictureFile = None,
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture",
            help="Draw the gap in which the first contender does better than that of --against by most, in the first "
            "set, to this PNG file.",
            metavar="FILE",
            callback=writable_picture,
        ),
    ] = None,
    of: Annotated[
        str | None,
        typer.Option(
            "--of", help="Make gaps of objects in one of these situations alone, with commas.", metavar="SITUATIONS"
        ),
    ] = None,
    json_file: JsonFile = None,
    markdown: MarkdownFile = None,
    verbose: Verbose = False,
) -> None:
    """Objects that are not detected for some seconds: is their identity kept, and where are they?

    Real gaps: a labelled object has no detection for 1 to 6 s, and then again. Made gaps: the detections of one object
    are taken away for 1, 2, 3 or 5 s, while all others stay. Every contender tracks the same detections. A track that
    is not known counts with an error of 10 m. Intervals are paired bootstraps over recordings, of 3 at least;
    those that overlap in time count as one.

    \b
    Examples:
      python -m benchmarks gaps --sets simulated --scenes 4
      python -m benchmarks gaps --data data --sets megvii,kitti --workers 2 --json gaps.json
      python -m benchmarks gaps --data data --sets kitti --contenders saga,kf --contender trial=trial.yaml
      python -m benchmarks gaps --data data --sets kitti --train 0000,0003 --test 0002,0007 --plot gaps.png
      python -m benchmarks gaps --data data --sets ngsim --life kept --lengths 3,5 --situations
      python -m benchmarks gaps --data data --sets ngsim --life kept --folds place --fit edges,boosted --situations
      python -m benchmarks gaps --data data --sets ngsim --life kept --picture gap.png --of 'at red'
      python -m benchmarks gaps --data data --sets openacc --life kept --longest 20 --folds 2
      python -m benchmarks gaps --data data --sets kitti,argoverse2 --labels --folds 2 --passes 8 --life kept
    """
    from benchmarks.gaps.fitted import bench_splits, splits_of
    from benchmarks.gaps.picture import write_telling_picture
    from benchmarks.gaps.plot import write_plot
    from benchmarks.gaps.sources import KNOWN, RecordingSource, set_names
    from benchmarks.gaps.tables import figures, tables
    from benchmarks.recordings import TRAFFIC_SETS
    from data_tools.simulator.recorded_world import ABOVE
    from pipelines.config import load_config
    from pipelines.learning.gap_runs import LIVES, GapBenchSettings
    from saga_fg.learning.situations import SITUATIONS

    chosen = names("--sets", sets) if sets else set_names(data)
    for name in chosen:
        if name not in KNOWN:
            raise InputError(f"--sets: {unknown_name('set', name, KNOWN)}")
    for option, value in (("--viewpoint", viewpoint), ("--longest", longest)):
        if value is not None and not set(chosen) & set(TRAFFIC_SETS):
            raise InputError(f"{option}: expected {' or '.join(TRAFFIC_SETS)} among --sets, others do not use it")
    sources = [RecordingSource(name, data, scenes, labels, viewpoint or ABOVE, longest or inf) for name in chosen]
    taught, judged = (names(option, value) if value else () for option, value in (("--train", train), ("--test", test)))
    recordings = {source.name: _recordings(source) for source in sources}
    _check_names(recordings, taught, judged)
    if taught and folds is not None:
        raise InputError("--folds: goes without --train")
    number, fits = _folds(folds), _fits(fit or "noise,edges")
    if fit is not None and not taught and number is None:
        raise InputError("--fit: expected --train or --folds, there is nothing to fit to")
    if "boosted" in fits and life == "shipped":
        raise InputError("--fit boosted: expected --life kept or both, boosted trees do not end tracks")
    splits = {}
    for source in sources:
        found = recordings[source.name]
        unit = source.places(found) if number == 0 else source.clusters if number is not None else None
        splits[source.name] = splits_of(found, taught, judged, number, unit)
    for name, split in splits.items():
        if not split and (sets or not any(splits.values())):
            why = "none is in --test" if judged else "all are in --train"
            raise InputError(f"set {name}: expected recordings to judge, {why}")
    if plot is not None and passes == 0:
        raise InputError("--plot: expected --passes of 1 or more, it shows made gaps")
    if situations and (life == "shipped" or passes == 0):
        raise InputError("--situations: expected --life kept or both, and --passes of 1 or more: it shows made gaps")
    wanted = names("--of", of) if of is not None else ()
    for name in wanted:
        if name not in SITUATIONS:
            raise InputError(f"--of: {unknown_name('situation', name, SITUATIONS)}")
    settings = GapBenchSettings(passes, LIVES if life == "both" else (life,), chosen_lengths(lengths), of=wanted)
    runs: dict[str, list[Run]] = {}
    with progress_bar(unit="runs") as progress:
        for source in sources:
            base = load_config(source.family, config)
            compared = _contenders(contenders, own or [], interactions, source.family, base)
            if against not in (known := tuple(each.name for each in compared)):
                hint = f"; add {against} to --contenders or give another --against" if against == "kf" else ""
                raise InputError(f"--against: {unknown_name('contender', against, known)}{hint}")
            if splits[source.name]:
                runs[source.name] = bench_splits(
                    source, splits[source.name], compared, base, settings, fits, workers, progress
                )
    if not any(run.gaps for found in runs.values() for run in found):
        raise InputError("expected recordings with gaps, there is none: longer ones are needed, or more --passes")
    shown = [table for name, found in runs.items() for table in tables(name, found, against, by_class, situations)]
    told = {name: figures(found, against, situations) for name, found in runs.items()}
    report(shown, told, json_file, markdown)
    if plot is not None:
        write_plot(plot, runs, against)
    if picture is not None:
        source = next(each for each in sources if each.name in runs)
        compared = _contenders(contenders, own or [], interactions, source.family, load_config(source.family, config))
        better = next((each for each in compared if each.name != against), compared[0])
        pair = [next(each for each in compared if each.name == against), better]
        write_telling_picture(picture, source, runs[source.name], pair, wanted)


def chosen_lengths(text: str | None) -> tuple[float, ...]:
    """Lengths of made gaps, s. Raises `InputError` for others than those there are."""
    from saga_fg.learning.gaps import LENGTHS

    known = {f"{length:g}": length for length in LENGTHS}
    wanted = names("--lengths", text) if text else tuple(known)
    for each in wanted:
        if each not in known:
            raise InputError(f"--lengths: expected some of {', '.join(known)}, got {each!r:.40}")
    return tuple(known[each] for each in known if each in wanted)


def _recordings(source: RecordingSource) -> tuple[str, ...]:
    with source.opened() as dataset:
        return dataset.scenes


def _fits(text: str) -> list[Fit]:
    from benchmarks.gaps.fitted import FITS

    for name in (wanted := names("--fit", text)):
        if name not in FITS:
            raise InputError(f"--fit: expected some of {', '.join(FITS)}, got {name!r:.40}")
    return [name for name in FITS if name in wanted]


def _folds(text: str | None) -> int | None:
    """The number of folds, 0 for places. Raises `InputError` for others."""
    if text is None or text == "place":
        return None if text is None else 0
    if not (text.isascii() and text.isdecimal() and int(text) >= 2):
        raise InputError(f"--folds: expected a number of 2 or more, or place, got {text!r:.40}")
    return int(text)


def _check_names(recordings: Mapping[str, Sequence[str]], taught: Sequence[str], judged: Sequence[str]) -> None:
    """Raise `InputError` for recordings that no set has, and for those that would be fitted to and judged."""
    known = tuple(name for each in recordings.values() for name in each)
    for option, wanted in (("--train", taught), ("--test", judged)):
        for name in wanted:
            if name not in known:
                raise InputError(f"{option}: {unknown_name('recording', name, known)}")
    if set(taught) & set(judged):
        raise InputError("--train, --test: expected recordings that are in one of them only")


def _contenders(
    chosen: str | None, own: Sequence[str], interactions: Path | None, family: str | Path, base: TrackConfig
) -> list[Contender]:
    """The contenders to compare. Raises `InputError` for an unknown one and a wrong file."""
    from benchmarks.gaps.contenders import contenders
    from pipelines.config import METHODS
    from pipelines.configuration import load_settings
    from pipelines.learning.gap_runs import Contender

    known, found = contenders(family), list[Contender]()
    for name in names("--contenders", chosen) if chosen else known:
        if name not in known:
            raise InputError(f"--contenders: {unknown_name('contender', name, tuple(known))}")
        contender = known[name].contender(base)
        if chosen or not any(contender.same_as(other) for other in found):
            found.append(contender)
    for text in own:
        title, _, path = text.partition("=")
        name, _, method = title.partition(":")
        if not name or not path or method not in ("", *METHODS):
            raise InputError(f"--contender {text}: expected NAME=FILE or NAME:METHOD=FILE, of {', '.join(METHODS)}")
        settings = load_settings(type(base), Path(path), base)
        found.append(Contender(name, next((m for m in METHODS if m == method), "saga"), settings))
    if interactions is not None:
        found.append(Contender(f"saga, {interactions.stem}", "saga", with_interactions(base, "saga", interactions)))
    if len({each.name for each in found}) < len(found):
        raise InputError("--contender: expected names that differ from all others")
    return found
