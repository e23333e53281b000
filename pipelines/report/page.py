"""The page: one HTML file with style, script and data in it.

The data is JSON, deflated, in base64; the browser inflates it.
"""

from __future__ import annotations

import base64
import html
import json
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from typing import Any

from data_tools.figures import FigureTable, as_json
from pipelines.report.charts import Chart
from pipelines.report.scenes import ReportScene, scene_data
from pipelines.report.thresholds import start_thresholds
from pipelines.report.track_figures import UNSEEN

SCRIPTS = ("charts.js", "road.js", "fans.js", "layers.js", "filters.js", "panel.js", "player.js")


@dataclass(frozen=True, eq=False)
class Report:
    """Content of a page; `facts` are lines under the title, `notes` paragraphs above the player.

    start   moment of the first scene that the player shows first; None: the one with the most tracks
    ghosts  whether it shows tracks that nobody sees now from the start
    beside  the method that it shows beside the last one from the start, "" for none
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


def report_page(report: Report) -> str:
    """Return the HTML text."""
    data = {
        "scenes": [scene_data(scene) for scene in report.scenes],
        "charts": [asdict(chart) for chart in report.charts],
        "start": report.start,
        "ghosts": report.ghosts,
        "beside": report.beside,
        "unseen": round(1000 * UNSEEN),
        "thresholds": start_thresholds(report.scenes),
    }
    configuration = f"<pre>{html.escape(report.configuration)}</pre>" if report.configuration else ""
    page = _part("page.html")
    for mark, text in (
        ("TITLE", html.escape(report.title)),
        ("FACTS", "".join(f"<li>{html.escape(fact)}</li>" for fact in report.facts)),
        ("NOTES", "".join(f"<p>{html.escape(note)}</p>" for note in report.notes)),
        ("TABLES", "".join(map(_table, report.tables))),
        ("CONFIGURATION", configuration),
        ("STYLE", _part("page.css")),
        ("DATA", _packed(data)),
        ("SCRIPT", "".join(map(_part, SCRIPTS))),
    ):
        page = page.replace(f"<!--{mark}-->", text)
    return page


def _part(name: str) -> str:
    return (files("pipelines.report") / name).read_text(encoding="utf-8")


def _packed(data: Any) -> str:
    text = json.dumps(as_json(data), separators=(",", ":"), allow_nan=False)
    return base64.b64encode(zlib.compress(text.encode(), 9)).decode("ascii")


def _table(table: FigureTable) -> str:
    head = "".join(f"<th>{html.escape(column)}</th>" for column in table.columns)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in table.rows)
    return (
        f"<figure class=table><figcaption>{html.escape(table.title)}</figcaption><div class=wide><table>"
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div></figure>"
    )
