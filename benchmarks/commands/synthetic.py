"""`python -m benchmarks synthetic`: MOTA, MOTP and identity switches on scenes drawn from the interaction model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from data_tools.datasets.source import names
from data_tools.figures import FigureTable, cell
from pipelines.cli.options import Verbose
from pipelines.cli.reporting import progress_bar
from pipelines.cli.tables import JsonFile, show_tables

if TYPE_CHECKING:
    from benchmarks.synthetic import Cell, SyntheticResult
    from data_tools.metrics import Interval


def synthetic(
    seeds: Annotated[int, typer.Option("--seeds", min=2, help="Scenes of each cell.")] = 10,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the first of them.")] = 0,
    cells: Annotated[
        str | None, typer.Option("--cells", help="Names of cells, with commas between; all if left out.")
    ] = None,
    json_file: JsonFile = None,
    verbose: Verbose = False,
) -> None:
    """Independent objects, interactions, and graph matching over coupling, noise, occlusion and density.

    A cell of ten scenes takes two minutes of one core, half of it to learn interactions.

    \b
    Examples:
      python -m benchmarks synthetic
      python -m benchmarks synthetic --seeds 2 --cells 'base,no coupling' --json figures.json
    """
    from benchmarks.synthetic import CELLS, synthetic
    from data_tools.figures import write_figures
    from data_tools.files.atomic_files import check_writable
    from saga_fg.errors import InputError

    chosen = dict(CELLS) if cells is None else {}
    for name in names("--cells", cells) if cells is not None else ():
        if name not in CELLS:
            raise InputError(f"--cells {name}: expected some of {', '.join(CELLS)}")
        chosen[name] = CELLS[name]
    if json_file is not None:
        check_writable(json_file)
    with progress_bar(unit="cells") as progress:
        result = synthetic(range(seed, seed + seeds), chosen, progress)
    show_tables([_figures(result, seeds), _changes(result)])
    if json_file is not None:
        write_figures(json_file, _as_json(result))


def _figures(result: SyntheticResult, seeds: int) -> FigureTable:
    from benchmarks.synthetic import CONTENDERS, FIGURES

    columns = ("cell", *(f"{figure} {each}" for figure in FIGURES for each in CONTENDERS))
    rows = tuple(
        (part.name, *(cell(part.figure(each, figure)) for figure in FIGURES for each in CONTENDERS))
        for part in _parts(result)
    )
    return FigureTable(f"{seeds} scenes a cell; MOTP in m, identity switches (IDS) a scene", columns, rows)


def _changes(result: SyntheticResult) -> FigureTable:
    from benchmarks.synthetic import COMPARISONS

    columns = ("cell", *(f"{figure}, {a} to {b}" for a, b, figure in COMPARISONS))
    rows = tuple((part.name, *(_interval(part, *each) for each in COMPARISONS)) for part in _parts(result))
    return FigureTable("changes with 95 % intervals: MOTA as a difference, the others in %", columns, rows)


def _interval(part: Cell, contender: str, baseline: str, figure: str) -> str:
    change = part.change(contender, baseline, figure)
    values = (change.estimate, change.low, change.high)
    if figure == "MOTA":
        return "{:+.3f} ({:+.3f} to {:+.3f})".format(*values)
    return "{:+.0f} ({:+.0f} to {:+.0f})".format(*(100 * value for value in values))


def _parts(result: SyntheticResult) -> tuple[Cell, ...]:
    """The cells, then those pools of them that hold any."""
    pools = (result.interacting, result.dense)
    return (*result.cells, *(pool for pool in pools if any(pool.metrics.values())))


def _as_json(result: SyntheticResult) -> dict[str, Any]:
    from benchmarks.synthetic import COMPARISONS, CONTENDERS, FIGURES, KF

    def changes(part: Cell) -> dict[str, Interval]:
        return {f"{figure}: {a} to {b}": part.change(a, b, figure) for a, b, figure in COMPARISONS}

    return {
        part.name: {
            "figures": {each: {figure: part.figure(each, figure) for figure in FIGURES} for each in CONTENDERS},
            "changes": changes(part),
            "significantly_worse_than_kf": {each: part.worse(each, KF) for each in CONTENDERS if each != KF},
        }
        for part in _parts(result)
    }
