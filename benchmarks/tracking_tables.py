"""The tracking benchmark as tables, and as figures for programs."""

from __future__ import annotations

import math
from typing import Any

from benchmarks.predictions import PredictionFigure, prediction_figures
from benchmarks.tracking import KF, RELATIVE_SWITCHES, SAGA, SetResult, verdict
from data_tools.figures import FigureTable, cell
from data_tools.metrics import Interval, calibration, error_summary, errors_by_class


def tables(result: SetResult) -> list[FigureTable]:
    """For people: variants, times by stage, what the graph changes, consistency of the covariances, predictions."""
    return [
        *(_variants(result), _stages(result)),
        *(*_differences(result), *_calibrations(result), *_predictions(result)),
    ]


def figures(result: SetResult) -> dict[str, Any]:
    """For programs."""
    return {
        "scenes": result.scenes,
        "variants": {
            name: {
                "figures": each.figures,
                "errors": {label: error_summary(e) for label, e in errors_by_class(result.errors(name)).items()},
                "milliseconds_per_frame": each.milliseconds,
                "milliseconds_by_stage": each.stages,
                "ratio_to_centerpoint": result.ratio(name),
            }
            for name, each in result.variants.items()
        },
        "against_kf": {
            variant: {name: {"difference": each, "verdict": verdict(name, each)} for name, each in found.items()}
            for variant, found in result.differences.items()
        },
        "predictions": _predicted(result),
        "calibration": {label: calibration(e) for label, e in errors_by_class(result.errors("saga")).items()},
    }


def _variants(result: SetResult) -> FigureTable:
    names = list(next(iter(result.variants.values())).figures)
    columns = ("variant", *names, "position", "velocity", "velocity moving", "ms / frame", "/ centerpoint")
    rows = []
    for name, each in result.variants.items():
        errors = error_summary(result.errors(name))
        headline = (_headline(figure, value) for figure, value in each.figures.items())
        rest = (cell(errors.position), cell(errors.velocity), cell(errors.velocity_moving))
        rows.append((name, *headline, *rest, cell(each.milliseconds, 2), cell(result.ratio(name), 1)))
    title = f"{result.name}: {len(result.scenes)} scenes; RMSE of position in m, of velocity in m/s"
    return FigureTable(title, columns, tuple(rows))


def _stages(result: SetResult) -> FigureTable:
    compared = {name: result.variants[name] for name in ("saga", "kf")}
    stages = tuple(next(iter(compared.values())).stages)
    rows = tuple((name, *(cell(each.stages[stage], 2) for stage in stages)) for name, each in compared.items())
    return FigureTable(f"{result.name}: ms a frame by stage", ("method", *stages), rows)


def _headline(name: str, value: float) -> str:
    if name.endswith("IDS") or name == "FRAG":
        return cell(value, 0)
    return cell(100 * value, 2) if name.endswith((" MOTA", " AMOTA", " sAMOTA")) else cell(value)  # KITTI: in %


def _differences(result: SetResult) -> list[FigureTable]:
    tables = []
    for variant, found in result.differences.items():
        rows = tuple((name, *_interval(name, each), verdict(name, each)) for name, each in found.items())
        title = f"{result.name}: what the graph changes, {variant} less kf (RMSE: relative), 95 % intervals over scenes"
        if rows:
            tables.append(FigureTable(title, ("figure", "difference", "from", "to", f"{variant} is"), rows))
    return tables


def _interval(name: str, difference: Interval) -> tuple[str, ...]:
    values = (difference.estimate, difference.low, difference.high)
    if name == RELATIVE_SWITCHES or (name.endswith("RMSE") and not name.startswith("hidden")):
        return tuple(f"{100 * value:+.2f} %" for value in values)
    return tuple(f"{value:+.4g}" for value in values)


def _calibrations(result: SetResult) -> list[FigureTable]:
    classes = {label: calibration(e) for label, e in errors_by_class(result.errors("saga")).items()}
    rows = tuple(
        (
            label,
            cell(c.objects),
            cell(c.boxes),
            cell(c.anees, 2),
            *(cell(100 * share, 1) for share in c.coverage.values()),
        )
        for label, c in classes.items()
        if c.enough_data
    )
    columns = ("class", "objects", "boxes", "ANEES / 2", "in 50 %", "in 90 %", "in 99 %")
    return [FigureTable(f"{result.name}: errors within saga's ellipses, in %", columns, rows)] if rows else []


def _predictions(result: SetResult) -> list[FigureTable]:
    rows = tuple(
        (
            "moving" if f.moving else "all",
            cell(f.horizon, 0),
            f.method,
            cell(f.predictions, 0),
            cell(f.error, 2),
            ""
            if f.change is None
            else ", ".join(_interval("RMSE", f.change)[: 3 if math.isfinite(f.change.low) else 1]),
            cell(f.nll, 2),
            *(cell(100 * share, 0) for share in f.coverage.values()),
        )
        for f in _predicted(result)
    )
    names = ("objects", "s ahead", "method", "predictions", "mean error, m", f"against {KF}, from, to", "NLL")
    title = f"{result.name}: predictions of objects that are detected now"
    return [FigureTable(title, (*names, "in 50 %", "in 90 %"), rows)] if rows else []


def _predicted(result: SetResult) -> list[PredictionFigure]:
    errors = {name: result.variants[name].predictions for name in (KF, SAGA)}
    return prediction_figures(errors, KF, result.variants[SAGA].score.units)
