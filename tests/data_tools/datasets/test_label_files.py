"""Labels as files, read back: tables of boxes, nuScenes tables, KITTI text."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.detection_files import LABEL_COLUMNS, read_tracks, write_label_table
from data_tools.datasets.nuscenes import NuScenes, write_nuscenes
from data_tools.datasets.nuscenes.writer import write_nuscenes_labels
from data_tools.simulator import SimulatedTraffic, SimulatorSettings
from saga_fg.errors import InputError
from saga_fg.smoothing import Labels
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Scene
from saga_fg.types.track import Tracks


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
    return Labels(tracks, np.full(n, np.nan), np.full(n, source), np.full(n, "medium"))


def scene_of(times: list[float], tokens: tuple[str, ...] | None = None) -> Scene:
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    return Scene("drive", np.array(times), poses, tokens or ("",) * len(times), [])


LABELS = [labels_at(0.0, [1, 2]), labels_at(0.5, [1], "filled"), labels_at(1.0, [1, 3], "extended")]


@pytest.mark.parametrize("suffix", [".csv", ".ndjson"])
def test_a_table_of_labels_comes_back_as_it_was(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"labels{suffix}"
    write_label_table(path, [(scene_of([0.0, 0.5, 1.0]), LABELS)])
    rows = read_tracks(path, labels=True)
    assert rows.id.tolist() == ["1", "2", "1", "1", "3"]
    assert rows.timestamp.tolist() == [0.0, 0.0, 0.5, 1.0, 1.0]
    assert rows.source.tolist() == ["observed", "observed", "filled", "extended", "extended"]
    assert set(rows.quality.tolist()) == {"medium"}
    assert np.isnan(rows.yaw_variance).all()
    assert np.array_equal(rows.position_covariance[0], LABELS[0].tracks.position_covariance[0])


def test_parquet_holds_the_same_columns(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="Parquet comes with the extra parquet")
    write_label_table(tmp_path / "labels.parquet", [(scene_of([0.0, 0.5, 1.0]), LABELS)])
    table = parquet.read_table(tmp_path / "labels.parquet")
    assert tuple(table.column_names) == LABEL_COLUMNS
    assert table.column("id").to_pylist() == [1, 2, 1, 1, 3]
    assert table.column("yaw_variance").to_pylist() == [None] * 5


def test_labels_of_another_length_or_other_words_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected tracks for 2 moments, got 3"):
        write_label_table(tmp_path / "labels.csv", [(scene_of([0.0, 0.5]), LABELS)])
    assert not (tmp_path / "labels.csv").exists()
    tracks = LABELS[0].tracks
    with pytest.raises(InputError, match="source: expected 2 of observed, filled, extended"):
        Labels(tracks, np.zeros(2), np.array(["seen", "seen"]), np.array(["low", "low"]))


def test_nuscenes_tables_of_labels_are_read_as_a_dataset(tmp_path: Path) -> None:
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
    assert truth is not None
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


def test_masks_of_maps_are_copied_to_the_folder_of_maps_alone(tmp_path: Path) -> None:
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
