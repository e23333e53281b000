"""Tables of tracks of programs, of pandas, Polars or Arrow, as a page with a player, in a notebook or a file."""

import html
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from data_tools.datasets.data_frames import found_results
from data_tools.datasets.results import Results, clear_figures
from data_tools.files import write_text
from pipelines.config import load_config
from pipelines.report.page import Report, report_page, result_figures
from pipelines.report.scenes import ReportScene
from saga_fg.errors import InputError
from saga_fg.tables import Table, TableImport

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
