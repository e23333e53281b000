"""Recordings with ground truth alone: their detections from a table, or from what is annotated and visible."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.annotated import detected
from data_tools.datasets.eth_ucy import EthUcySource
from data_tools.datasets.source import input_files
from saga_fg.errors import InputError
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Annotations, Scene


def scene_of(times: list[float], visible: bool = True) -> Scene:
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


def test_what_is_visible_is_detected_without_identity_and_velocity() -> None:
    frames = detected(scene_of([0.0, 0.4], visible=False))
    assert [frame.timestamp for frame in frames] == [0.0, 0.4]
    assert [len(frame) for frame in frames] == [1, 1]
    boxes = frames[1].detections.boxes
    assert boxes.position.tolist() == [[0.4, 0.0, 0.0]]
    assert np.isnan(boxes.velocity).all()
    assert frames[0].detections.score.tolist() == [1.0]


def test_a_pause_has_empty_frames_at_the_pace_of_the_others() -> None:
    frames = detected(scene_of([0.0, 0.4, 0.8, 2.0, 2.4]))
    assert [frame.timestamp for frame in frames] == pytest.approx([0.0, 0.4, 0.8, 1.2, 1.6, 2.0, 2.4])
    assert [len(frame) for frame in frames] == [2, 2, 2, 0, 0, 2, 2]
    assert len(detected(scene_of([3.0]))) == 1


def test_without_ground_truth_there_is_nothing_to_detect() -> None:
    scene = scene_of([0.0])
    with pytest.raises(InputError, match="scene s: expected ground truth"):
        detected(Scene("s", scene.timestamps, scene.world_T_ego, ("",), []))


@pytest.fixture
def recordings(tmp_path: Path) -> Path:
    """A pedestrian who walks through `hotel`."""
    (tmp_path / "hotel").mkdir()
    rows = [f"{10 * k} 1 {0.4 * k} 0 2.0 1.0 0 0.0" for k in range(5)]
    (tmp_path / "hotel" / "obsmat.txt").write_text("\n".join(rows) + "\n")
    return tmp_path


def test_detections_come_from_a_table_where_one_is_given(recordings: Path) -> None:
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


def test_recordings_are_chosen_by_name(recordings: Path) -> None:
    with EthUcySource(dataroot=str(recordings), scenes="hotel").open() as dataset:
        assert dataset.scenes == ("hotel",)
    with (
        pytest.raises(InputError, match="--scenes: unknown scene 'hotels'; did you mean 'hotel'"),
        EthUcySource(dataroot=str(recordings), scenes="hotels").open(),
    ):
        pass


def test_the_folder_may_be_a_url(recordings: Path) -> None:
    pytest.importorskip("fsspec", reason="files by URL come with the extra remote")
    with EthUcySource(dataroot=f"file://{recordings}").open() as dataset:
        assert len(dataset.scene("hotel").frames) == 5


def test_a_result_of_some_recordings_is_scored_on_these(recordings: Path, caplog: pytest.LogCaptureFixture) -> None:
    (recordings / "eth").mkdir()
    (recordings / "eth" / "obsmat.txt").write_text((recordings / "hotel" / "obsmat.txt").read_text())
    table = recordings / "tracks.csv"
    rows = [f"hotel,{0.4 * k},1,pedestrian,{0.4 * k},2.0" for k in range(5)]
    table.write_text("\n".join(["scene,timestamp,id,label,x,y", *rows]) + "\n")
    source = EthUcySource(dataroot=str(recordings))
    found = source.read_results(table)
    assert list(found) == ["hotel"]
    assert source.evaluate(found).programs["tracking"]["overall"]["mota"] == 1.0
    assert "has tracks in 1 of the 2 scenes" in caplog.text
    named = source.restricted(["eth", "hotel"]).read_results(table)
    assert list(named) == ["eth", "hotel"]  # recordings that are named count although nothing was found in one
    assert source.evaluate(named).programs["tracking"]["overall"]["mota"] == 0.5
    table.write_text("scene,timestamp,id,label,x,y\n")
    assert list(source.read_results(table)) == ["eth", "hotel"]
