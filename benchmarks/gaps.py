"""Objects that nobody sees for some seconds, through the whole tracker on detections: identity and place.

Every contender tracks every recording, with all detections and with some taken away.
Intervals are paired bootstraps over recordings; those that overlap in time count as one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import typer

from benchmarks.bootstrap import difference, relative_change
from benchmarks.gap_figures import by_cluster, compared, situation_figures
from benchmarks.gap_picture import write_telling_picture
from benchmarks.gap_runs import LIVES, GapBenchSettings, Judgement, LivedRun, bench_gaps
from benchmarks.recording_sets import TRAFFIC_SETS, RecordingOptions, RecordingSet, chosen_sets
from benchmarks.recordings.sensed import ABOVE
from benchmarks.runner import Data, Row, Rows, chosen
from benchmarks.situations import SITUATIONS
from benchmarks.variants import contenders
from pipelines.cli.console import progress_bar, writable
from pipelines.cli.options import Config
from pipelines.config import TrackConfig, load_config
from pipelines.learning import learned_motions
from pipelines.learning.interactions import LEARNED, Contender, LearningSettings, learn_interactions
from pipelines.tracking import Progress
from saga_fg.errors import InputError
from saga_fg.learning import measured_trajectories
from saga_fg.learning.labelled_scene import LENGTHS, Gap
from saga_fg.numerics import FloatArray

FITS = ("noise", "edges")
LEARNING = LearningSettings(passes=1, most=100)  # there is a fit to every fold, and a half of the usual tells enough
CONTENDERS = "saga,without trails,without lights,kf,constant velocity,turn,stationary,stationary + turn,centerpoint"
FEWEST = 10  # gaps of a class that has rows of its own
TITLES = {"kept": "tracks kept alive", "shipped": "tracks end as configured"}


def _writable_picture(path: Path | None) -> Path | None:
    """Refuse a file that cannot be written, or whose name does not say that it is a PNG file."""
    if path is not None and path.suffix.lower() != ".png":
        raise InputError(f"{path}: expected a name that ends in .png")
    return writable(path)


@dataclass(frozen=True)
class GapOptions:
    """Which gaps are made, and who is judged in them after which fit."""

    compared_by_name: Annotated[
        str, typer.Option("--contenders", help="Names, with commas; those without effect are left out.")
    ] = CONTENDERS
    against: Annotated[str, typer.Option("--against", help="The contender that all others are compared with.")] = "kf"
    own: Annotated[
        list[str] | None,
        typer.Option(
            "--contender",
            help="One more, from a YAML file over the settings; METHOD is saga if left out; repeatable.",
            metavar="NAME[:METHOD]=FILE",
        ),
    ] = None
    folds: Annotated[
        str | None,
        typer.Option(
            "--folds",
            help="Judge each of so many folds of the recordings after a fit to the others; place: each site of ngsim, "
            "setting of openacc, recording of others.",
            metavar="N|place",
        ),
    ] = None
    fit: Annotated[
        str, typer.Option("--fit", help="To the other folds, with commas: the noise of kf, the edges of saga.")
    ] = "noise,edges"
    passes: Annotated[
        int, typer.Option("--passes", min=0, help="Runs over each recording with made gaps; 0: real gaps alone.")
    ] = 2
    life: Annotated[
        Literal["both", "kept", "shipped"],
        typer.Option("--life", help="Tracks kept alive through all gaps, ended as configured, or both."),
    ] = "both"
    lengths: Annotated[str, typer.Option("--lengths", help="Of made gaps, s, with commas.")] = "1,2,3,5"
    of: Annotated[
        str | None,
        typer.Option(
            "--of", help="Make gaps of objects in one of these situations alone, with commas.", metavar="SITUATIONS"
        ),
    ] = None


@dataclass(frozen=True)
class TrafficOptions(RecordingOptions):
    """Recordings that are tracked, and how much of them."""

    longest: Annotated[
        float | None,
        typer.Option(
            "--longest",
            min=1.0,
            help="Of recordings of ngsim, openacc, dut and crossings, s, from the middle of longer ones.",
        ),
    ] = None


@dataclass(frozen=True)
class ShownOptions:
    """What is shown of the figures."""

    by_class: Annotated[bool, typer.Option("--by-class", help="Rows for classes of objects as well.")] = False
    situations: Annotated[
        bool,
        typer.Option("--situations", help="Tables by situation as well: leaders, halting, turning, at red, ..."),
    ] = False
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture",
            help="Draw the gap in which the first contender does better than that of --against by most, in the first "
            "set, to this PNG file.",
            metavar="FILE",
            callback=_writable_picture,
        ),
    ] = None


def gaps(
    *,
    data: Data = None,
    recorded: TrafficOptions,
    made: GapOptions,
    shown: ShownOptions,
    config: Config = None,
) -> Rows:
    """Objects that are not detected for some seconds: is their identity kept, and where are they?

    Real gaps: a labelled object has no detection for 1 to 6 s, and then again. Made gaps: the detections of one object
    are taken away for 1, 2, 3 or 5 s, while all others stay. Every contender tracks the same detections. A track that
    is not known counts with an error of 10 m. Intervals are paired bootstraps over recordings, of 3 at least;
    those that overlap in time count as one.

    \b
    Examples:
      python -m benchmarks gaps --sets simulated --scenes 4
      python -m benchmarks gaps --data data --sets megvii,kitti --json gaps.json
      python -m benchmarks gaps --data data --sets kitti --contenders saga,kf --contender trial=trial.yaml
      python -m benchmarks gaps --data data --sets ngsim --life kept --lengths 3,5 --situations
      python -m benchmarks gaps --data data --sets ngsim --life kept --folds place --fit edges --situations
      python -m benchmarks gaps --data data --sets ngsim --life kept --picture gap.png --of 'at red'
      python -m benchmarks gaps --data data --sets openacc --life kept --longest 20 --folds 2
    """
    found = chosen_sets(
        recorded.sets, data, recorded.scenes, recorded.test, recorded.viewpoint, recorded.longest, usual=ABOVE
    )
    wanted = chosen("--of", made.of, SITUATIONS) if made.of is not None else ()
    fits = chosen("--fit", made.fit, FITS)
    settings = GapBenchSettings(
        made.passes, LIVES if made.life == "both" else (made.life,), chosen_lengths(made.lengths), of=wanted
    )
    for recordings in found:
        base, complete = (
            load_config(recordings.family, config),
            recordings.name in TRAFFIC_SETS and recorded.viewpoint in (None, ABOVE),
        )
        tried = contenders(recordings.family, base, made.compared_by_name, made.own or ())
        chosen("--against", made.against, [one.name for one in tried])
        judged = replace(settings, real=not complete)  # from above nothing is hidden, there are no gaps but made ones
        with progress_bar(unit="runs") as progress:
            runs = split_runs(recordings, made.folds, fits, tried, base, judged, progress)
        if not any(run.gaps for run in runs):
            raise InputError(f"set {recordings.name}: expected recordings with gaps: longer ones, or more --passes")
        yield from rows_of(recordings.name, runs, made.against, shown.by_class, shown.situations)
        if shown.picture is not None and recordings is found[0]:
            better = next((one for one in tried if one.name != made.against), tried[0])
            pair = [next(one for one in tried if one.name == made.against), better]
            write_telling_picture(shown.picture, recordings, runs, pair, wanted)


def chosen_lengths(text: str) -> tuple[float, ...]:
    """Lengths of made gaps, s. Raises `InputError` for others than those there are."""
    return tuple(sorted(map(float, chosen("--lengths", text, [f"{length:g}" for length in LENGTHS]))))


def split_runs(
    recordings: RecordingSet,
    folds: str | None,
    fits: Sequence[str],
    tried: Sequence[Contender],
    base: TrackConfig,
    settings: GapBenchSettings,
    progress: Progress | None = None,
) -> list[LivedRun]:
    """All runs on the recordings; with folds, of contenders fitted to the other ones as well."""
    runs: list[LivedRun] = []
    for train, test in splits_of(recordings, folds):
        fitted: list[Contender] = []
        if train and "noise" in fits:
            trajectories = measured_trajectories(map(recordings.scene, train), base.sensors)
            motions = learned_motions(trajectories, base)
            fitted.append(Contender("kf, fitted noise", "kf", base.with_motions(motions)))
        if train and "edges" in fits:
            truth = {name: recordings.scene(name) for name in train}
            learned = learn_interactions(truth, f"recordings {', '.join(train)}", base, None, LEARNING, progress)
            fitted.append(Contender(f"saga, {LEARNED}", "saga", base.with_interactions(learned.interactions)))
        runs += bench_gaps(recordings, test, [*tried, *fitted], settings, progress)
    return runs


def splits_of(recordings: RecordingSet, folds: str | None) -> list[tuple[tuple[str, ...], tuple[str, ...]]]:
    """Recordings to fit to, and others to judge on; those of one place, or that overlap in time, are in one fold.

    Raises `InputError` for more folds than there are units to deal.
    """
    every = tuple(recordings.dataset.scenes)
    if folds is None:
        return [((), every)]
    if folds != "place" and not (folds.isascii() and folds.isdecimal() and int(folds) >= 2):
        raise InputError(f"--folds: expected a number of 2 or more, or place, got {folds!r:.40}")
    unit = {name: recordings.clusters.get(name, name) for name in every}
    if folds == "place" and recordings.name in TRAFFIC_SETS:
        unit = {name: name.partition("-")[0] for name in every}
    units = list(dict.fromkeys(unit.values()))
    number = len(units) if folds == "place" else int(folds)
    if not 2 <= number <= len(units):
        raise InputError(f"--folds {folds}: expected recordings for two folds or more, there are {len(units)} units")
    tests = [tuple(name for name in every if unit[name] in units[k::number]) for k in range(number)]
    return [(tuple(name for name in every if name not in test), test) for test in tests]


class Group(NamedTuple):
    """Gaps of one kind of objects that move or don't, of one class or all (None), and, if made, of one length."""

    made: bool
    moving: bool
    label: str | None
    length: float | None

    def has(self, gap: Gap, label: str) -> bool:
        """Return True if a gap belongs to the group, whatever its length."""
        return (gap.run > 0) == self.made and gap.moving == self.moving and self.label in (None, label)

    def exactly(self, gap: Gap, label: str) -> bool:
        """Return True if its length is that of the group, too."""
        return self.has(gap, label) and self.length in (None, gap.length)

    def error(self, outcome: Judgement) -> float:
        """Over the gap, or at the end of the length; NaN where it does not reach that."""
        return outcome.error if self.length is None else outcome.at.get(self.length, float("nan"))


def rows_of(name: str, runs: Sequence[LivedRun], against: str, by_class: bool, situations: bool) -> Iterator[Row]:
    """Real gaps, made gaps, situations and links, for each life of the tracks."""
    for life in dict.fromkeys(run.life for run in runs):
        title, mine = f"{name}, {TITLES[life]}", [run for run in runs if run.life == life]
        of = {each: [run for run in mine if run.contender == each] for each in dict.fromkeys(r.contender for r in mine)}
        for group in _groups(of[against], by_class):
            kind = "made gaps" if group.made else "real gaps of 1 to 6 s"
            for contender, found in of.items():
                if row := _row(group, found, of[against]):
                    yield f"{title}: {kind}", {"objects": _objects(group), "contender": contender, **row}
        for f in situation_figures(mine, against) if situations and life == "kept" else ():
            about = {"objects": f.situation, "contender": f.contender, "gaps": f.gaps, "lost": f.lost}
            errors = {"error, m": f.error.estimate, f"against {against}": f.error_change, "median, m": f.median}
            density = {"NLL, nats": f.nll.estimate, f"less that of {against}": f.nll_change}
            shares = {f"in {100 * p:g} %": share for p, share in f.coverage.items()}
            yield f"{title}: after {f.length:g} s, by situation", {**about, **errors, **density, **shares}
        for contender, found in of.items():
            links = [run.links for run in found if run.links is not None]
            if links:
                right, false, unknown = np.sum([(one.right, one.false, one.unknown) for one in links], axis=0).tolist()
                known = {"right": right, "false": false, "of unknown objects": unknown}
                share = false / (right + false) if right + false else float("nan")
                yield f"{title}: links through gaps", {"contender": contender, **known, "false share": share}


def _groups(runs: Sequence[LivedRun], by_class: bool) -> Iterator[Group]:
    """Groups of gaps that have rows: moving and stationary objects, and their classes."""
    every = [(gap, label) for run in runs for gap, label in zip(run.gaps, run.label, strict=True)]
    for moving, made in product((True, False), (False, True)):
        mine = [label for gap, label in every if gap.moving == moving and (gap.run > 0) == made]
        classes, counts = np.unique(np.array(mine, dtype=np.str_), return_counts=True)
        labels = [str(c) for c, n in zip(classes, counts, strict=True) if by_class and FEWEST <= n < len(mine)]
        for label, length in product((None, *labels) if mine else (), LENGTHS if made else (None,)):
            yield Group(made, moving, label, length)


def _objects(group: Group) -> str:
    words = (group.label, "moving" if group.moving else "stationary", group.length and f"{group.length:g} s")
    return ", ".join(word for word in words if word)


def _row(group: Group, runs: Sequence[LivedRun], base: Sequence[LivedRun]) -> Mapping[str, Any]:
    """The figures of a contender on a group; nothing where it has none. Errors over all gaps this long or longer."""

    def values(
        some: Sequence[LivedRun], has: Callable[[Gap, str], bool], value: Callable[[Judgement], Any]
    ) -> list[FloatArray]:
        def of_run(run: LivedRun) -> FloatArray:
            every = zip(run.gaps, run.label, run.outcomes, strict=True)
            return np.array([value(outcome) for gap, label, outcome in every if has(gap, label)], dtype=np.float64)

        return by_cluster(some, of_run)

    kept, reported, errors = (
        values(runs, group.exactly, lambda outcome: outcome.kept),
        np.concatenate(values(runs, group.exactly, lambda outcome: outcome.reported)),
        values(runs, group.has, group.error),
    )
    identities, known = np.concatenate(kept), np.concatenate(errors)
    known = known[np.isfinite(known)]
    if len(known) == 0:
        return {}
    others = values(base, group.exactly, lambda outcome: outcome.kept), values(base, group.has, group.error)
    same = runs[0].contender == base[0].contender
    return {
        "gaps": len(identities),
        "identity kept": float(identities.mean()) if len(identities) else float("nan"),
        "more": None if same else compared(kept, others[0], difference),
        "reported at the end": float(reported.mean()) if len(reported) else float("nan"),
        "with errors": len(known),
        "error, m": float(known.mean()),
        "relative change": None if same else compared(errors, others[1], relative_change),
        "median, m": float(np.median(known)),
    }
