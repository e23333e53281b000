"""Every reader refuses files that cannot be read, or would never end, in one line that names them."""

import bz2
import gzip
import os
import resource
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from benchmarks.recordings.landmarks import read_landmark_log
from data_tools.datasets.detection_files import read_detections, read_tracks
from data_tools.datasets.kitti.labels import read_kitti_labels
from data_tools.datasets.nuscenes import read_tracking_results
from data_tools.files.file_access import open_bytes, read_text
from data_tools.files.readers import open_json, parsed_json
from data_tools.lidar import read_scan
from data_tools.pose_graphs import read_g2o
from data_tools.trajectories import read_kitti_poses, read_tum_poses
from saga_fg import InputError
from saga_fg.errors import unknown_name

READERS: dict[str, Callable[[Path], object]] = {
    "a.csv": read_detections,
    "a.ndjson": read_detections,
    "a.npz": read_detections,
    "tracks.csv": read_tracks,
    "labels.ndjson": lambda path: read_tracks(path, labels=True),
    "results.json": read_tracking_results,
    "0000.txt": read_kitti_labels,
    "a.g2o": read_g2o,
    "park.txt": read_landmark_log,
    "P_DR.txt": read_landmark_log,
    "poses.txt": read_kitti_poses,
    "a.tum": read_tum_poses,
    "a.bin": read_scan,
    "a.pcd.bin": read_scan,
    "a.pcd": read_scan,
    "a.ply": read_scan,
    "a.npy": read_scan,
    "b.npz": read_scan,
}


@pytest.fixture(autouse=True)
def _bounded() -> Iterator[None]:
    """A reader that waits for ever, or fills the memory, fails its test instead of the machine."""

    def delete_below(*_: object) -> None:
        raise TimeoutError("the reader waits, or reads on and on")

    before, limits = signal.signal(signal.SIGALRM, delete_below), resource.getrlimit(resource.RLIMIT_DATA)
    signal.alarm(20)
    resource.setrlimit(resource.RLIMIT_DATA, (8 << 30, limits[1]))
    yield
    signal.alarm(0)
    resource.setrlimit(resource.RLIMIT_DATA, limits)
    signal.signal(signal.SIGALRM, before)


def pipe(path: Path) -> None:
    os.mkfifo(path)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def folder(path: Path) -> None:
    path.mkdir()


def circle(path: Path) -> None:
    path.symlink_to(path)


HOSTILE = {
    pipe: "expected a regular file, this is a pipe",
    device: "expected a regular file, this is a device",
    folder: "expected a regular file, this is a folder",
    circle: "Too many levels of symbolic links",
}


def test_what_is_no_file_is_refused(tmp_path, subtests):
    for make, reason in HOSTILE.items():
        inside = tmp_path / make.__name__
        inside.mkdir()
        for name, read in READERS.items():
            path = inside / name
            make(path)
            with subtests.test(path=path), pytest.raises(InputError) as caught:
                read(path)
            assert str(caught.value) == f"{path}: cannot be read: {reason}"


def test_a_name_with_a_zero_byte():
    with pytest.raises(InputError, match="cannot be read: embedded null"):
        open_bytes("a\0b")


def test_links_to_files_are_followed(tmp_path):
    (tmp_path / "a").write_text("text")
    (tmp_path / "b").symlink_to("a")
    assert read_text(tmp_path / "b") == "text"
    with open_json(tmp_path / "b") as file:
        assert file.read() == "text"


def test_what_is_no_text(tmp_path, subtests):
    for content, got in [
        (bz2.compress(b"text"), "got a file compressed by bzip2, to be decompressed first"),
        (gzip.compress(b"text"), "got a file compressed by gzip, to be decompressed first"),
        ("Tür".encode("latin-1"), "got bytes that are none: another encoding, or no text"),
    ]:
        with subtests.test(got):
            (tmp_path / "graph.g2o").write_bytes(content)
            with pytest.raises(InputError, match=rf"graph\.g2o: expected text in UTF-8, {got}"):
                read_g2o(tmp_path / "graph.g2o")


def test_json_that_is_broken_or_too_deep(subtests):
    for text in ["[" * 5000, '{"a": ' * 5000, "[1", b"\xff"]:
        with subtests.test(text=text), pytest.raises(InputError, match=r"^here: broken or truncated JSON: "):
            parsed_json(text, "here")


def test_long_numbers_in_text_tables(tmp_path, subtests):
    for value in ["9" * 4000, "1" * 101]:
        with subtests.test(value=value):
            path = tmp_path / "poses.txt"
            path.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" + f"1 0 0 {value} 0 1 0 0 0 0 1 0\n")
            with pytest.raises(
                InputError, match=r"poses\.txt: line 2: expected values of at most 100 characters, got '"
            ):
                read_kitti_poses(path)


def test_messages_show_the_begin_of_long_names():
    told = unknown_name("scene", "a" * 10_000, ("a" * 9_999, "b"))
    assert told.startswith("unknown scene 'aaa")
    assert len(told) < 500
