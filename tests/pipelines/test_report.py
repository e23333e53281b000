"""The report of a run. Reports: the data of the player, charts, the page, and the page in a browser."""

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

from data_tools.datasets.results import SceneResult
from data_tools.evaluation import SHARES, accuracy_charts
from data_tools.figures import FigureTable
from data_tools.metrics import SceneBoxes, label_errors
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.config import load_config
from pipelines.report import (
    Report,
    ReportScene,
    RunRecord,
    latency_chart,
    read_run_record,
    report_page,
    scene_of_run,
)
from pipelines.report.figures import COLUMNS, track_charts, track_figures, unseen_for
from pipelines.report.page import record_path, write_run_record
from pipelines.report.scenes import edges_of_frames, relation_names, scene_data
from pipelines.tracking import TrackedScene, track_scene
from saga_fg import Boxes, Frame, InputError, Scene
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.types.frame import Detections
from saga_fg.types.road_map import Lane, RoadMap, StopLine, TrafficLight
from tests.pipelines.command import done, refused
from tests.pipelines.page_in_browser import tried_in_browser

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
    assert [row[6] for row in data["truth"][-1]] == truth[-1].visible.astype(int).tolist()
    taken = sum(frame.timestamp <= run.scene.timestamps[-1] + 1e-6 for frame in run.scene.frames)
    boxes = sum(len(frame) for frame in run.scene.frames[:taken])
    assert sum(map(len, data["detections"])) == boxes


def test_edges_lead_from_a_leader_to_its_follower():
    rule = CONFIG.tracker.edges[0]
    boxes = Boxes.of(["car"] * 3, [[0, 0, 0], [10, 0, 0], [0, 30, 0]], [[4, 2, 1.5]] * 3, [0.0] * 3, [[8, 0]] * 3)
    table = SceneBoxes(np.zeros(3, dtype=np.int64), np.array(["behind", "ahead", "aside"]), boxes, np.ones(3))
    ((target, source, rate, number),) = edges_of_frames(table, 1, (rule,))
    assert [(table.id[t], table.id[s]) for t, s in zip(target, source, strict=True)] == [("behind", "ahead")]
    assert rate[0] > 0
    assert number.tolist() == [0]
    assert relation_names((rule,)) == ["follows"]


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
    charts = accuracy_charts(label_errors(truth, found, np.zeros((n, 2))))
    position, velocity, heading, held = charts
    series = position.series[0]
    assert np.interp(0.5, series.y, series.x) == pytest.approx(np.median(np.hypot(*error.T)), abs=0.01)
    assert velocity.title.startswith("Velocity")
    assert max(heading.series[0].x) == 0
    right, mine = held.series
    assert right.faint
    assert tuple(mine.x) == SHARES
    np.testing.assert_allclose(mine.y, SHARES, atol=0.06)


def test_a_record_is_read_back_and_a_broken_one_refused(tmp_path):
    result = tmp_path / "tracks.json"
    assert read_run_record(result) is None
    record = RunRecord("saga", "tracker: {}", {"a": [1.5, 2.0]})
    write_run_record(result, record)
    assert read_run_record(result) == record
    assert record_path(tmp_path) == tmp_path / "run.json"
    record_path(result).write_text('{"method": 1}')
    with pytest.raises(InputError, match="expected the record of a run"):
        read_run_record(result)


def test_a_table_of_tracks_becomes_a_page(tmp_path):
    detections, tracks, output = tmp_path / "d.csv", tmp_path / "t.csv", tmp_path / "page.html"
    rows = [f"{k / 10},car,{k * 0.8},0,0.9" for k in range(30)]
    detections.write_text("timestamp,label,x,y,score\n" + "\n".join(rows) + "\n")
    done("track", "file", detections, "--output", tracks)
    done("report", "file", tracks, "--detections", detections, "--output", output)
    page = output.read_text(encoding="utf-8")
    data = data_of(page)
    assert len(data["scenes"][0]["times"]) == 30
    assert list(data["scenes"][0]["methods"]) == ["saga"]
    assert data["charts"][-1]["title"].startswith("Time in the tracker")
    assert "acceleration_noise" in page  # the configuration
    done("report", "file", tracks, "--output", tmp_path / "alone.html")
    refused("report", "file", tracks, "--output", tracks)
    said = refused("report", "file", tracks, "--output", tmp_path / "page.pdf")
    assert "page.pdf: expected a file name that ends in .html" in said
    assert not (tmp_path / "page.pdf").exists()
    other = tmp_path / "other.csv"
    other.write_text("timestamp,label,x,y,scene\n100,car,0,0,d\n")
    said = refused("report", "file", tracks, "--detections", other, "--output", output)
    assert "expected the times of the detections" in said


# Reports of results on disk: title and figures without ground truth, and two results beside one another


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rows = [f"{k / 10},car,{k * 0.8},{4 * n},0.9" for k in range(30) for n in range(2)]
    (tmp_path / "d.csv").write_text("timestamp,label,x,y,score\n" + "\n".join(rows) + "\n")
    for method in ("saga", "kf"):
        done("track", "file", tmp_path / "d.csv", "--method", method, "--output", tmp_path / f"{method}.csv")
    return tmp_path


def report(folder: Path, *more: object) -> str:
    """The page."""
    options = ("--detections", folder / "d.csv", "--output", folder / "page.html")
    done("report", "file", folder / "saga.csv", *options, *more)
    return (folder / "page.html").read_text(encoding="utf-8")


def test_the_title_says_method_and_data_and_the_figures_what_is_known(folder):
    page = report(folder)
    assert "<h1>saga on d.csv</h1>" in page
    for fact in ("saga.csv", "d", "30 moments", "58 boxes"):
        assert f"<li>{fact}</li>" in page
    assert "<th>tracks</th>" in page
    titles = [chart["title"] for chart in data_of(page)["charts"]]
    assert titles[0] == "Tracks at a time"
    assert titles[-1].startswith("Time in the tracker")


def test_two_results_stand_side_by_side(folder):
    page = report(folder, "--beside", folder / "kf.csv")
    assert "<h1>saga and kf on d.csv</h1>" in page
    data = data_of(page)
    assert list(data["scenes"][0]["methods"]) == ["kf", "saga"]  # the result itself is the last, which is chosen
    assert data["beside"] == "kf"
    assert {"saga: Tracks at a time", "kf: Tracks at a time"} <= {chart["title"] for chart in data["charts"]}


def test_right_of_way_is_shown_of_both_results(folder):
    for method, p in (("saga", 0.75), ("kf", 0.85)):
        event = {"event": "relations", "scene": "d", "time": 1.0, "relations": [[1, 2, "yields to", p]]}
        (folder / f"{method}.csv.journal.jsonl").write_text(json.dumps(event))
    methods = data_of(report(folder, "--beside", folder / "kf.csv"))["scenes"][0]["methods"]
    for method, share in (("saga", 750), ("kf", 850)):
        relation = methods[method]["relations"].index("yields to")
        found = [row for moment in methods[method]["edges"] for row in moment if row[3] == relation]
        assert found == [[0, 1, share, relation]]


def test_results_of_one_method_are_told_apart_by_their_files(folder):
    (folder / "other").mkdir()
    for name in ("saga.csv", "saga.run.json"):
        (folder / "other" / name).write_bytes((folder / name).read_bytes())
        (folder / name.replace("saga", "again")).write_bytes((folder / name).read_bytes())
    assert "<h1>saga and again on" in report(folder, "--beside", folder / "again.csv")
    assert "and other/saga on d.csv" in report(folder, "--beside", folder / "other" / "saga.csv")


def test_results_that_do_not_belong_together_are_refused(folder):
    text = (folder / "kf.csv").read_text().splitlines()
    (folder / "short.csv").write_text("\n".join(text[:20]) + "\n")
    said = refused(
        "report", "file", folder / "saga.csv", "--beside", folder / "short.csv", "--output", folder / "p.html"
    )  # without detections, moments are those of the tracks
    assert "expected the moments of the other result" in said or "expected a scene" in said


def test_figures_without_ground_truth():
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


# The road in the page's player: what it is told, and what it draws

ORIGIN = (100.0, 50.0)
LIGHT = TrafficLight("north", (130.0, 50.0))
MAP = RoadMap(
    (LIGHT,),
    (StopLine("line", (120.0, 51.75), (120.0, 48.25), "north"),),
    (Lane("lane", ((90.0, 50.0), (120.0, 50.0), (150.0, 52.0)), 3.5),),
)
LATER = RoadMap((TrafficLight("south", (100.0, 90.0)), TrafficLight("north", (0.0, 0.0))))
RED, GREEN, CAR = "traffic_light_red", "traffic_light_green", "car"


def frame(time: float, *seen: tuple[str, float, float], road_map: RoadMap | None = None) -> Frame:
    """Detections in the coordinates of the vehicle, which is stationary at the origin of the scene."""
    boxes = Boxes.of([label for label, _, _ in seen], [[x, y, 0.0] for _, x, y in seen])
    pose = yaw_transform(*ORIGIN)
    return Frame(time, "camera", Detections(boxes, np.ones(len(seen))), pose, "ego", road_map=road_map)


def road_report(*frames: Frame) -> ReportScene:
    """A scene of five moments, each second, without tracks."""
    scene = Scene("s", np.arange(5.0), np.tile(yaw_transform(*ORIGIN), (5, 1, 1)), ("",) * 5, frames)
    none = SceneBoxes(np.empty(0, dtype=np.int64), np.empty(0, dtype="<U1"), Boxes.of([], []), np.empty(0))
    return ReportScene(scene, {"saga": none}, {})


SEEN = road_report(
    frame(0.0, (CAR, 30.0, 0.0), road_map=MAP),
    frame(1.5, (GREEN, 30.5, 1.0), (RED, 30.0, 4.5), road_map=MAP),
    frame(2.5, (GREEN, 30.0, 0.0)),
    frame(2.7, (RED, 29.0, 0.0), (CAR, 30.0, 0.0), road_map=LATER),
    frame(4.0),
)


def test_a_road_is_told_about_the_start_with_the_colours_last_reported():
    assert scene_data(road_report(frame(0.0, (RED, 1.0, 1.0))))["road"] is None
    road = scene_data(SEEN)["road"]
    assert road["lanes"] == [[350, -1000, 0, 2000, 0, 5000, 200]]
    assert road["lines"] == [[0, 2000, 175, 2000, -175]]
    assert road["lights"] == [[3000, 0], [0, 4000]]  # what the later map says of "north" is not news
    json.dumps(road)
    alone = RoadMap(stop_lines=(StopLine("sign", (120.0, 51.75), (120.0, 48.25)),))
    assert scene_data(road_report(frame(0.0, road_map=alone)))["road"]["lines"] == [[-1, 2000, 175, 2000, -175]]
    green, red = 2, 0
    assert scene_data(SEEN)["road"]["colours"] == [[None, None], [None, None], [green, None], [red, None], [red, None]]


TRY = """
  const view = document.getElementById("view"), time = document.getElementById("time");
  const scene = document.getElementById("scene"), toggle = document.getElementById("show-road");
  const count = (r, g, b) => {
    const data = view.getContext("2d").getImageData(0, 0, view.width, view.height).data;
    let n = 0;
    for (let i = 0; i < data.length; i += 4) if (data[i] === r && data[i + 1] === g && data[i + 2] === b) n++;
    return n;
  };
  const drawn = () => ({red: count(224, 32, 44), green: count(24, 160, 74), band: count(228, 233, 238)});
  const at = k => { time.value = k; time.oninput(); return drawn(); };
  found.toggles = [toggle.parentElement.checkVisibility()];
  scene.selectedIndex = 1; scene.onchange();
  found.toggles.push(toggle.parentElement.checkVisibility());
  found.moments = [0, 2, 4].map(at);
  toggle.click();
  found.off = drawn();
"""


def test_the_browser_draws_the_road_where_there_is_one(tmp_path):
    page = report_page(Report("road", [], [road_report(frame(0.0)), SEEN]))
    found = tried_in_browser(page, TRY, tmp_path)
    assert found["faults"] == []
    assert found["toggles"] == [False, True]
    nothing, green, red = found["moments"]
    assert nothing["red"] == nothing["green"] == 0
    assert green["green"] > 50
    assert green["red"] == 0
    assert red["red"] > 50
    assert red["green"] == 0
    assert all(moment["band"] > 5000 for moment in found["moments"])
    assert set(found["off"].values()) == {0}
