"""Tables of tracks: written, and read again."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.detection_files import read_detections, read_tracks, write_tracks
from saga_fg import Boxes, InputError, Scene, Tracks


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


def test_tracks_as_csv(tmp_path: Path) -> None:
    path = tmp_path / "tracks.csv"
    yaw = tracks(0.0).boxes.yaw[0]
    write_tracks(path, [(scene(), [tracks(0.0), Tracks.empty(0.5)])])
    assert path.read_text() == (
        "scene,timestamp,id,label,x,y,z,length,width,height,yaw,vx,vy,score,"
        "cov_xx,cov_xy,cov_yy,cov_vxvx,cov_vxvy,cov_vyvy,coasting,settled\n"
        f"drive,0.0,7,car,1.0,2.0,3.0,4.0,2.0,1.5,{yaw},3.0,0.1,0.25,0.1,0.01,0.2,0.1,0.01,0.2,0.0,1\n"
        "drive,0.0,9,pedestrian,4.0,5.0,6.0,,,,,,,0.3333333333333333,1.0,0.0,1.0,1.0,0.0,1.0,0.5,0\n"
    )


def test_tracks_as_ndjson(tmp_path: Path) -> None:
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


def test_tracks_are_read_as_they_were_written_and_as_detections(tmp_path: Path) -> None:
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


def test_columns_of_labels_have_no_meaning_in_tracks_of_others(tmp_path: Path) -> None:
    path = tmp_path / "tracks.ndjson"
    path.write_text('{"timestamp": 0, "id": 1, "x": 1, "y": 2, "quality": 0.5, "sources": 3}\n')
    assert read_tracks(path).quality.tolist() == ["low"]
    with pytest.raises(InputError, match="did you mean 'source'"):
        read_tracks(path, labels=True)


def test_a_table_of_tracks_names_what_is_wrong_in_it(tmp_path: Path) -> None:
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


def test_tracks_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"out\.xlsx: expected a file name that ends in \.csv"):
        write_tracks(tmp_path / "out.xlsx", [])
    with pytest.raises(InputError, match=r"out\.csv: scene drive: expected tracks for 2 moments, got 1"):
        write_tracks(tmp_path / "out.csv", [(scene(), [tracks(0.0)])])
    assert list(tmp_path.iterdir()) == []
