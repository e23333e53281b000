"""KITTI results beside their labels, in world coordinates, with what stands in the table beside them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.kitti import KittiTracking, write_kitti_results
from data_tools.datasets.kitti.source import read_scored_sequences
from saga_fg import InputError, Tracks
from tests.data_tools.kitti_example import write_sequence


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_sequence(tmp_path / "kitti")


def write_truth_as_result(root: Path, folder: Path) -> None:
    """The true boxes at 10 m/s eastwards, track numbers from 3 on."""
    data = KittiTracking(root, ground_truth=True)
    scene = data.scene("0007")
    moments = []
    for truth in scene.ground_truth or ():
        n = len(truth)
        velocity = np.tile([10.0, 0.0], (n, 1))
        boxes = type(truth.boxes)(*(getattr(truth.boxes, f) for f in ("label", "position", "size", "yaw")), velocity)  # type: ignore[call-arg]
        P = np.tile(np.diag([0.25, 0.5]), (n, 1, 1))
        moments.append(Tracks(0.0, np.arange(n) + 3, boxes, np.full(n, 0.5), P, P, np.zeros(n)))
    write_kitti_results(folder, data, [(scene, moments)])


def test_results_in_the_world_are_where_the_labels_are(root: Path, tmp_path: Path) -> None:
    write_truth_as_result(root, tmp_path / "out")
    (scored,) = read_scored_sequences(tmp_path / "out", root, detections=root / "found").values()
    assert len(scored.labels) == 5  # with the DontCare region
    assert len(scored.result) == len(scored.truth) == len(scored.found) == 4
    np.testing.assert_array_equal(scored.found.frame, scored.truth.frame)
    np.testing.assert_allclose(scored.found.boxes.position, scored.truth.boxes.position, atol=1e-5)
    np.testing.assert_allclose(scored.found.boxes.yaw, scored.truth.boxes.yaw, atol=1e-5)
    np.testing.assert_array_equal(scored.found.boxes.velocity, np.tile([10.0, 0.0], (4, 1)))
    np.testing.assert_array_equal(scored.found.position_covariance, np.tile(np.diag([0.25, 0.5]), (4, 1, 1)))
    assert sum(len(frame) for frame in scored.scene.frames) == 3


def test_without_the_table_velocities_and_covariances_are_unknown(root: Path, tmp_path: Path) -> None:
    write_truth_as_result(root, tmp_path / "out")
    (tmp_path / "out" / "tracks.csv").unlink()
    (scored,) = read_scored_sequences(tmp_path / "out", root).values()
    assert np.isnan(scored.found.boxes.velocity).all()
    assert np.isnan(scored.found.position_covariance).all()


def test_missing_results(root: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"0007\.txt: expected the results of sequence 0007"):
        read_scored_sequences(tmp_path, root, ["0007"])
    with pytest.raises(InputError, match=r"expected results NNNN\.txt, there are none"):
        read_scored_sequences(tmp_path, root)
    line = "3 3 Car 0 0 -1.5 500 150 600 250 1.5 1.6 4 2 1.75 10 -1.57 0.5\n"
    (tmp_path / "0007.txt").write_text(line)
    with pytest.raises(InputError, match="frame 3: expected frames 0 to 2 only"):
        read_scored_sequences(tmp_path, root)
