"""Results of KITTI, and its recordings."""

from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.detection_files import read_tracks
from data_tools.datasets.kitti import (
    KittiTracking,
    image_boxes,
    observation_angles,
    read_kitti_labels,
    write_kitti_results,
)
from data_tools.datasets.kitti.source import TRACK_TABLE
from data_tools.metrics.kitti_boxes import has_box
from saga_fg import Boxes, InputError, Tracks
from tests.data_tools.kitti_example import write_sequence


@pytest.fixture
def data(tmp_path: Path) -> KittiTracking:
    return KittiTracking(write_sequence(tmp_path / "kitti"), ground_truth=True)


def tracks(boxes: Boxes, score: float = 0.5) -> Tracks:
    n = len(boxes)
    none = np.zeros((n, 2, 2))
    return Tracks(0.0, np.arange(n) + 3, boxes, np.full(n, score), none, none, np.zeros(n))


def car(position: tuple[float, float, float], label: str = "car", yaw: float = 0.0, height: float = 1.5) -> Tracks:
    return tracks(Boxes.of([label], [position], [(4, 1.6, height)], [yaw]))


def test_the_official_layout(data, tmp_path):
    scene = data.scene("0007")
    moments = [car((11, 2, 1)), Tracks.empty(0.1), Tracks.empty(0.2)]
    write_kitti_results(tmp_path / "out", data, [(scene, moments)])
    (line,) = (tmp_path / "out" / "0007.txt").read_text().splitlines()
    fields = line.split()
    assert fields[:5] == ["0", "3", "Car", "0", "0"]
    alpha, *numbers = map(float, fields[5:])
    assert alpha == pytest.approx(-np.pi / 2 - np.arctan2(-2, 10), abs=1e-6)
    # x from -2.8 to -1.2, y from 0.25 to 1.75, the front at z = 8
    expected_bbox = [600 - 700 * 2.8 / 8, 180 + 700 * 0.25 / 12, 600 - 700 * 1.2 / 12, 180 + 700 * 1.75 / 8]
    np.testing.assert_allclose(numbers[:4], expected_bbox, atol=1e-4)
    np.testing.assert_allclose(numbers[4:], [1.5, 1.6, 4, -2, 1.75, 10, -np.pi / 2, 0.5], atol=1e-6)


def test_the_table_beside_the_results_has_all_tracks_in_world_coordinates(data, tmp_path):
    scene = data.scene("0007")
    behind = car((-30, 2, 1))  # not in the image
    write_kitti_results(tmp_path / "out", data, [(scene, [behind, car((11, 2, 1)), Tracks.empty(0.2)])])
    assert len(read_kitti_labels(tmp_path / "out" / "0007.txt")) == 1
    rows = read_tracks(tmp_path / "out" / TRACK_TABLE)
    assert rows.scene.tolist() == ["0007", "0007"]
    assert rows.timestamp.tolist() == scene.timestamps[:2].tolist()
    np.testing.assert_array_equal(rows.boxes.position, [[-30, 2, 1], [11, 2, 1]])
    np.testing.assert_array_equal(rows.position_covariance, np.zeros((2, 2, 2)))


def test_what_shows_is_written_and_a_sequence_without_tracks_is_an_empty_file(data, tmp_path):
    moments = [car((-20, 2, 1)), car((11, 60, 1)), car((11, 2, 1))]  # behind, far to the left, ahead
    write_kitti_results(tmp_path / "out", data, [(data.scene("0007"), moments)])
    assert read_kitti_labels(tmp_path / "out" / "0007.txt").frame.tolist() == [2]
    write_kitti_results(tmp_path / "out", data, [(data.scene("0007"), [Tracks.empty(0.0)] * 3)])
    assert (tmp_path / "out" / "0007.txt").read_text() == ""


def test_tracks_that_cannot_be_written(data, tmp_path, subtests):
    for moments, message in [
        ([car((11, 2, 1))], "expected tracks for 3 frames, got 1"),
        ([car((11, 2, 1), "bus")] * 3, "frame 0: unknown class 'bus'"),
        ([car((11, 2, 1), yaw=np.nan)] * 3, "frame 0: track 3: expected a known size and heading"),
        ([car((11, 2, 1), height=np.nan)] * 3, "frame 0: track 3: expected a known size and heading"),
    ]:
        with subtests.test(message):
            with pytest.raises(InputError, match=f"out: sequence 0007: {message}"):
                write_kitti_results(tmp_path / "out", data, [(data.scene("0007"), moments)])
            assert not (tmp_path / "out").exists()


# The reader and writer on real recordings, where there are some


@pytest.fixture(scope="module")
def kitti(recordings: Path) -> KittiTracking:
    return KittiTracking(recordings / "kitti", recordings / "kitti" / "detections" / "pointrcnn", ground_truth=True)


def test_projection_agrees_with_the_labelled_image_boxes(kitti, recordings):
    objects = read_kitti_labels(recordings / "kitti" / "training" / "label_02" / "0000.txt")
    objects = objects.select(has_box(objects) & (objects.truncated == 0))
    drawn = image_boxes(objects.boxes, kitti.calibration("0000").projection, (1242, 375))
    assert np.median(np.abs(drawn - objects.bbox)) < 2  # pixels
    apart = observation_angles(objects.boxes) - objects.alpha
    assert np.median(np.abs(np.angle(np.exp(1j * apart)))) < 0.01
