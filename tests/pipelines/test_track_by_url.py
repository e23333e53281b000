"""nuScenes and KITTI by URL: the same results as from the folders they are copies of."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from data_tools.datasets.kitti import local_kitti
from data_tools.datasets.kitti.source import KittiPart, KittiSource
from data_tools.files.input_files import local_tree
from saga_fg.errors import InputError
from tests.data_tools.kitti_example import write_sequence
from tests.data_tools.nuscenes_example import VERSION, write_results, write_tables
from tests.pipelines.command import saga_fg

Put = Callable[[Path, str], str]


@pytest.fixture
def put() -> Iterator[Put]:
    """Copies a local folder to a URL in memory."""
    memory = pytest.importorskip("fsspec", reason="fsspec is not installed (extra [remote])").filesystem("memory")

    def copy(folder: Path, name: str) -> str:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                memory.pipe_file(f"/{name}/{path.relative_to(folder)}", path.read_bytes())
        return f"memory://{name}"

    yield copy
    memory.store.clear()


def test_nuscenes(tmp_path: Path, put: Put) -> None:
    root = write_tables(tmp_path / "nuscenes")
    write_results(root / "lidar.json")
    url = put(root, "bucket/nuscenes")
    command = ["track", "nuscenes", "--scenes", "scene-0103", "--version", VERSION]
    for output, place, detections in (
        ("a.json", root, f"lidar={root}/lidar.json"),
        ("b.json", url, f"lidar={url}/lidar.json"),
        ("c.json", url, f"{url}/lidar.json"),
    ):
        result = saga_fg(*command, "--dataroot", place, "--detections", detections, "-o", tmp_path / output)
        assert result.exit_code == 0, result.output
        assert (tmp_path / output).read_bytes() == (tmp_path / "a.json").read_bytes()


@pytest.mark.parametrize(
    ("command", "files"), [("track", ("0007.txt", "tracks.csv")), ("smooth", ("labels.csv", "label_02/0007.txt"))]
)
def test_kitti(tmp_path: Path, put: Put, command: str, files: tuple[str, ...]) -> None:
    root = write_sequence(tmp_path / "kitti")
    url = put(root, "bucket/kitti")
    for place, output in ((root, "here"), (url, "there")):
        arguments = ("--dataroot", place, "--detections", f"{place}/found", "-o", tmp_path / output)
        result = saga_fg(command, "kitti", *arguments)
        assert result.exit_code == 0, result.output
    for file in files:
        assert (tmp_path / "here" / file).read_bytes() == (tmp_path / "there" / file).read_bytes()


def test_a_worker_fetches_its_sequence_alone(tmp_path: Path, put: Put) -> None:
    root = write_sequence(write_sequence(tmp_path / "kitti", "0007"), "0008")
    url = put(root, "kitti")
    with local_kitti(url, f"{url}/found", ["0008"]) as dataset:
        assert dataset.scenes == ("0008",)
        assert [path.name for path in dataset.files("0008")[0].parent.iterdir()] == ["0008.txt"]
    with KittiPart(KittiSource(dataroot=url, detections=f"{url}/found", sequences="0007"), "0007").opened() as there:
        digests = there.digests
    local = KittiSource(dataroot=str(root), detections=str(root / "found"), sequences="0007")
    with KittiPart(local, "0007").opened() as here:
        assert digests == here.digests


def test_errors_name_the_url(tmp_path: Path, put: Put) -> None:
    root = write_sequence(tmp_path / "kitti")
    (root / "training" / "oxts" / "0007.txt").write_text("nonsense\n")
    url = put(root, "kitti")
    result = saga_fg("track", "kitti", "--dataroot", url, "--detections", f"{url}/found", "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert result.stderr.startswith("error: memory://kitti/training/oxts/0007.txt: line 1: ")
    with pytest.raises(InputError, match="expected GPS/IMU records"), local_kitti("memory://nothing", "memory://none"):
        pass
    with pytest.raises(InputError, match="memory://kitti: here"), local_tree(url, ["*"]) as folder:
        raise InputError(f"{folder}: here")
