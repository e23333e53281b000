"""Reports: the data of the player, charts, the page, and the page in a browser."""

from __future__ import annotations

import base64
import html
import json
import re
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from data_tools.figures import FigureTable
from data_tools.metrics import SceneBoxes, label_errors
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.cli import app
from pipelines.config import load_config
from pipelines.report import (
    Report,
    RunRecord,
    accuracy_charts,
    latency_chart,
    read_run_record,
    report_page,
    scene_of_run,
)
from pipelines.report.figures import SHARES, unseen_for
from pipelines.report.page import record_path, write_run_record
from pipelines.report.scenes import edges_of_frames, scene_data
from pipelines.tracking import TrackedScene, track_scene
from saga_fg import Boxes, InputError

SHORT = SimulatorSettings(duration=4.0, warm_up=5.0)
CONFIG = load_config("simulated")


@pytest.fixture(scope="module")
def runs() -> dict[str, TrackedScene]:
    scene = SimulatedTraffic(SHORT, scenes=1, seed=1).scene("scene-0001")
    return {method: track_scene(scene, CONFIG.new_tracker(method)) for method in ("kf", "saga")}


def page_of(runs: dict[str, TrackedScene], **more: Any) -> str:
    return report_page(
        Report("A <title>", ["fact & fact"], [scene_of_run(runs, CONFIG.tracker.edges, CONFIG.sensors)], **more)
    )


def data_of(page: str) -> Any:
    packed = re.search(r'<script id="data" type="text/plain">(.*?)</script>', page)
    assert packed is not None
    return json.loads(zlib.decompress(base64.b64decode(packed[1])))


def test_rows_are_the_tracks_in_centimetres_about_the_start(runs):
    data = scene_data(scene_of_run(runs, CONFIG.tracker.edges, CONFIG.sensors))
    run = runs["saga"]
    origin = run.scene.world_T_ego[0, :2, 3]
    assert data["times"][0] == 0
    assert data["ego"][0][:2] == [0, 0]
    for k in (0, 10, -1):
        tracks, rows = run.tracks[k], data["methods"]["saga"]["moments"][k]
        assert [data["methods"]["saga"]["ids"][row[0]] for row in rows] == [str(id_) for id_ in tracks.id]
        assert [data["labels"][row[1]] for row in rows] == tracks.boxes.label.tolist()
        table = np.array(rows, dtype=float).reshape(len(rows), 14)
        np.testing.assert_allclose(table[:, 2:4] / 100, tracks.boxes.position[:, :2] - origin, atol=0.006)
        np.testing.assert_allclose(table[:, 6] / 1000, tracks.boxes.yaw, atol=0.001)
        np.testing.assert_allclose(table[:, 7:9] / 100, tracks.boxes.velocity, atol=0.006)
        np.testing.assert_allclose(table[:, 9] / 1000, tracks.score, atol=0.001)
        np.testing.assert_allclose(table[:, 10] / 1e4, tracks.position_covariance[:, 0, 0], atol=1e-4)
        np.testing.assert_allclose(table[:, 13] / 1000, tracks.coasting, atol=0.001)
    truth = run.scene.ground_truth
    assert truth is not None
    assert [row[6] for row in data["truth"][-1]] == truth[-1].visible.astype(int).tolist()
    taken = sum(frame.timestamp <= run.scene.timestamps[-1] + 1e-6 for frame in run.scene.frames)
    boxes = sum(len(frame) for frame in run.scene.frames[:taken])
    assert sum(map(len, data["detections"])) == boxes


def test_edges_lead_from_a_leader_to_its_follower():
    rule = CONFIG.tracker.edges[0]
    boxes = Boxes.of(["car"] * 3, [[0, 0, 0], [10, 0, 0], [0, 30, 0]], [[4, 2, 1.5]] * 3, [0.0] * 3, [[8, 0]] * 3)
    table = SceneBoxes(np.zeros(3, dtype=np.int64), np.array(["behind", "ahead", "aside"]), boxes, np.ones(3))
    ((target, source, rate),) = edges_of_frames(table, 1, (rule,))
    assert [(table.id[t], table.id[s]) for t, s in zip(target, source, strict=True)] == [("behind", "ahead")]
    assert rate[0] > 0


def test_what_is_not_known_is_null():
    boxes = Boxes.of(["car"], [[1, 2, 0]])
    table = SceneBoxes(np.zeros(1, dtype=np.int64), np.array(["a"]), boxes, np.ones(1))
    scene = SimulatedTraffic(SHORT, scenes=1, seed=1).scene("scene-0001")
    from pipelines.report import ReportScene

    row = scene_data(ReportScene(replace(scene, frames=()), {"x": table}, {}))["methods"]["x"]["moments"][0][0]
    assert row[4:6] == [100, 100]  # a metre square
    assert row[7:9] == [None, None]
    assert row[10:] == [None] * 4


def test_results_that_do_not_tell_when_they_coast_are_compared_with_the_detections():
    there = Boxes.of(["car", "car"], [[0, 0, 0], [9, 0, 0]])
    tables = [there, there, there.select([0]), there]
    frame, ids = np.repeat(np.arange(4), [2, 2, 1, 2]), np.array(["a", "b", "a", "b", "a", "a", "b"])
    table = SceneBoxes(frame, ids, Boxes.concatenate(tables), np.ones(7))
    seen = [Boxes.of(["car"], [[0.5, 0, 0]]), Boxes.of(["truck"], [[0, 0, 0]]), Boxes.empty(), there]
    assert unseen_for(table, np.arange(4) * 0.5, seen).tolist() == [0, 0, 0.5, 0.5, 1, 0, 0]


def test_the_page_holds_all_it_needs(runs):
    table = FigureTable("<Errors>", ("method", "RMSE"), (("<b>&", "1"),))
    page = page_of(runs, tables=[table], charts=[latency_chart(np.arange(100.0))], configuration="a: <1>", start=3)
    assert "<h1>A &lt;title&gt;</h1>" in page
    for text in ("fact & fact", "<Errors>", "<b>&", "a: <1>"):
        assert html.escape(text) in page
    assert "<!--" not in page
    assert not re.search(r"(src|href)\s*=|@import|url\(|fetch\(|https?://(?!www.w3.org/2000/svg)", page)
    data = data_of(page)
    assert [scene["name"] for scene in data["scenes"]] == ["scene-0001"]
    assert data["start"] == 3
    assert data["charts"][0]["bars"]


def test_charts_say_what_the_errors_are():
    rng = np.random.default_rng(0)
    n = 400
    moment = np.arange(n)
    truth_boxes = Boxes.of(["car"] * n, np.zeros((n, 3)), [[4, 2, 1.5]] * n, np.zeros(n), np.zeros((n, 2)))
    error = rng.normal(0, 0.3, (n, 2))
    found_boxes = Boxes.of(["car"] * n, np.column_stack([error, np.zeros(n)]), [[4, 2, 1.5]] * n, np.zeros(n), error)
    covariance = np.tile(0.09 * np.eye(2), (n, 1, 1))
    truth = SceneBoxes(moment, np.full(n, "a"), truth_boxes, np.zeros(n))
    found = SceneBoxes(moment, np.full(n, "t"), found_boxes, np.ones(n), covariance)
    position, velocity, heading, held = accuracy_charts(label_errors(truth, found, np.zeros((n, 2))))
    series = position.series[0]
    assert np.interp(0.5, series.y, series.x) == pytest.approx(np.median(np.hypot(*error.T)), abs=0.01)
    assert velocity.title.startswith("Velocity")
    assert max(heading.series[0].x) == 0
    right, mine = held.series
    assert right.faint
    assert tuple(mine.x) == SHARES
    np.testing.assert_allclose(mine.y, SHARES, atol=0.06)


def test_latencies_are_counted():
    chart = latency_chart(np.array([1.0] * 98 + [3.0, 500.0]))
    assert chart.title.startswith("Time in the tracker: median 1.0 ms")
    assert sum(chart.series[0].y) == 100
    assert len(chart.series[0].x) == len(chart.series[0].y) + 1


def test_a_record_is_read_back_and_a_broken_one_refused(tmp_path: Path):
    result = tmp_path / "tracks.json"
    assert read_run_record(result) is None
    record = RunRecord("saga", "tracker: {}", {"a": [1.5, 2.0]})
    write_run_record(result, record)
    assert read_run_record(result) == record
    assert record_path(tmp_path) == tmp_path / "run.json"
    record_path(result).write_text('{"method": 1}')
    with pytest.raises(InputError, match="expected the record of a run"):
        read_run_record(result)


def test_a_table_of_tracks_becomes_a_page(tmp_path: Path):
    detections, tracks, output = tmp_path / "d.csv", tmp_path / "t.csv", tmp_path / "page.html"
    rows = [f"{k / 10},car,{k * 0.8},0,0.9" for k in range(30)]
    detections.write_text("timestamp,label,x,y,score\n" + "\n".join(rows) + "\n")
    run = CliRunner().invoke
    assert run(app, ["track", "file", str(detections), "--output", str(tracks)]).exit_code == 0
    result = run(app, ["report", "file", str(tracks), "--detections", str(detections), "--output", str(output)])
    assert result.exit_code == 0, result.output
    page = output.read_text(encoding="utf-8")
    data = data_of(page)
    assert len(data["scenes"][0]["times"]) == 30
    assert list(data["scenes"][0]["methods"]) == ["saga"]
    assert data["charts"][-1]["title"].startswith("Time in the tracker")
    assert "acceleration_noise" in page  # the configuration
    alone = run(app, ["report", "file", str(tracks), "--output", str(tmp_path / "alone.html")])
    assert alone.exit_code == 0, alone.output
    same = run(app, ["report", "file", str(tracks), "--output", str(tracks)])
    assert same.exit_code == 2
    no_page = run(app, ["report", "file", str(tracks), "--output", str(tmp_path / "page.pdf")])
    assert no_page.exit_code == 2
    assert "page.pdf: expected a file name that ends in .html" in no_page.stderr
    assert not (tmp_path / "page.pdf").exists()
    other = tmp_path / "other.csv"
    other.write_text("timestamp,label,x,y,scene\n100,car,0,0,d\n")
    wrong = run(app, ["report", "file", str(tracks), "--detections", str(other), "--output", str(output)])
    assert wrong.exit_code == 2
    assert "expected the times of the detections" in wrong.stderr
