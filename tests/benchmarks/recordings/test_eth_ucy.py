"""The reader of the ETH walking pedestrians, on files written by hand."""

import numpy as np
import pytest

from benchmarks.recordings.crowds import EthUcy
from saga_fg.errors import InputError

OBSMAT = """  780 1 8.0 0 3.0 1.0 0 0.0
  786 1 8.4 0 3.0 1.0 0 0.0
  786 2 1.0 0 2.0 0.0 0 -0.5
"""


@pytest.fixture
def root(tmp_path):
    (tmp_path / "eth").mkdir()
    (tmp_path / "eth" / "obsmat.txt").write_text(OBSMAT, encoding="utf-8")
    return tmp_path


def test_people_stand_on_the_ground_plane_at_the_times_of_the_video(root):
    dataset = EthUcy(root)
    assert dataset.scenes == ("eth",)
    scene = dataset.scene("eth")
    np.testing.assert_allclose(scene.timestamps, [52.0, 52.4])
    assert [truth.id.tolist() for truth in scene.ground_truth] == [["1"], ["1", "2"]]
    boxes = scene.ground_truth[1].boxes
    np.testing.assert_allclose(boxes.position, [[8.4, 3.0, 0.0], [1.0, 2.0, 0.0]])
    np.testing.assert_allclose(boxes.velocity, [[1.0, 0.0], [0.0, -0.5]])
    np.testing.assert_allclose(boxes.yaw, [0.0, -np.pi / 2])
    assert set(boxes.label.tolist()) == {"pedestrian"}


def test_what_is_wrong_in_the_file_is_named(root, subtests):
    for line, message in [
        ("792 1 1 0 1 0 0", r"obsmat.txt: line 4: expected 8 .* got 7"),
        ("792 1 1 0 nan 0 0 0", r"obsmat.txt: line 4: y: expected a finite number"),
        ("786 2 1 0 1 0 0 0", r"frame 786: id: expected unique object ids"),
    ]:
        with subtests.test(message):
            (root / "eth" / "obsmat.txt").write_text(OBSMAT + line + "\n", encoding="utf-8")
            with pytest.raises(InputError, match=message):
                EthUcy(root).scene("eth")


def test_a_root_without_recordings_and_an_unknown_one_are_errors(root, tmp_path_factory):
    with pytest.raises(InputError, match=r"eth/obsmat.txt or hotel/obsmat.txt, or NAME.txt"):
        EthUcy(tmp_path_factory.mktemp("empty"))
    with pytest.raises(InputError, match=r"unknown recording 'hotel'"):
        EthUcy(root).scene("hotel")


PLACES = "780.0\t1.0\t1.0\t2.0\n790.0\t1.0\t1.4\t2.0\n790.0\t2.0\t0.0\t0.0\n800.0\t1.0\t1.8\t2.0\n"


@pytest.mark.parametrize("by", ["folder", "file"])
def test_files_of_places_alone_have_velocities_by_differences(tmp_path, by):
    path = tmp_path / "zara01.txt"
    path.write_text(PLACES, encoding="utf-8")
    dataset = EthUcy(tmp_path if by == "folder" else path)
    assert dataset.scenes == ("zara01",)
    scene = dataset.scene("zara01")
    np.testing.assert_allclose(np.diff(scene.timestamps), [0.4, 0.4])
    boxes = scene.ground_truth[1].boxes
    np.testing.assert_allclose(boxes.position, [[1.4, 2.0, 0.0], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(boxes.velocity, [[1.0, 0.0], [np.nan, np.nan]])
    np.testing.assert_allclose(boxes.yaw, [0.0, np.nan])


def test_a_single_file_of_eth(root):
    assert EthUcy(root / "eth" / "obsmat.txt").scenes == ("eth",)
