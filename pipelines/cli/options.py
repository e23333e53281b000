"""Options that commands share, how to track among them, and the commands of a verb for each dataset."""

import inspect
import os
from collections.abc import Callable, Iterable, Mapping
from copy import copy
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from shlex import quote
from typing import Annotated, Any, get_args, get_type_hints

import typer

from data_tools.datasets import DatasetSource, DetectionFileSource, Verb, dataset_names, dataset_source
from data_tools.files import check_writable, write_text
from pipelines.cli.console import ReportingGroup, new_command, new_group, set_up_logging
from pipelines.config import Method, TrackConfig, load_config, load_interactions
from pipelines.configuration import load_settings
from pipelines.learning import offset_fragment
from pipelines.report.page import as_recorded
from saga_fg.errors import InputError
from saga_fg.numerics import FloatArray
from saga_fg.tracking import AssociationName, SensorTime, estimator_parameters
from saga_fg.types import checked_horizons

Verbose = Annotated[
    bool, typer.Option("--verbose", "-v", help="Say more on stderr.", callback=set_up_logging, show_default=False)
]

Config = Annotated[
    Path | None, typer.Option("--config", help="YAML file over the defaults; see `saga-fg config`.", metavar="FILE")
]

Result = Annotated[
    Path, typer.Argument(help="Result of any tracker, in the format that `saga-fg track` writes for the dataset.")
]


def apart(output: Path, *inputs: Path, option: str = "--output") -> None:
    """Raise `InputError` where the output, which `option` names, would overwrite what is read."""
    for path in inputs:
        if os.path.realpath(output) == os.path.realpath(path):  # unlike Path.resolve, it stands links in a circle
            raise InputError(f"{option} {output}: expected another file than those that are read")


MethodOption = Annotated[
    Method,
    typer.Option(
        "--method",
        help="saga: graph-aware Kalman filter; kf: without edges, trails and lanes; centerpoint: greedy nearest "
        "centre.",
    ),
]


@dataclass(frozen=True)
class MethodOptions:
    """Which method, the options of all commands that track or label."""

    method: MethodOption = "saga"
    association: Annotated[
        AssociationName | None,
        typer.Option(
            "--association",
            help="How detections are matched to tracks. hungarian: least total cost; greedy: the cheapest pair first; "
            "graph: relative positions count as well.  [default: as configured]",
        ),
    ] = None
    interactions: Annotated[
        Path | None,
        typer.Option("--interactions", help="Edge rules from `saga-fg learn interactions`.", metavar="FILE"),
    ] = None

    def over(self, settings: TrackConfig) -> TrackConfig:
        """The settings with these. Raises `InputError` for options that have no effect on the method."""
        if self.method == "centerpoint" and self.association is not None:
            raise InputError("--association: the method centerpoint has its own")
        if self.interactions is not None:
            if self.method != "saga":
                raise InputError(
                    f"--interactions {self.interactions}: goes with --method saga, {self.method} has no interactions"
                )
            settings = settings.with_interactions(load_interactions(self.interactions))
        return settings.with_association(self.association)


@dataclass(frozen=True)
class TrackerOptions(MethodOptions):
    """Which tracker, the options of all commands that track."""

    estimator: Annotated[
        str | None,
        typer.Option(
            "--estimator",
            help="kalman: fastest; isam2: the same filter as a factor graph of the last interval; fixed-lag: that of "
            "the last --lag seconds, which puts late frames where they belong; MODULE:NAME, which is imported, or the "
            "name of an installed entry point: your own. The bounds of kalman (tracker.tolerance, "
            "tracker.max_component) move tracks by millimetres, a centimetre at most in our recordings.  "
            "[default: as configured]",
            metavar="NAME",
        ),
    ] = None
    lag: Annotated[
        float | None,
        typer.Option("--lag", min=0.0, help="Window of the fixed-lag estimator, s.  [default: as configured]"),
    ] = None

    def configured(self, family: str | Path, config: Path | None) -> TrackConfig:
        """The settings of a run: the family's, the file's, then these. Raises `InputError` for those without effect."""
        settings = self.over(load_config(family, config))
        if self.method == "centerpoint" and (self.estimator is not None or self.lag is not None):
            raise InputError("--estimator, --lag: the method centerpoint has no estimator")
        if self.lag is not None and "lag" not in estimator_parameters(
            settings.tracker.estimator if self.estimator is None else self.estimator
        ):
            raise InputError(f"--lag {self.lag:g}: goes with --estimator fixed-lag")
        return settings.with_estimator(self.estimator, self.lag)


def family_of(source: DatasetSource, config: Path | None, method: Method) -> str | Path:
    """The shipped settings that fit a dataset, which the file `config` lies over.

    A table has those that `--settings` names. One of dense traffic has its own, which is told. With such a file, whose
    meaning depends on no data, it is told how to have them. The method centerpoint has settings of its own.
    """
    if not isinstance(source, DetectionFileSource) or method == "centerpoint":
        return source.family
    if source.settings is not None:
        return "dense" if source.settings == "dense" else source.family
    why = source.dense_traffic()
    if why and config is None:
        typer.echo(f"settings for dense traffic: {why}; --settings plain takes others", err=True)
        return "dense"
    if why:
        typer.echo(f"{config}: over plain settings; {why}: --settings dense takes those for dense traffic", err=True)
    return source.family


@dataclass(frozen=True)
class ScaleOptions:
    """Scenes in parallel, the options of all commands that can."""

    workers: Annotated[
        int | None,
        typer.Option(
            "--workers",
            min=0,
            help="Process scenes in parallel, in this many processes (0: one per core); a second run continues where "
            "the first stopped.",
            metavar="N",
        ),
    ] = None
    ray: Annotated[
        str | None,
        typer.Option(
            "--ray",
            help='Process scenes on a Ray cluster: "auto", HOST:PORT, ray://HOST:PORT, or "local" for one of --workers '
            "CPUs on this machine.",
            metavar="ADDRESS",
        ),
    ] = None

    @property
    def wanted(self) -> bool:
        """True if scenes are to be done in parallel."""
        return self.workers is not None or self.ray is not None


LearnOffsetsOption = Annotated[
    Path | None,
    typer.Option(
        "--learn-offsets",
        help="YAML file to write: the offsets of the sensors' clocks, from objects that several of them see, for "
        "`--config`.",
        metavar="FILE",
    ),
]


def horizons(predict: str | None, method: Method) -> FloatArray | None:
    """The horizons (H,) of --predict, s; None if it is left out. Raises `InputError` for anything else."""
    if predict is None:
        return None
    if method == "centerpoint":
        raise InputError("--predict: expected --method saga or kf, centerpoint predicts nothing")
    try:
        return checked_horizons([float(text) for text in predict.split(",")])
    except InputError as error:
        raise InputError(f"--predict: {error}") from error
    except ValueError as error:
        raise InputError(f"--predict: expected seconds with commas between them, got {predict[:40]!r}") from error


def check_learn_offsets(path: Path | None, method: str, at_scale: bool = False) -> None:
    """Raise `InputError` where --learn-offsets would have no effect, or its file is not writable."""
    if path is None:
        return
    if method == "centerpoint":
        raise InputError("--learn-offsets: expected --method saga or kf")
    if at_scale:
        raise InputError("--learn-offsets: goes without --workers and --ray")
    check_writable(path)


def write_offsets(path: Path, scenes: Iterable[Mapping[str, SensorTime]], settings: TrackConfig, origin: str) -> None:
    """Write the file of --learn-offsets, and say what is in it."""
    text, offsets = offset_fragment(scenes, settings.sensors, origin)
    write_text(path, text)
    found = ", ".join(f"{name} {offset:+.4f} s" for name, offset in offsets.items())
    typer.echo(f"{path}: {found or 'no two sensors have moving objects in common'}", err=True)


def taken_apart(run: Callable[..., Any]) -> tuple[list[inspect.Parameter], Callable[..., Any]]:
    """The options of a command, the fields of dataclasses in place of these; and the command that is called with them.

    Those of a dataset are left out: it comes first, as an argument by position.
    """
    options: list[inspect.Parameter] = []
    groups: dict[str, Any] = {}
    for name, kind in get_type_hints(run, include_extras=True).items():
        if name == "return" or kind is DatasetSource:
            continue
        group: Any = kind if is_dataclass(kind) else None
        groups |= {name: group} if group else {}
        declared = inspect.signature(group or run).parameters
        hints = get_type_hints(group, include_extras=True) if group else {name: kind}
        options += [
            each.replace(annotation=hints[each.name], kind=inspect.Parameter.KEYWORD_ONLY)
            for each in declared.values()
            if each.name in hints
        ]

    def call(*dataset: DatasetSource, **values: Any) -> Any:
        for name, kind in groups.items():
            values[name] = kind(**{each.name: values.pop(each.name) for each in fields(kind) if each.name in values})
        return run(*dataset, **values)

    return options, call


def as_command(run: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function with its options taken apart, as the command that typer makes of it."""
    options, call = taken_apart(run)
    call.__name__, call.__doc__, call.__signature__ = run.__name__, run.__doc__, inspect.Signature(options)  # type: ignore[attr-defined]
    call.__annotations__ = {each.name: each.annotation for each in options}
    return call


Source = type[DatasetSource]
_WIDTH = 92  # columns of an example


def dataset_commands(
    verb: Verb,
    about: str,
    run: Callable[..., None],
    examples: tuple[str, ...],
    texts: Callable[[Source], Mapping[str, str | None]] = lambda source: {},
    listed: Callable[[Source], bool] = lambda source: True,
) -> typer.Typer:
    """A group with a command `saga-fg VERB DATASET` for each dataset, beside those that are added to it.

    about     help of the group
    run       called with the dataset and the values of its other parameters, which are the verb's options; its
              docstring is the help
    examples  what follows `saga-fg`, with the fields {recordings}: name and options of the dataset, {result}: the same
              with a result, {name} alone, {tracks}: name of a result alone
    texts     of the verb's options that differ for a dataset, by parameter; None leaves the option out
    listed    which datasets the help lists
    """

    class DatasetGroup(ReportingGroup):
        def list_commands(self, ctx: Any) -> list[str]:
            return [*(name for name in dataset_names() if _is_listed(name, listed)), *super().list_commands(ctx)]

        def get_command(self, ctx: Any, cmd_name: str) -> Any:
            own = super().get_command(ctx, cmd_name)
            if own is not None:
                return own
            if cmd_name not in dataset_names() and Path(cmd_name).exists():
                raise InputError(_without_dataset(verb, cmd_name))
            try:
                return _command(verb, run, dataset_source(cmd_name), examples, texts)
            except InputError as error:
                if cmd_name not in dataset_names():
                    raise
                return _broken(cmd_name, error)  # so that the list of all datasets can be shown

    return new_group(about, DatasetGroup)


def _without_dataset(verb: str, place: str) -> str:
    """Error message for a file or folder given in place of a dataset's name."""
    path = Path(place)
    bag = path.suffix in (".mcap", ".db3") or (path / "metadata.yaml").is_file()
    if path.is_dir() and not bag:
        return f"{place}: expected the name of a dataset before a folder: saga-fg {verb} --help lists them"
    return f"{place}: expected a dataset before the file: saga-fg {verb} {'mcap' if bag else 'file'} {quote(place)} ..."


def _is_listed(name: str, listed: Callable[[Source], bool]) -> bool:
    try:
        return listed(dataset_source(name))
    except InputError:
        return True  # its command says what is wrong with it


def _command(
    verb: Verb,
    run: Callable[..., None],
    source: Source,
    examples: tuple[str, ...],
    texts: Callable[[Source], Mapping[str, str | None]],
) -> Any:
    """The command of a verb for one dataset."""
    of_verb, call = taken_apart(run)
    reads_result = any(each.name == "result" for each in of_verb)
    different = {"config": _config_text(source), **texts(source)}
    parameters = [
        _described(each, different[each.name]) if each.name in different else each
        for each in of_verb
        if different.get(each.name, "") is not None
    ]
    of_dataset = _parameters(source, verb, reads_result)
    taken = {each.name for each in parameters} & {each.name for each in of_dataset}
    if taken:
        raise InputError(f"dataset {source.name}: {min(taken)}: expected another name, {verb} has such an option")
    settings = _settings(source)

    def command(**values: Any) -> None:
        chosen = {each.name: values.pop(each.name) for each in of_dataset}
        for name, kind in settings.items():
            if chosen.get(name) is not None:
                chosen[name] = load_settings(kind, chosen[name])
        chosen_source = source(**chosen)
        if values.get("result") is not None:
            chosen_source = as_recorded(chosen_source, values["result"])
        call(chosen_source, **values)

    ordered = sorted([*of_dataset, *parameters], key=lambda each: each.name != "result")
    keyword = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in ordered]
    command.__signature__ = inspect.Signature(keyword)  # type: ignore[attr-defined]
    command.__annotations__ = {each.name: each.annotation for each in keyword}
    about = inspect.getdoc(source) or ""
    text = f"{inspect.getdoc(run)}\n\n{about}\n\n{_examples(verb, source, examples)}"
    return new_command(command, source.name, help=text, short_help=about.partition("\n\n")[0])


def _config_text(source: Source) -> str:
    fitting = f", those of {source.family}" if source.family != source.name else ""
    return f"YAML file over the settings for {source.name}{fitting}; see `saga-fg config --for {source.name}`."


def _broken(name: str, error: InputError) -> Any:
    """A command in place of one that cannot be made, which says why."""

    def command(arguments: Annotated[list[str] | None, typer.Argument()] = None) -> None:
        raise error

    text = f"Cannot be loaded: {error}"
    return new_command(command, name, help=text, context_settings={"ignore_unknown_options": True})


def _parameters(source: Source, verb: Verb, reads_result: bool) -> list[inspect.Parameter]:
    """The options of a dataset that a verb has."""
    hints, settings, parameters = get_type_hints(source), _settings(source), []
    for each in fields(source):
        about = each.metadata
        if "text" not in about or (about["verbs"] and verb not in about["verbs"]):
            continue
        common = {"help": about["text"], "metavar": about["metavar"], "min": about["least"]}
        flag = about["flag"] or f"--{each.name.replace('_', '-')}"
        is_argument = about["argument"] and not reads_result
        info = typer.Argument(**common) if is_argument else typer.Option(flag, **common)
        required = each.default is MISSING or verb in about["required"]
        parameters.append(
            inspect.Parameter(
                each.name,
                inspect.Parameter.KEYWORD_ONLY,
                default=inspect.Parameter.empty if required else each.default,
                annotation=Annotated[Path | None if each.name in settings else hints[each.name], info],
            )
        )
    return parameters


def _settings(source: Source) -> dict[str, type[Any]]:
    """The options of a dataset that are read from YAML files: their dataclasses by name."""
    hints = get_type_hints(source)
    kinds = {each.name: (hints[each.name], *get_args(hints[each.name])) for each in fields(source)}
    found = {name: [kind for kind in of if isinstance(kind, type) and is_dataclass(kind)] for name, of in kinds.items()}
    return {name: of[0] for name, of in found.items() if of}


def _described(parameter: inspect.Parameter, text: str | None) -> inspect.Parameter:
    """Option with another help."""
    kind, info = get_args(parameter.annotation)
    other = copy(info)
    other.help = text
    return parameter.replace(annotation=Annotated[kind, other])


def _examples(verb: Verb, source: Source, examples: tuple[str, ...]) -> str:
    """Worked examples, in lines that are not too long."""
    required = [each.name for each in _parameters(source, verb, False) if each.default is inspect.Parameter.empty]
    options = source.example or " ".join(f"--{name.replace('_', '-')} {name.upper()}" for name in required)
    arguments = [f"--{each.name} " for each in fields(source) if each.metadata.get("argument")]
    recordings = f"{source.name} {options}"
    result = "labels" if verb == "evaluate labels" else source.written.tracks_example
    beside = f"{source.name} {result} {''.join(arguments)}{options}"
    if verb == "evaluate":
        recordings = f"{source.name} {''.join(arguments)}{options}"
    if verb in ("evaluate", "evaluate labels") and source.truth_option:
        truth = f" {source.truth_option} truth.csv"
        recordings += truth
        beside = f"{source.name} {result}{truth}" if verb == "evaluate" else beside + truth
    lines = []
    for example in examples:
        line = "  saga-fg " + example.format(recordings=recordings, result=beside, name=source.name, tracks=result)
        while len(line) > _WIDTH and (cut := line.rfind(" --", 20, _WIDTH - 2)) > 0:
            lines.append(f"{line[:cut]} \\")
            line = f"     {line[cut:]}"
        lines.append(line)
    return "\n".join(["\b", "Example:" if len(examples) == 1 else "Examples:", *lines])
