"""The page: results on disk as one HTML file with style, script and data, and the record of their run.

The data is JSON, deflated, in base64; the browser inflates it.

The record of a run, written beside its result for reports: method, version, configuration and times.

{"method": "saga", "version": "0.1.0", "configuration": YAML, "milliseconds": {scene: [of each frame]},
 "recordings": how they were read, "clocks": {scene: {sensor: its clock}} where there are several}
"""

import base64
import html
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from data_tools.datasets import DatasetSource, Results, clear_figures, found_results, read_predictions
from data_tools.figures import COLOURS, Chart, FigureTable, as_json, class_colours
from data_tools.files import parsed_json, read_bytes, write_text
from pipelines.config import load_config
from pipelines.explaining import clock_table, journal_of, read_relations
from pipelines.report.figures import UNSEEN, latency_chart, track_charts, track_figures
from pipelines.report.scenes import ReportScene, comparisons, scene_data, start_thresholds, thumbnails
from saga_fg.errors import InputError
from saga_fg.tables import Table, TableImport
from saga_fg.tracking import SensorTime

SCRIPTS = ("charts", "road", "fans", "layers", "filters", "panel", "visits", "review", "player")


@dataclass(frozen=True, eq=False)
class Report:
    """Content of a page; `facts` are lines under the title, `notes` paragraphs above the player.

    start   moment of the first scene that the player shows first; None: the one with the most tracks
    ghosts  whether it shows tracks that nobody sees now from the start
    beside  the method that it shows beside the last one from the start, "" for none
    review  of labels, what `review.js` needs to take corrections; None for a page that takes none
    """

    title: str
    facts: Sequence[str]
    scenes: Sequence[ReportScene]
    tables: Sequence[FigureTable] = ()
    charts: Sequence[Chart] = ()
    configuration: str = ""
    notes: Sequence[str] = ()
    start: int | None = None
    ghosts: bool = False
    beside: str = ""
    review: Mapping[str, Any] | None = None


def report_page(report: Report) -> str:
    """Return the HTML text."""
    thresholds = start_thresholds(report.scenes)
    scenes = [scene_data(scene) | {"comparisons": comparisons(scene, thresholds)} for scene in report.scenes]
    labels = sorted({label for scene in scenes for label in scene["labels"]})
    data = {
        "scenes": scenes,
        "charts": [asdict(chart) for chart in report.charts],
        "colours": class_colours([*labels, *(series.name for chart in report.charts for series in chart.series)]),
        "palette": COLOURS,
        "start": report.start,
        "ghosts": report.ghosts,
        "beside": report.beside,
        "unseen": round(1000 * UNSEEN),
        "thresholds": thresholds,
        "review": report.review,
    }
    configuration = f"<pre>{html.escape(report.configuration)}</pre>" if report.configuration else ""
    page = page_part("page.html")
    for mark, text in (
        ("TITLE", html.escape(report.title)),
        ("FACTS", "".join(f"<li>{html.escape(fact)}</li>" for fact in report.facts)),
        ("NOTES", "".join(f"<p>{html.escape(note)}</p>" for note in report.notes)),
        ("TABLES", "".join(map(table_html, report.tables))),
        ("CONFIGURATION", configuration),
        ("STYLE", page_part("page.css")),
        ("DATA", _packed(data)),
        ("CONNECT", "; connect-src 'self'" if report.review and report.review["server"] else ""),
        ("SCRIPT", "".join(page_part(f"{name}.js") for name in SCRIPTS if report.review or name != "review")),
    ):
        page = page.replace(f"<!--{mark}-->", text)
    return page


def page_part(name: str) -> str:
    """Text of a file of the page."""
    return (files("pipelines.report") / name).read_text(encoding="utf-8")


def _packed(data: Any) -> str:
    text = json.dumps(as_json(data), separators=(",", ":"), allow_nan=False)
    return base64.b64encode(zlib.compress(text.encode(), 9)).decode("ascii")


def table_html(table: FigureTable) -> str:
    """A table of a page."""
    head = "".join(f"<th>{html.escape(column)}</th>" for column in table.columns)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in table.rows)
    return (
        f"<figure class=table><figcaption>{html.escape(table.title)}</figcaption><div class=wide><table>"
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div></figure>"
    )


@dataclass(frozen=True)
class RunRecord:
    """method; version of saga-fg; configuration, YAML; milliseconds in the tracker for every frame, by scene.

    recordings  how the dataset was read, `DatasetSource.kept`
    clocks      of the sensors by scene
    """

    method: str
    configuration: str
    milliseconds: Mapping[str, Sequence[float]]
    version: str = version("saga-fg")
    recordings: Mapping[str, Any] = field(default_factory=dict)
    clocks: Mapping[str, Mapping[str, SensorTime]] = field(default_factory=dict)


def record_path(result: Path) -> Path:
    """Return the path of a result's record: beside a file, or in a folder of results."""
    return result / "run.json" if result.is_dir() else result.with_name(f"{result.stem}.run.json")


def write_run_record(result: Path, record: RunRecord) -> None:
    """Write the record of a result that has just been written."""
    write_text(record_path(result), json.dumps(asdict(record)) + "\n")


def read_run_record(result: Path) -> RunRecord | None:
    """Read the record of a result, None if it has none. Raises `InputError` for a broken one."""
    path = record_path(result)
    if not path.is_file():
        return None
    raw = parsed_json(read_bytes(path), str(path))
    try:
        milliseconds = {str(name): [float(ms) for ms in times] for name, times in raw["milliseconds"].items()}
        kept = dict(raw.get("recordings", {}))
        clocks = {
            str(name): {str(k): SensorTime(**v) for k, v in of.items()} for name, of in raw.get("clocks", {}).items()
        }
        return RunRecord(str(raw["method"]), str(raw["configuration"]), milliseconds, str(raw["version"]), kept, clocks)
    except (ValueError, OverflowError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: expected the record of a run: {error}") from error


def as_recorded(source: DatasetSource, result: Path) -> DatasetSource:
    """A dataset, read as it was for a result, where its options do not say otherwise."""
    record = read_run_record(result)
    return source if record is None else source.with_kept(record.recordings)


@dataclass(frozen=True, eq=False)
class _Result:
    """A result that has been read: of a method, by scene, with the record of its run where there is one.

    relations  right of way between tracks, by scene and time, s: of its journal, for pages
    """

    method: str
    path: Path
    found: Results
    record: RunRecord | None
    relations: Mapping[str, Mapping[float, Sequence[Sequence[Any]]]] = field(default_factory=dict)


def result_report(source: DatasetSource, result: Path, beside: Path | None = None, images: int = 0) -> Report:
    """Report on the result of any tracker; with figures where the dataset has ground truth, else of the tracks alone.

    beside  another result of the same recordings, to show beside it
    images  width of the camera images to show, pixels; 0: none

    Raises `InputError` for missing or broken files, and for a result that does not fit the dataset or the other one.
    """
    results = [_read(source, result)]
    if beside is not None:
        results = _with_distinct_names(results[0], _read(source, beside))
    scenes = _scenes(source, results[0])
    for other in results[1:]:
        scenes = [_joined(scene, other, added) for scene, added in _pairs(scenes, _scenes(source, other))]
    scenes = with_surroundings(source, scenes, images)
    tables: list[FigureTable] = []
    charts: list[Chart] = []
    for each in results:
        found = each.found.only([scene.scene.name for scene in scenes])
        prefix = f"{each.method}: " if len(results) > 1 else ""
        own_tables, own_charts = result_figures(found, source.has_truth)
        if each.record is not None:
            times = [ms for of_scene in each.record.milliseconds.values() for ms in of_scene]
            own_charts += [latency_chart(np.array(times))] if times else []
            own_tables += [clock_table(each.record.clocks)] if each.record.clocks else []
        tables += [replace(table, title=prefix + table.title) for table in own_tables]
        charts += [replace(chart, title=prefix + chart.title) for chart in own_charts]
    first = results[0]
    names = [each.scene.name for each in scenes]
    facts = [", ".join(each.path.name for each in results)]
    facts += [f"{len(names)} scenes" if len(names) > 3 else ", ".join(names)]
    facts += [f"{sum(len(each.scene) for each in scenes)} moments"]
    facts += [f"{sum(len(found.found) for found in first.found.scenes.values())} boxes"]
    facts += [f"saga-fg {first.record.version}"] if first.record is not None else []
    return Report(
        f"{' and '.join(each.method for each in results)} on {source}",
        facts,
        scenes,
        tables,
        charts,
        first.record.configuration if first.record is not None else "",
        beside=results[1].method if beside is not None else "",
    )


def result_scenes(source: DatasetSource, result: Path, found: Results) -> list[ReportScene]:
    """Return the scenes of a result, with edges by the rules of the dataset's default configuration.

    Raises `InputError` for a broken record of the run, or broken predictions.
    """
    record = read_run_record(result)
    return _scenes(source, _Result(record.method if record is not None else "tracks", result, found, record))


def _read(source: DatasetSource, path: Path) -> _Result:
    record = read_run_record(path)
    method, relations = path.stem if record is None else record.method, read_relations(journal_of(path))
    return _Result(method, path, source.read_results(path), record, relations)


def _with_distinct_names(one: _Result, other: _Result) -> list[_Result]:
    """Give two results different names."""
    if one.method != other.method:
        return [one, other]
    if one.path.stem != other.path.stem:
        return [replace(each, method=each.path.stem) for each in (one, other)]
    return [replace(each, method=f"{each.path.parent.name}/{each.path.stem}") for each in (one, other)]


def _scenes(source: DatasetSource, result: _Result) -> list[ReportScene]:
    config, predicted = load_config(source.family), read_predictions(result.path)
    return [
        ReportScene(
            each.scene,
            {result.method: each.found},
            {} if each.coasting is None else {result.method: each.coasting},
            config.tracker.edges,
            config.sensors,
            {result.method: predicted[name]} if name in predicted else {},
            relations={result.method: result.relations.get(name, {})},
        )
        for name, each in result.found.scenes.items()
    ]


def _pairs(
    scenes: Sequence[ReportScene], others: Sequence[ReportScene]
) -> Sequence[tuple[ReportScene, ReportScene | None]]:
    by_name = {each.scene.name: each for each in others}
    if scenes and not any(each.scene.name in by_name for each in scenes):
        raise InputError(f"--beside: expected a scene of the result, e.g. {scenes[0].scene.name}; it has none")
    return [(each, by_name.get(each.scene.name)) for each in scenes]


def _joined(scene: ReportScene, result: _Result, other: ReportScene | None) -> ReportScene:
    """Add the tracks of another result."""
    if other is None:
        return scene
    if not np.array_equal(scene.scene.timestamps, other.scene.timestamps):
        name = scene.scene.name
        raise InputError(f"{result.path}: scene {name}: expected the moments of the other result; give --detections")
    return replace(
        scene,
        tracks={**other.tracks, **scene.tracks},
        coasting={**other.coasting, **scene.coasting},
        predictions={**other.predictions, **scene.predictions},
        relations={**other.relations, **scene.relations},
    )


def with_surroundings(source: DatasetSource, scenes: Sequence[ReportScene], width: int) -> list[ReportScene]:
    """Add the maps of the places and the images of the cameras, `width` pixels wide."""
    by_name = {each.scene.name: each.scene for each in scenes}
    around = source.surroundings(by_name)
    maps, images = around.maps(), around.images() if width else {}
    return [
        replace(each, map=maps.get(name), cameras=thumbnails(images.get(name, {}), width))
        for name, each in zip(by_name, scenes, strict=True)
    ]


def result_figures(found: Results, with_truth: bool) -> tuple[list[FigureTable], list[Chart]]:
    """Tables and charts of a result: of its errors beside ground truth, else of the tracks alone."""
    if with_truth:
        evaluation = found.evaluate()
        return list(evaluation.tables()), evaluation.charts()
    results = list(found.scenes.values())
    return [track_figures(results)], track_charts(results)


_HEIGHT = 720  # of the frame in a notebook, pixels


@dataclass(frozen=True)
class Page:
    """A page of results, one HTML text that needs no network: a notebook shows it, `write` makes a file of it."""

    title: str
    text: str

    def __repr__(self) -> str:
        """Title and size, and how to look at it."""
        return (
            f"{self.title}: a page of {len(self.text) / 1e6:.1f} MB; a notebook shows it, .write('page.html') saves it"
        )

    def _repr_html_(self) -> str:
        """The page in a frame of its own."""
        return f'<iframe srcdoc="{html.escape(self.text)}" width="100%" height="{_HEIGHT}"></iframe>'

    def write(self, path: str | Path) -> None:
        """Write the page, whole or not at all. Raises `InputError` for a name that does not end in .html."""
        if Path(path).suffix not in (".html", ".htm"):
            raise InputError(f"{path}: expected a file name that ends in .html")
        write_text(path, self.text)


def view(
    tracks: Table,
    detections: Table | None = None,
    truth: Table | None = None,
    how: TableImport | None = None,
    truth_how: TableImport | None = None,
) -> Page:
    """Return a page of a table of tracks: a player, figures and charts, as `saga-fg report file` makes it.

    detections, truth  tables to show beside the tracks; with `truth` the figures are of errors
    tracks, how, truth_how  as of `saga_fg.evaluate`, which also says what is warned of and raised
    """
    results = found_results(tracks, detections, truth, how, truth_how)
    config = load_config("file")
    scenes = [
        ReportScene(
            each.scene,
            {"tracks": each.found},
            {} if each.coasting is None else {"tracks": each.coasting},
            config.tracker.edges,
            config.sensors,
        )
        for each in results.values()
    ]
    tables, charts = result_figures(Results(results, partial(clear_figures, sweep=True)), truth is not None)
    boxes = sum(len(each.found) for each in results.values())
    title = f"{len(scenes)} scene{'s' if len(scenes) != 1 else ''}, {boxes} boxes"
    return Page(title, report_page(Report("Tracks", [title], scenes, tables, charts)))
