"""Reports of results on disk: title and figures without ground truth, and two results beside one another."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from data_tools.datasets.results import SceneResult
from data_tools.metrics import SceneBoxes
from pipelines.cli import app
from pipelines.report.figures import COLUMNS, track_charts, track_figures
from saga_fg import Boxes, Scene
from tests.pipelines.page_in_browser import tried_in_browser
from tests.pipelines.test_report import data_of


def run(*arguments: object):
    return CliRunner().invoke(app, [str(each) for each in arguments])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rows = [f"{k / 10},car,{k * 0.8},{4 * n},0.9" for k in range(30) for n in range(2)]
    (tmp_path / "d.csv").write_text("timestamp,label,x,y,score\n" + "\n".join(rows) + "\n")
    for method in ("saga", "kf"):
        done = run("track", "file", tmp_path / "d.csv", "--method", method, "--output", tmp_path / f"{method}.csv")
        assert done.exit_code == 0, done.output
    return tmp_path


def report(folder: Path, *more: object):
    options = ("--detections", folder / "d.csv", "--output", folder / "page.html")
    return run("report", "file", folder / "saga.csv", *options, *more)


def test_the_title_says_method_and_data_and_the_figures_what_is_known(folder: Path) -> None:
    done = report(folder)
    assert done.exit_code == 0, done.output
    page = (folder / "page.html").read_text(encoding="utf-8")
    assert "<h1>saga on d.csv</h1>" in page
    for fact in ("saga.csv", "d", "30 moments", "58 boxes"):
        assert f"<li>{fact}</li>" in page
    assert "<th>tracks</th>" in page
    titles = [chart["title"] for chart in data_of(page)["charts"]]
    assert titles[0] == "Tracks at a time"
    assert titles[-1].startswith("Time in the tracker")


def test_tracks_of_own_data_are_drawn_when_the_page_opens(folder: Path, tmp_path: Path) -> None:
    assert report(folder).exit_code == 0
    page = (folder / "page.html").read_text(encoding="utf-8")
    found = tried_in_browser(page, 'found.tracks = document.getElementById("view").dataset.tracks;', tmp_path)
    assert found == {"faults": [], "tracks": "2"}


def test_two_results_stand_side_by_side(folder: Path) -> None:
    done = report(folder, "--beside", folder / "kf.csv")
    assert done.exit_code == 0, done.output
    page = (folder / "page.html").read_text(encoding="utf-8")
    assert "<h1>saga and kf on d.csv</h1>" in page
    data = data_of(page)
    assert list(data["scenes"][0]["methods"]) == ["kf", "saga"]  # the result itself is the last, which is chosen
    assert data["beside"] == "kf"
    assert {"saga: Tracks at a time", "kf: Tracks at a time"} <= {chart["title"] for chart in data["charts"]}


def test_results_of_one_method_are_told_apart_by_their_files(folder: Path) -> None:
    (folder / "other").mkdir()
    for name in ("saga.csv", "saga.run.json"):
        (folder / "other" / name).write_bytes((folder / name).read_bytes())
        (folder / name.replace("saga", "again")).write_bytes((folder / name).read_bytes())
    assert report(folder, "--beside", folder / "again.csv").exit_code == 0
    assert "<h1>saga and again on" in (folder / "page.html").read_text(encoding="utf-8")
    assert report(folder, "--beside", folder / "other" / "saga.csv").exit_code == 0
    assert "and other/saga on d.csv" in (folder / "page.html").read_text(encoding="utf-8")


def test_results_that_do_not_belong_together_are_refused(folder: Path) -> None:
    text = (folder / "kf.csv").read_text().splitlines()
    (folder / "short.csv").write_text("\n".join(text[:20]) + "\n")
    alone = run("report", "file", folder / "saga.csv", "--beside", folder / "short.csv", "--output", folder / "p.html")
    assert alone.exit_code == 2  # without detections, moments are those of the tracks
    assert "expected the moments of the other result" in alone.stderr or "expected a scene" in alone.stderr
    same = report(folder, "--beside", folder / "page.html")
    assert same.exit_code == 2


def test_figures_without_ground_truth() -> None:
    """A car that is lost from view once, and a walker of two moments."""
    ids = ["car"] * 6 + ["walker"] * 2
    frame = np.array([0, 1, 2, 3, 4, 5, 2, 3])
    order = np.argsort(frame, kind="stable")
    label = ["car"] * 6 + ["pedestrian"] * 2
    boxes = Boxes.of(label, np.zeros((8, 3)), velocity=[[3, 4]] * 6 + [[1, 0]] * 2).select(order)
    table = SceneBoxes(frame[order], np.array(ids)[order], boxes, np.full(8, 0.5), np.tile(0.04 * np.eye(2), (8, 1, 1)))
    coasting = np.array([0, 0, 0.5, 1.0, 0, 0, 0, 0])[order]
    scene = Scene("s", np.arange(6) * 0.5, np.tile(np.eye(4), (6, 1, 1)), ("",) * 6, ())
    rows = {
        row[0]: dict(zip(COLUMNS, row, strict=True))
        for row in track_figures([SceneResult(scene, table, coasting=coasting)]).rows
    }
    assert list(rows) == ["all", "car", "pedestrian"]
    car, walker = rows["car"], rows["pedestrian"]
    assert (car["tracks"], car["short"], car["boxes"], car["gaps"]) == ("1", "0", "6", "1")
    assert [float(car[name]) for name in ("life, s", "speed, m/s", "position ±, m", "unseen")] == pytest.approx(
        [2.5, 5.0, 0.2, 1 / 3], abs=0.001
    )
    assert (walker["short"], walker["gaps"]) == ("1", "0")
    counts = track_charts([SceneResult(scene, table)])[0]
    assert list(counts.series[0].y) == [1, 1, 2, 2, 1, 1]
    nothing = table.select([])
    assert track_figures([SceneResult(scene, nothing)]).rows == ()
