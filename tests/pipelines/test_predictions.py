"""Predictions kept with a run: the table, the fans of the page, and the page in a browser."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.detection_files import PREDICTION_COLUMNS, PredictionRows, predictions_path, read_predictions
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from pipelines.config import load_config
from pipelines.report import Report, report_page, scene_of_run
from pipelines.report.scenes import scene_data
from pipelines.tracking import TrackedScene, track_scene
from saga_fg import InputError
from tests.pipelines.command import saga_fg
from tests.pipelines.page_in_browser import tried_in_browser

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


def test_a_method_that_predicts_nothing_is_refused(run):
    with pytest.raises(InputError, match="expected a method that predicts"):
        track_scene(run.scene, CONFIG.new_tracker("centerpoint"), horizons=HORIZONS)


def test_the_table_is_read_back_as_it_was_made(detections: Path, tmp_path: Path):
    tracks = tmp_path / "t.csv"
    made = saga_fg("track", "file", detections / "a.csv", "--output", tracks, "--predict", "0.5,2")
    assert made.exit_code == 0, made.output
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


def test_parallel_runs_keep_a_table_for_each_part(detections: Path, tmp_path: Path):
    pattern, run = detections / "*.csv", ("track", "file", "--workers", "1", "--output", tmp_path / "run")
    made = saga_fg(*run, pattern, "--predict", "1")
    assert made.exit_code == 0, made.output
    part = tmp_path / "run" / "tracks" / "a.csv"
    assert list(read_predictions(part)) == ["a"]
    assert sorted(read_predictions(tmp_path / "run" / "tracks")) == ["a", "b"]
    other = saga_fg(*run, pattern, "--predict", "2")
    assert "2 done, 0 unchanged" in other.output
    assert set(read_predictions(part)["a"].horizon.tolist()) == {2.0}


def test_other_horizons_are_refused(detections: Path, tmp_path: Path):
    for given, why in [
        (["--predict", "1,x"], "--predict: expected seconds with commas between them, got '1,x'"),
        (["--predict", "2,1"], "--predict: horizons: expected increasing seconds from 0 to 60"),
        (["--predict", "1", "--method", "centerpoint"], "--predict: expected --method saga or kf"),
    ]:
        result = saga_fg("track", "file", detections / "a.csv", "--output", tmp_path / "t.csv", *given)
        assert result.exit_code == 2
        assert why in result.stderr
        assert not (tmp_path / "t.csv").exists()


def test_a_broken_table_is_refused(tmp_path: Path):
    for row, why in [
        ("0,,1,1,1", "horizon: expected a number, got none"),
        ("0,1,1,x,1", "x: expected a number, got 'x'"),
    ]:
        predictions_path(tmp_path / "t.csv").write_text(f"timestamp,horizon,id,x,y\n{row}\n")
        with pytest.raises(InputError, match=why):
            read_predictions(tmp_path / "t.csv")


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


def test_predictions_of_ids_with_a_scene_belong_to_its_tracks(run):
    from dataclasses import replace

    report = scene_of_run({"saga": run}, (), CONFIG.sensors)
    table = report.tracks["saga"]
    named = replace(table, id=np.array([f"scene-0001-{id_}" for id_ in table.id]))
    data = scene_data(replace(report, tracks={"saga": named}))["methods"]["saga"]
    assert sum(map(len, data["predictions"])) == len(PredictionRows.from_moments(run.predictions))


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


def test_fans_are_drawn_in_a_browser(run, tmp_path: Path):
    page = report_page(Report("fans", [], [scene_of_run({"saga": run}, (), CONFIG.sensors)]))
    found = tried_in_browser(page, TRY, tmp_path)
    assert found["faults"] == []
    assert found["switches"] == " 0.5 s ahead 2 s ahead"
    assert found["pictures"] == [0, 1, 2, 2]  # without horizons there is nothing more to switch off
