"""`saga-fg explain` and `saga-fg predict`."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.detection_files import (
    PREDICTION_COLUMNS,
    prediction_writer,
    predictions_path,
    read_predictions,
)
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.config import load_config
from pipelines.explaining import journal_of, read_relations, read_track, story
from pipelines.report import Report, report_page, scene_of_run
from pipelines.report.scenes import relations_data, scene_data
from pipelines.serving.messages import tracks_message
from pipelines.tracking import TrackedScene, track_scene
from saga_fg import Boxes, Detections, Frame, InputError, Scene, Tracker, Tracks
from saga_fg.tracking.table_tracking import dense_traffic_settings
from saga_fg.types import RELATIONS, Relations
from tests.pipelines.command import done, refused, saga_fg
from tests.pipelines.page_in_browser import tried_in_browser


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two cars in two scenes; the second one of scene b hides after a second, for longer than tracks are remembered."""
    folder = tmp_path_factory.mktemp("explain")
    lines = ["scene,timestamp,label,x,y,score"]
    for scene in "ab":
        for k in range(80):
            lines.append(f"{scene},{k / 10},car,{k / 2},0.0,0.9")
            if scene == "a" or k < 10:
                lines.append(f"{scene},{k / 10},car,{k / 2 - 8},0.0,0.9")
    (folder / "detections.csv").write_text("\n".join(lines) + "\n")
    done("track", "file", folder / "detections.csv", "-o", folder / "tracks.csv", "--explain")
    return folder


def test_the_life_of_a_track_is_told_from_initiation_to_end(folder, tmp_path):
    file = tmp_path / "events.json"
    result = done("explain", folder / "tracks.csv", "--track", "b-2", "--json", file)
    first, *lines = result.stdout.splitlines()
    assert first.startswith("track 2 of b, car: ")
    assert "initiated by detection" in lines[0]
    assert any("kept: detection 1" in line for line in lines)
    assert any("missed, not detected for" in line for line in lines)
    assert "deleted: " in lines[-1]
    events = json.loads(file.read_text())
    assert [event["event"] for event in events][:2] == ["initiated", "matched"]
    assert events[-1]["event"] == "deleted"
    assert {event["scene"] for event in events} == {"b"}


def test_a_track_that_lives_to_the_end(folder):
    result = done("explain", folder / "tracks.csv", "--track", "1", "--scene", "a")
    assert "then the recording ends" in result.stdout.splitlines()[0]


def test_tracks_and_graphs_that_are_not_there(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for arguments, expected in [
        (("--track", "1"), "expected --scene, the track is in a, b"),
        (("--track", "99"), "expected events of track 99, there are none"),
        (("--track", "car"), "expected the number of a track"),
    ]:
        assert expected in refused("explain", folder / "tracks.csv", *arguments)
        assert not list(tmp_path.iterdir())


def test_journals_that_are_not_there_or_broken(tmp_path):
    assert "track with --explain" in refused("explain", tmp_path / "tracks.json", "--track", "1")
    for content, expected in (
        ("{\n", "line 1: broken or truncated JSON"),
        ("3\n", "line 1: expected an event"),
        ('{"event": "relations"}\n', "line 1: expected a time, and relations"),
        ('{"event": "relations", "time": 1.0, "relations": [[1, 2]]}\n', "line 1: expected a time, and relations"),
        ('{"event": "relations", "time": 1, "relations": [[1, 2, 3, 1]]}\n', "line 1: expected a time, and relations"),
    ):
        (tmp_path / "tracks.json.journal.jsonl").write_text(content)
        assert expected in refused("explain", tmp_path / "tracks.json", "--track", "1")


def test_an_event_that_nobody_wrote(folder, tmp_path):
    for change in [{"time": "noon"}, {"time": None}, {"event": "eaten"}, {"sensor": {}}, {"label": 1}]:
        lines = (folder / "tracks.csv.journal.jsonl").read_text().splitlines()
        events = [json.loads(line) for line in lines]
        changed = next(event for event in events if event.get("track") == 1)
        changed.update(change)
        if "label" in change:
            del changed["label"]
        (tmp_path / "t.csv.journal.jsonl").write_text("\n".join(map(json.dumps, events)))
        result = saga_fg("explain", tmp_path / "t.csv", "--track", "1", "--scene", changed["scene"])
        assert result.exit_code == 2
        assert result.stderr.startswith(
            f"error: {tmp_path / 't.csv.journal.jsonl'}: expected events as --explain writes"
        )
        assert result.stdout == ""


YIELDS, TAKES = RELATIONS


def test_right_of_way_is_told_in_answers_stories_and_pages(tmp_path):
    tracks = replace(Tracks.empty(3.0), relations=Relations.of_rows([(1, 2, YIELDS, 0.75)]))
    told = {"source": 1, "target": 2, "relation": "yields to", "probability": 0.75}
    assert tracks_message(tracks)["relations"] == [told]
    assert "relations" not in tracks_message(Tracks.empty(3.0))
    journal = journal_of(tmp_path / "t.csv")
    about = {"scene": "a", "sensor": "lidar", "track": 1, "label": "car"}
    initiated = about | {"event": "initiated", "time": 0.0, "detection": 0, "probability": 0.9}
    initiated |= {"least_probability": 0.1, "nearest_tracks": [], "gate": 9.0}
    told = {"scene": "a", "event": "relations", "sensor": "lidar"}
    moments = ([[1, 2, YIELDS, 0.75]], [[1, 2, YIELDS, 0.8], [1, 2, TAKES, 0.9]], [])
    events = [initiated, *(told | {"time": 0.1 * k, "relations": rows} for k, rows in enumerate(moments, 1))]
    journal.write_text("\n".join(map(json.dumps, events)))
    lines = story(read_track(journal, "1", None)[0])
    assert [line.split("lidar")[1].strip() for line in lines if "track 2" in line] == [
        "yields to track 2, probability 0.75",
        "takes the right of way of track 2, probability 0.90",
    ]
    assert read_relations(journal)["a"][0.1] == [[1, 2, YIELDS, 0.75]]
    others = {0.5: [[1, 9, YIELDS, 0.7], [2, 1, TAKES, 0.6], [1, 2, "admires", 0.6]]}
    shown = relations_data(read_relations(journal)["a"] | others, ["1", "2"], np.array([0.1, 0.5]), 3)
    assert shown == [[[0, 1, 750, 3]], [[1, 0, 600, 4]]]  # nobody has the number 9


def test_what_keeps_no_journal(folder, tmp_path):
    for option, expected in [(("--method", "centerpoint"), "keeps no journal"), (("--workers", "1"), "goes without")]:
        arguments = (folder / "detections.csv", "-o", tmp_path / "out.csv", "--explain")
        assert expected in refused("track", "file", *arguments, *option)


# Predictions kept with a run: the table, the fans of the page, and the page in a browser

HORIZONS = np.array([0.5, 2.0])
CONFIG = load_config("simulated")


@pytest.fixture(scope="module")
def run() -> TrackedScene:
    scene = SimulatedTraffic(SimulatorSettings(duration=2.0, warm_up=5.0), scenes=1, seed=1).scene("scene-0001")
    return track_scene(scene, CONFIG.new_tracker("saga"), horizons=HORIZONS)


@pytest.fixture(scope="module")
def detections(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    for name, speed in (("a", 8.0), ("b", 3.0)):
        rows = [f"{k / 10},car,{k * speed / 10},0,0.9" for k in range(10)]
        (folder / f"{name}.csv").write_text("timestamp,label,x,y,score\n" + "\n".join(rows) + "\n")
    return folder


def test_every_moment_has_its_predictions_and_the_tracks_are_the_same(run):
    assert [each.timestamp for each in run.predictions] == run.scene.timestamps.tolist()
    for predicted, tracks in zip(run.predictions, run.tracks, strict=True):
        assert predicted.horizons.tolist() == HORIZONS.tolist()
        assert set(predicted.id.tolist()) <= set(tracks.id.tolist())
    plain = track_scene(run.scene, CONFIG.new_tracker("saga"))
    assert plain.predictions == ()
    for mine, its in zip(run.tracks, plain.tracks, strict=True):
        np.testing.assert_array_equal(mine.boxes.position, its.boxes.position)


def test_a_moment_after_the_newest_frame_is_predicted_from(run):
    scene = run.scene
    later = track_scene(scene, CONFIG.new_tracker("saga"), horizons=np.array([0.1]))
    tracker = CONFIG.new_tracker("saga")
    for frame in scene.frames:
        if frame.timestamp <= scene.timestamps[-1]:
            newest = tracker.step(frame).timestamp
    since = scene.timestamps[-1] + 0.1 - newest
    np.testing.assert_allclose(later.predictions[-1].position, tracker.predict([since]).position)


def test_methods_and_tables_without_predictions_are_refused(run, tmp_path):
    with pytest.raises(InputError, match="expected a method that predicts"):
        track_scene(run.scene, CONFIG.new_tracker("centerpoint"), horizons=HORIZONS)
    for row, why in [
        ("0,,1,1,1", "horizon: expected a number, got none"),
        ("0,1,1,x,1", "x: expected a number, got 'x'"),
        ("0,1,-1e300,1,1", "id: expected a whole number"),
        ("0,1,1.5,1,1", "id: expected a whole number"),
    ]:
        predictions_path(tmp_path / "t.csv").write_text(f"timestamp,horizon,id,x,y\n{row}\n")
        with pytest.raises(InputError, match=why):
            read_predictions(tmp_path / "t.csv")


def test_the_table_is_read_back_as_it_was_made(detections, tmp_path):
    tracks = tmp_path / "t.csv"
    done("track", "file", detections / "a.csv", "--output", tracks, "--predict", "0.5,2")
    table = predictions_path(tracks)
    assert table.read_text().splitlines()[0] == ",".join(PREDICTION_COLUMNS)
    (rows,) = read_predictions(tracks).values()
    assert set(rows.horizon.tolist()) == {0.5, 2.0}
    last = rows.select((rows.timestamp > 0.85) & (rows.horizon == 2.0))
    assert last.position[0] == pytest.approx([0.9 * 8 + 16, 0.0], abs=1.5)
    assert (np.linalg.eigvalsh(rows.covariance) > -1e-3).all()
    assert saga_fg("track", "file", detections / "a.csv", "--output", tracks).exit_code == 0
    assert not table.exists()  # of another run
    assert read_predictions(tracks) == {}


def test_hidden_tracks_alone_are_kept_with_their_modes(tmp_path):
    """A car whose leader is seen is hidden from 4 s on: it follows, or it goes on or stands."""
    frames, path = [], tmp_path / "t.csv"
    for k in range(50):
        places = [(1.0 * k + 20.0 - 0.01 * max(k - 30, 0) ** 2, 0.0, 0.8), (1.0 * k, 0.0, 0.8)][: 2 if k < 40 else 1]
        boxes = Boxes.of(["car"] * len(places), places, [[4.5, 1.8, 1.6]] * len(places), [0.0] * len(places))
        frames.append(Frame(0.1 * k, "lidar", Detections(boxes, np.full(len(places), 0.9))))
    times = np.array([frame.timestamp for frame in frames])
    scene = Scene("a", times, np.tile(np.eye(4), (len(times), 1, 1)), ("",) * len(times), tuple(frames))
    settings = replace(dense_traffic_settings(), edge_prior=0.5)
    run = track_scene(scene, Tracker(settings), horizons=HORIZONS)
    with prediction_writer(predictions_path(path)) as write:
        write("a", run.predictions)
    (rows,) = read_predictions(path).values()
    named = rows.select(np.flatnonzero(rows.mode != ""))
    (hidden,) = run.tracks[-1].id[run.tracks[-1].coasting > 0.5].astype(str)
    assert set(named.id.tolist()) == {hidden}
    assert named.timestamp.min() > 4.0
    assert {"follows", "goes on"} <= set(named.mode.tolist())
    assert named.probability.min() >= 0.05
    shown = scene_data(scene_of_run({"saga": run}, (), {}))["methods"]["saga"]
    assert shown["modes"][0] == ""
    last = [row for row in shown["predictions"][-1] if row[7]]
    assert [shown["modes"][row[7]] for row in last if row[1] == 2000] == sorted(set(named.mode[named.timestamp > 4.85]))


def test_parallel_runs_keep_a_table_for_each_part(detections, tmp_path):
    pattern, run = detections / "*.csv", ("track", "file", "--workers", "1", "--output", tmp_path / "run")
    done(*run, pattern, "--predict", "1")
    part = tmp_path / "run" / "tracks" / "a.csv"
    assert list(read_predictions(part)) == ["a"]
    assert sorted(read_predictions(tmp_path / "run" / "tracks")) == ["a", "b"]
    other = saga_fg(*run, pattern, "--predict", "2")
    assert "2 done, 0 unchanged" in other.output
    assert set(read_predictions(part)["a"].horizon.tolist()) == {2.0}


def test_other_horizons_are_refused(detections, tmp_path):
    for given, why in [
        (["--predict", "1,x"], "--predict: expected seconds with commas between them, got '1,x'"),
        (["--predict", "2,1"], "--predict: horizons: expected increasing seconds from 0 to 60"),
        (["--predict", "1", "--method", "centerpoint"], "--predict: expected --method saga or kf"),
    ]:
        assert why in refused("track", "file", detections / "a.csv", "--output", tmp_path / "t.csv", *given)
        assert not (tmp_path / "t.csv").exists()


def test_rows_are_the_predictions_in_centimetres_about_the_start(run):
    data = scene_data(scene_of_run({"saga": run}, (), CONFIG.sensors))["methods"]["saga"]
    assert data["horizons"] == [500, 2000]
    assert len(data["predictions"]) == len(run.scene)
    predicted = run.predictions[-1]
    table = np.array(data["predictions"][-1], dtype=float)
    assert len(table) == len(HORIZONS) * len(predicted)
    at = table[table[:, 1] == 2000]
    assert [data["ids"][int(k)] for k in at[:, 0]] == sorted(predicted.id.astype(str).tolist())
    order = np.argsort(predicted.id.astype(str))
    origin = run.scene.world_T_ego[0, :2, 3]
    np.testing.assert_allclose(at[:, 2:4] / 100, (predicted.position[1] - origin)[order], atol=0.006)
    np.testing.assert_allclose(at[:, 4] / 1e4, predicted.position_covariance[1, order, 0, 0], atol=1e-4)


TRY = """
  const view = document.getElementById("view"), time = document.getElementById("time");
  time.value = 15; time.oninput();
  const pictures = [view.toDataURL()];
  const press = id => { document.getElementById(id).click(); pictures.push(view.toDataURL()); };
  press("show-confirmed"); pictures.shift();
  press("horizon-2000"); press("horizon-500"); press("show-fans");
  found.pictures = pictures.map(one => pictures.indexOf(one));
  found.switches = document.getElementById("horizons").textContent;
"""


def test_fans_are_drawn_in_a_browser(run, tmp_path):
    page = report_page(Report("fans", [], [scene_of_run({"saga": run}, (), CONFIG.sensors)]))
    found = tried_in_browser(page, TRY, tmp_path)
    assert found["faults"] == []
    assert found["switches"] == " 0.5 s ahead 2 s ahead"
    assert found["pictures"] == [0, 1, 2, 2]  # without horizons there is nothing more to switch off
