"""Tables of tracks and labels. Tables of tracks: written, and read again."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.recordings.crowds import EthUcySource
from data_tools.datasets.detection_files import (
    read_detections,
    read_tracks,
    write_label_table,
    write_tracks,
)
from data_tools.datasets.given_tracks import detected
from data_tools.datasets.nuscenes import NuScenes, write_nuscenes
from data_tools.datasets.nuscenes.writer import write_nuscenes_labels
from data_tools.datasets.source import input_files
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from saga_fg import Boxes, InputError, Scene, Tracks
from saga_fg.smoothing import Labels, Probabilities
from saga_fg.types.dataset import Annotations


def tracks(timestamp: float) -> Tracks:
    boxes = Boxes.of(
        ["car", "pedestrian"],
        [[1, 2, 3], [4, 5, 6]],
        [[4, 2, 1.5], [np.nan] * 3],
        [0.1, np.nan],
        [[3, 0.1], [np.nan, np.nan]],
    )
    covariance = np.array([[[0.1, 0.01], [0.01, 0.2]], [[1, 0], [0, 1]]])
    score, coasting, settled = np.array([0.25, 1 / 3]), np.array([0, 0.5]), np.array([True, False])
    return Tracks(timestamp, np.array([7, 9]), boxes, score, covariance, covariance, coasting, settled)


def scene(name: str = "drive") -> Scene:
    return Scene(name, np.array([0.0, 0.5]), np.tile(np.eye(4), (2, 1, 1)), ("", ""), ())


def test_tracks_as_csv(tmp_path):
    path = tmp_path / "tracks.csv"
    yaw = tracks(0.0).boxes.yaw[0]
    write_tracks(path, [(scene(), [tracks(0.0), Tracks.empty(0.5)])])
    assert path.read_text() == (
        "scene,timestamp,id,label,x,y,z,length,width,height,yaw,vx,vy,score,"
        "cov_xx,cov_xy,cov_yy,cov_vxvx,cov_vxvy,cov_vyvy,coasting,settled\n"
        f"drive,0.0,7,car,1.0,2.0,3.0,4.0,2.0,1.5,{yaw},3.0,0.1,0.25,0.1,0.01,0.2,0.1,0.01,0.2,0.0,1\n"
        "drive,0.0,9,pedestrian,4.0,5.0,6.0,,,,,,,0.3333333333333333,1.0,0.0,1.0,1.0,0.0,1.0,0.5,0\n"
    )


def test_tracks_as_ndjson(tmp_path):
    path = tmp_path / "tracks.jsonl"
    write_tracks(path, [(scene(), [Tracks.empty(0.0), tracks(0.5)])])
    first, second = (json.loads(line, parse_constant=pytest.fail) for line in path.read_text().splitlines())
    assert first["id"] == 7
    assert first["cov_yy"] == 0.2
    assert second == {
        "scene": "drive",
        "timestamp": 0.5,
        "id": 9,
        "label": "pedestrian",
        "x": 4,
        "y": 5,
        "z": 6,
        "score": 1 / 3,
        "cov_xx": 1,
        "cov_xy": 0,
        "cov_yy": 1,
        "cov_vxvx": 1,
        "cov_vxvy": 0,
        "cov_vyvy": 1,
        "coasting": 0.5,
        "settled": 0,
    }


def test_tracks_are_read_as_they_were_written_and_as_detections(tmp_path):
    for suffix in (".csv", ".ndjson", ".parquet"):
        path = tmp_path / f"tracks{suffix}"
        if suffix == ".parquet":
            pytest.importorskip("pyarrow.parquet", reason="Parquet comes with the extra parquet")
        write_tracks(path, [(scene(name), [tracks(0.0), tracks(0.5)]) for name in ("a", "b")])
        rows = read_tracks(path)
        assert rows.scene.tolist() == ["a"] * 4 + ["b"] * 4
        assert rows.timestamp.tolist() == [0.0, 0.0, 0.5, 0.5] * 2
        assert rows.id.tolist() == ["7", "9"] * 4
        np.testing.assert_array_equal(rows.boxes.velocity[:2], tracks(0.0).boxes.velocity)
        for name in ("position_covariance", "velocity_covariance", "coasting"):
            np.testing.assert_array_equal(getattr(rows, name)[:2], getattr(tracks(0.0), name))
        data = read_detections(path)
        assert data.scenes == ("a", "b")
        read = data.scene("b").frames[1].detections
        for name in ("label", "position", "size", "yaw", "velocity"):
            np.testing.assert_array_equal(getattr(read.boxes, name), getattr(tracks(0.5).boxes, name))
        np.testing.assert_array_equal(read.score, tracks(0.5).score)


def test_columns_of_labels_have_no_meaning_in_tracks_of_others(tmp_path):
    path = tmp_path / "tracks.ndjson"
    path.write_text('{"timestamp": 0, "id": 1, "x": 1, "y": 2, "quality": 0.5, "sources": 3}\n')
    assert read_tracks(path).quality.tolist() == ["low"]
    with pytest.raises(InputError, match="did you mean 'source'"):
        read_tracks(path, labels=True)


def test_a_table_of_tracks_names_what_is_wrong_in_it(tmp_path):
    path = tmp_path / "tracks.csv"
    path.write_text("timestamp,x,y\n0,1,2\n")
    with pytest.raises(InputError, match=r"tracks\.csv: expected a column 'id'"):
        read_tracks(path)
    path.write_text("timestamp,id,x,y,cov_xx\n0,1,2,3,4\n0,,2,3,4\n")
    with pytest.raises(InputError, match=r"tracks\.csv: line 3: id: expected a name or a whole number, it is left out"):
        read_tracks(path)
    path.write_text("timestamp,id,x,y,cov_zx\n0,1,2,3,4\n")
    with pytest.raises(InputError, match="unknown column 'cov_zx'; did you mean"):
        read_tracks(path)


def test_tracks_that_cannot_be_written(tmp_path):
    with pytest.raises(InputError, match=r"out\.xlsx: expected a file name that ends in \.csv"):
        write_tracks(tmp_path / "out.xlsx", [])
    with pytest.raises(InputError, match=r"out\.csv: scene drive: expected tracks for 2 moments, got 1"):
        write_tracks(tmp_path / "out.csv", [(scene(), [tracks(0.0)])])
    assert list(tmp_path.iterdir()) == []


# Labels as files, read back: tables of boxes, nuScenes tables, KITTI text


def doubt(n: int) -> Probabilities:
    return Probabilities(*np.tile([[0.9], [0.8], [0.7], [0.6]], n))


def labels_at(time: float, ids: list[int], source: str = "observed") -> Labels:
    """Cars at x = id."""
    n = len(ids)
    x = np.array(ids, dtype=np.float64)
    boxes = Boxes.of(
        ["car"] * n,
        np.stack([x, x / 3, np.ones(n)], axis=-1),
        np.tile([4.5, 1.9, 1.6], (n, 1)),
        np.full(n, 0.3),
        np.tile([1.0, -2.0], (n, 1)),
    )
    P = np.tile([[0.04, 0.01], [0.01, 0.09]], (n, 1, 1))
    tracks = Tracks(time, np.array(ids, dtype=np.int64), boxes, np.full(n, 0.7), P, 2 * P, np.zeros(n))
    return Labels(tracks, np.full(n, np.nan), np.full(n, source), np.full(n, "medium"), doubt(n))


def scene_of(times: list[float], tokens: tuple[str, ...] | None = None) -> Scene:
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    return Scene("drive", np.array(times), poses, tokens or ("",) * len(times), [])


LABELS = [labels_at(0.0, [1, 2]), labels_at(0.5, [1], "filled"), labels_at(1.0, [1, 3], "extended")]


@pytest.mark.parametrize("suffix", [".csv", ".ndjson"])
def test_a_table_of_labels_comes_back_as_it_was(tmp_path, suffix):
    path = tmp_path / f"labels{suffix}"
    write_label_table(path, [(scene_of([0.0, 0.5, 1.0]), LABELS)])
    rows = read_tracks(path, labels=True)
    assert rows.id.tolist() == ["1", "2", "1", "1", "3"]
    assert rows.timestamp.tolist() == [0.0, 0.0, 0.5, 1.0, 1.0]
    assert rows.source.tolist() == ["observed", "observed", "filled", "extended", "extended"]
    assert set(rows.quality.tolist()) == {"medium"}
    assert np.isnan(rows.yaw_variance).all()
    assert rows.probability[3].tolist() == [0.9, 0.8, 0.7, 0.6]
    assert np.array_equal(rows.position_covariance[0], LABELS[0].tracks.position_covariance[0])


def test_labels_of_another_length_are_refused(tmp_path):
    with pytest.raises(InputError, match="expected tracks for 2 moments, got 3"):
        write_label_table(tmp_path / "labels.csv", [(scene_of([0.0, 0.5]), LABELS)])
    assert not (tmp_path / "labels.csv").exists()


def test_nuscenes_tables_of_labels_are_read_as_a_dataset(tmp_path):
    traffic = SimulatedTraffic(SimulatorSettings(duration=2.0), scenes=1, seed=1)
    write_nuscenes(tmp_path / "data", traffic, traffic.mounts)
    detections = {"lidar": tmp_path / "data" / "detections" / "lidar.json"}
    dataset = NuScenes(tmp_path / "data", "v1.0-mini", detections)
    scene = dataset.scene("scene-0001")
    moments = [
        labels_at(t, [7, 8] if k else [7], "filled" if k == 1 else "observed") for k, t in enumerate(scene.timestamps)
    ]
    write_nuscenes_labels(tmp_path / "labels", tmp_path / "data", "v1.0-mini", [(scene, moments)])

    truth = NuScenes(tmp_path / "labels", "v1.0-mini", detections, ground_truth=True).scene("scene-0001").ground_truth
    assert [len(moment) for moment in truth] == [len(moment) for moment in moments]
    assert np.allclose(truth[1].boxes.position[0], moments[1].tracks.boxes.position[0], atol=1e-6)
    assert np.allclose(truth[1].boxes.size[0], [4.5, 1.9, 1.6])
    assert truth[0].visible.all()
    assert not truth[1].visible.any()
    tables = tmp_path / "labels" / "v1.0-mini"
    records = {r["token"]: r for r in json.loads((tables / "sample_annotation.json").read_text())}
    for instance in json.loads((tables / "instance.json").read_text()):
        token, count = instance["first_annotation_token"], 0
        while token:
            record = records[token]
            assert record["instance_token"] == instance["token"]
            assert record["position_covariance"] == [0.04, 0.01, 0.09]
            last, token, count = token, record["next"], count + 1
        assert (last, count) == (instance["last_annotation_token"], instance["nbr_annotations"])
    assert (tmp_path / "labels" / "maps" / "placeholder.png").is_file()


def test_masks_of_maps_are_copied_to_the_folder_of_maps_alone(tmp_path):
    traffic = SimulatedTraffic(SimulatorSettings(duration=1.0), scenes=1, seed=1)
    write_nuscenes(tmp_path / "data", traffic, traffic.mounts)
    (tmp_path / "out").mkdir()
    (tmp_path / "victim.txt").write_text("theirs")
    (tmp_path / "out" / "victim.txt").write_text("mine")
    table = tmp_path / "data" / "v1.0-mini" / "map.json"
    table.write_text(json.dumps([{**json.loads(table.read_text())[0], "filename": "maps/../../victim.txt"}]))
    write_nuscenes_labels(tmp_path / "out" / "labels", tmp_path / "data", "v1.0-mini", [])
    assert (tmp_path / "out" / "victim.txt").read_text() == "mine"
    assert not list((tmp_path / "out" / "labels").rglob("victim.txt"))


# Recordings with ground truth alone: their detections from a table, or from what is annotated and visible


def annotated_scene_of(times: list[float], visible: bool = True) -> Scene:
    """Two pedestrians that walk, of which the second may be hidden."""
    truth = [
        Annotations(
            np.array(["a", "b"]),
            Boxes.of(["pedestrian"] * 2, [[t, 0, 0], [t, 5, 0]], velocity=[[1, 0], [1, 0]]),
            np.array([True, visible]),
        )
        for t in times
    ]
    return Scene("s", np.array(times), np.tile(np.eye(4), (len(times), 1, 1)), ("",) * len(times), [], truth)


def test_what_is_visible_is_detected_at_the_pace_of_the_truth():
    frames = detected(annotated_scene_of([0.0, 0.4], visible=False))
    assert [frame.timestamp for frame in frames] == [0.0, 0.4]
    assert [len(frame) for frame in frames] == [1, 1]
    boxes = frames[1].detections.boxes
    assert boxes.position.tolist() == [[0.4, 0.0, 0.0]]
    assert np.isnan(boxes.velocity).all()
    assert frames[0].detections.score.tolist() == [1.0]
    frames = detected(annotated_scene_of([0.0, 0.4, 0.8, 2.0, 2.4]))
    assert [frame.timestamp for frame in frames] == pytest.approx([0.0, 0.4, 0.8, 1.2, 1.6, 2.0, 2.4])
    assert [len(frame) for frame in frames] == [2, 2, 2, 0, 0, 2, 2]
    assert len(detected(annotated_scene_of([3.0]))) == 1
    scene = annotated_scene_of([0.0])
    with pytest.raises(InputError, match="scene s: expected ground truth"):
        detected(Scene("s", scene.timestamps, scene.world_T_ego, ("",), []))


@pytest.fixture
def recordings(tmp_path: Path) -> Path:
    """A pedestrian who walks through `hotel`."""
    (tmp_path / "hotel").mkdir()
    rows = [f"{10 * k} 1 {0.4 * k} 0 2.0 1.0 0 0.0" for k in range(5)]
    (tmp_path / "hotel" / "obsmat.txt").write_text("\n".join(rows) + "\n")
    return tmp_path


def test_detections_come_from_a_table_where_one_is_given(recordings):
    table = recordings / "found.csv"
    table.write_text("scene,timestamp,x,y,sensor\nhotel,0.0,0.1,2.0,camera\nhotel,0.4,0.5,2.0,camera\n")
    source = EthUcySource(dataroot=str(recordings), detections=str(table))
    assert input_files(source) == (table,)
    with source.open() as dataset:
        scene = dataset.scene("hotel")
        assert scene.sensors == ("camera",)
        assert len(scene.frames) == 2
        assert scene.ground_truth is not None
        assert len(scene.ground_truth) == 5
    with EthUcySource(dataroot=str(recordings)).open() as dataset:
        assert dataset.scene("hotel").sensors == ("annotations",)


def test_a_result_of_some_recordings_is_scored_on_these(recordings, caplog):
    (recordings / "eth").mkdir()
    (recordings / "eth" / "obsmat.txt").write_text((recordings / "hotel" / "obsmat.txt").read_text())
    table = recordings / "tracks.csv"
    rows = [f"hotel,{0.4 * k},1,pedestrian,{0.4 * k},2.0" for k in range(5)]
    table.write_text("\n".join(["scene,timestamp,id,label,x,y", *rows]) + "\n")
    source = EthUcySource(dataroot=str(recordings))
    found = source.read_results(table)
    assert list(found.scenes) == ["hotel"]
    assert found.evaluate().programs["tracking"]["overall"]["mota"] == 1.0
    assert "has tracks in 1 of the 2 scenes" in caplog.text
    named = source.restricted(["eth", "hotel"]).read_results(table)
    assert list(named.scenes) == ["eth", "hotel"]  # recordings that are named count although nothing was found in one
    assert named.evaluate().programs["tracking"]["overall"]["mota"] == 0.5
    table.write_text("scene,timestamp,id,label,x,y\n")
    assert list(source.read_results(table).scenes) == ["eth", "hotel"]
