"""The one way in which benchmarks run: options, rows, tables, JSON, contenders in turn, and intervals.

A benchmark is a function that yields rows: the title of a table, and the figures of one row by column. Its parameters
are the options of its command, its docstring is the help. Everything that is compared is measured in the same run.

Times are CPU times of the process on one thread of linear algebra. Contenders take turns item by item, so that whatever
else the machine does hits all of them alike. Figures are medians, and ratios of medians.

Paired bootstrap over scenes: confidence intervals of differences between two trackers run on the same scenes.

Scenes are sampled with replacement, the same sample for both trackers; the sums of each sample are added up and the
statistic is computed from the totals (a pooled RMSE, a pooled MOTA), not averaged over scenes. The interval is the
percentile interval of the compared statistics. The independent units are scenes,
not boxes: errors within a scene are correlated.

Source: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, chapters 8 and 13.
"""

from __future__ import annotations

import inspect
import logging
import math
import platform
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import typer
from numpy.typing import ArrayLike
from rich.progress import track
from threadpoolctl import threadpool_info

from data_tools.datasets.source import names
from data_tools.figures import FigureTable
from data_tools.metrics import ErrorSample
from pipelines.cli.console import JsonFile, MarkdownFile, error_console, new_group, report
from pipelines.cli.options import Verbose, as_command
from pipelines.tracking import one_thread
from saga_fg.errors import InputError, unknown_name
from saga_fg.numerics import FloatArray, checked

Statistic = Callable[[FloatArray], FloatArray]
Comparison = Callable[[FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True)
class Interval:
    """An estimate with its `confidence` interval [low, high]."""

    estimate: float
    low: float
    high: float
    confidence: float

    def __str__(self) -> str:
        return f"{self.estimate:.4g} [{self.low:.4g}, {self.high:.4g}]"


def ratio_of_sums(sums: FloatArray) -> FloatArray:
    """First sum over second sum (..., 2) -> (...): a pooled mean."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(sums[..., 0] / sums[..., 1])


def root_mean_square(sums: FloatArray) -> FloatArray:
    """Pooled RMSE of (sum of squares, count) (..., 2) -> (...)."""
    return np.sqrt(ratio_of_sums(sums))


def square_sums(errors: ErrorSample) -> tuple[float, float]:
    """(sum of squares, number of values), the sums for a bootstrap of the RMSE."""
    return float(np.sum(errors.values**2)), float(len(errors))


def relative_change(a: FloatArray, b: FloatArray) -> FloatArray:
    """a / b - 1: -0.25 if a is 25 % lower than b."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(a / b - 1.0)


def difference(a: FloatArray, b: FloatArray) -> FloatArray:
    """a - b."""
    return np.asarray(a - b)


def paired_bootstrap(
    a: ArrayLike,
    b: ArrayLike,
    statistic: Statistic = root_mean_square,
    compare: Comparison = relative_change,
    *,
    confidence: float = 0.95,
    draws: int = 10_000,
    seed: int = 0,
) -> Interval:
    """Interval of `compare(statistic(sums of a), statistic(sums of b))` over the same S scenes.

    a, b       (S, m) sums of each scene, for instance `square_sums`
    statistic  maps totals (..., m) to values (...); must work on stacks of totals

    Samples in which the statistic is undefined (all their scenes are empty) are left out; NaN if there are no others.
    Raises `InputError` for arrays of different shapes, no scene, or a confidence outside (0, 1).
    """
    first = checked("a", a, (None, None))
    second = checked("b", b, first.shape)
    if len(first) == 0:
        raise InputError("a: expected the sums of at least one scene")
    if not 0.0 < confidence < 1.0:
        raise InputError(f"confidence: expected a probability between 0 and 1, got {confidence}")
    estimate = float(compare(statistic(first.sum(axis=0)), statistic(second.sum(axis=0))))
    scenes = len(first)
    weights = (
        np.random.default_rng(seed).multinomial(scenes, np.full(scenes, 1 / scenes), size=draws).astype(np.float64)
    )
    values = compare(statistic(weights @ first), statistic(weights @ second))
    values = values[np.isfinite(values)]
    tail = (1 - confidence) / 2
    low, high = np.quantile(values, [tail, 1 - tail]) if len(values) else (np.nan, np.nan)
    return Interval(estimate, float(low), float(high), confidence)


PROGRAM = (sys.executable, "-c", "from pipelines.cli.main import main; main()")  # the command, for other processes

T = TypeVar("T")
Row = tuple[str, Mapping[str, Any]]
"""Title of a table, and one of its rows: figures by column."""
Rows = Iterator[Row]

Data = Annotated[Path | None, typer.Option("--data", help="Folder with nuscenes/, kitti/ and others.")]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of what is simulated.")]


def command(run: Callable[..., Rows]) -> Callable[..., None]:
    """The command of a benchmark: its own options and those of the output. What was found before an error is shown."""

    def printed(json_file: JsonFile = None, markdown: MarkdownFile = None, verbose: Verbose = False) -> None:
        """Options of every benchmark."""

    @wraps(run)
    def main(*, json_file: Path | None, markdown: Path | None, verbose: bool, **options: Any) -> None:
        rows: list[Row] = []
        try:
            for row in run(**options):
                rows.append(row)
        finally:
            if rows:
                about = {"benchmark": run.__name__, "options": {k: str(v) for k, v in options.items()}}
                told = [{"table": title, **figures} for title, figures in rows]
                report(tables(rows), {**about, "environment": environment(), "rows": told}, json_file, markdown)
                typer.echo(", ".join(f"{name} {value}" for name, value in environment().items()))

    both = [*inspect.signature(run, eval_str=True).parameters.values()]
    both += inspect.signature(printed, eval_str=True).parameters.values()
    main.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in both]
    )
    main.__annotations__ = {each.name: each.annotation for each in both}
    return main


def application(benchmarks: Iterable[Callable[..., Rows]]) -> typer.Typer:
    """One command for all benchmarks."""
    app = new_group("Measure: every figure stands beside a baseline of the same run.")
    for run in benchmarks:
        app.command()(command(as_command(run)))
    return app


def tables(rows: Sequence[Row]) -> list[FigureTable]:
    """Rows of one title as a table, in the order in which they were yielded."""
    found = []
    for title in dict.fromkeys(title for title, _ in rows):
        mine = [figures for name, figures in rows if name == title]
        columns = tuple(dict.fromkeys(column for figures in mine for column in figures))
        found.append(FigureTable(title, columns, tuple(tuple(text(f.get(c)) for c in columns) for f in mine)))
    return found


def text(value: Any) -> str:
    """A figure as it is printed: an interval is a change, with its sign; "-" stands for numbers that are not finite."""
    if isinstance(value, Interval):
        bounds = f"{value.low:+.3g} to {value.high:+.3g}" if math.isfinite(value.low) else "-"
        return f"{value.estimate:+.3g} ({bounds})" if math.isfinite(value.estimate) else "-"
    if isinstance(value, float | np.floating):
        return f"{value:.4g}" if math.isfinite(value) else "-"
    return "" if value is None else str(value)


def chosen(option: str, text: str, known: Sequence[str]) -> tuple[str, ...]:
    """The entries of an option with commas between them. Raises `InputError` for one that is not known."""
    found = names(option, text)
    for name in found:
        if name not in known:
            raise InputError(f"{option}: {unknown_name('name', name, tuple(known))}")
    return found


def counts(option: str, value: str, least: int = 1) -> tuple[int, ...]:
    """The entries of a comma-separated option as whole numbers from `least` on, each once."""
    entries = dict.fromkeys(entry.strip() for entry in value.split(",") if entry.strip())
    if not entries or not all(entry.isdecimal() and len(entry) < 10 and int(entry) >= least for entry in entries):
        raise InputError(f"{option}: expected whole numbers >= {least} with commas between them, got {value[:40]!r}")
    return tuple(map(int, entries))


@contextmanager
def only_errors(name: str) -> Iterator[None]:
    """Let a logger tell nothing but errors, for the length of a block."""
    logger = logging.getLogger(name)
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


def each(items: Sequence[T], name: str) -> Iterator[T]:
    """Items one after the other, with a bar on stderr where that is a terminal."""
    console = error_console()
    yield from track(items, name, console=console, transient=True, disable=not console.is_terminal)


def in_turn(
    contenders: Mapping[str, Callable[[T], Callable[[], Any]]],
    items: Iterable[T],
    warm_up: int = 0,
    seconds: float = math.inf,
) -> dict[str, FloatArray]:
    """Milliseconds of CPU time (K,) that each contender takes for each item, one item after the other.

    contenders  called with an item to prepare what is not timed; what they return is called and timed
    warm_up     items that are not counted
    seconds     no further item after this time
    """
    times: dict[str, list[float]] = {name: [] for name in contenders}
    with one_thread():
        for number, item in enumerate(items):
            for name, prepare in contenders.items():
                times[name].append(timed(prepare(item)))
            if number >= warm_up and sum(map(sum, times.values())) > 1e3 * seconds:
                break
    return {name: np.array(spent[min(warm_up, len(spent) - 1) :]) for name, spent in times.items()}


def clocked(run: Callable[..., T], *arguments: Any) -> tuple[T, float]:
    """The result of a call, and the milliseconds of CPU time that it takes."""
    begin = time.process_time()
    result = run(*arguments)
    return result, 1e3 * (time.process_time() - begin)


def timed(run: Callable[..., Any], *arguments: Any) -> float:
    """Milliseconds of CPU time that a call takes."""
    return clocked(run, *arguments)[1]


def growth(sizes: Sequence[float], milliseconds: Sequence[float]) -> float:
    """The exponent of time over size."""
    return float(np.polyfit(np.log(sizes), np.log(milliseconds), 1)[0]) if len(sizes) > 1 else math.nan


def resampled(
    figures: Callable[[Sequence[int]], Mapping[str, float]], units: Sequence[Sequence[int]], draws: int
) -> dict[str, Interval]:
    """Figures that have no sums, with 95 % intervals: computed anew for each drawn set of scenes.

    figures  of scenes by their numbers, of which any may occur more than once
    units    numbers of the scenes; those of one unit are drawn together
    """
    rng, found = np.random.default_rng(0), []
    for _ in range(draws):
        found.append(figures([row for unit in rng.integers(len(units), size=len(units)) for row in units[unit]]))
    result = {}
    for name, estimate in figures([row for unit in units for row in unit]).items():
        values = [value for each in found if math.isfinite(value := each.get(name, math.nan))]
        low, high = np.quantile(values, [0.025, 0.975]).tolist() if values else (math.nan, math.nan)
        result[name] = Interval(estimate, low, high, 0.95)
    return result


def environment() -> dict[str, str]:
    """Return versions and hardware that the figures depend on."""
    blas = sorted({f"{pool['internal_api']} {pool['version']}" for pool in threadpool_info()})
    packages = {name: version(name) for name in ("saga-fg", "gtsam", "numpy", "scipy", "numba")}
    machine = {"python": platform.python_version(), "machine": platform.machine(), "blas": ", ".join(blas)}
    return {**machine, **packages}
