"""Whatever happens to a file, its reader either reads it or says in one `InputError` what is wrong."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kitti_example import write_sequence
from nuscenes_example import write_results, write_tables

from data_tools import KittiTracking, NuScenes, read_detections, split_scenes
from saga_fg import InputError

CSV = "timestamp,sensor,label,x,y,length,ego_x,ego_y,ego_yaw\n0,a,car,1,2,3,0,0,0\n1,a,,,,,1,1,1\n"
NDJSON = '{"timestamp": 0, "x": 1, "y": 2, "label": "car", "yaw": 0.5}\n{"timestamp": 1, "sensor": "b"}\n'
PIECES = [
    b"",
    b"NaN",
    b"-1",
    b"1e999",
    b"null",
    b"[]",
    b"{}",
    b'""',
    b'"x"',
    b"\n",
    b",",
    b" ",
    b"\xff",
    b"\x00",
    b"true",
]


def nuscenes(root: Path) -> None:
    data = NuScenes(root, "v1.0-mini", {"lidar": root / "found.json"}, ground_truth=True)
    for name in data.scenes:
        data.scene(name)
    split_scenes(root, "v1.0-mini", "mini_val")


def kitti(root: Path) -> None:
    KittiTracking(root, root / "found", ground_truth=True).scene("0007")


def table(root: Path) -> None:
    for path in root.glob("t.*"):
        data = read_detections(path)
        for name in data.scenes:
            data.scene(name)


def make(root: Path) -> tuple[list[Path], Callable[[Path], None]]:
    if root.name.startswith("nuscenes"):
        write_tables(root)
        write_results(root / "found.json")
        return sorted(root.rglob("*.json")), nuscenes
    if root.name.startswith("kitti"):
        write_sequence(root)
        return sorted(path for path in root.rglob("*.txt") if path.stat().st_size), kitti
    (root / "t.csv").write_text(CSV)
    (root / "t.ndjson").write_text(NDJSON)
    return sorted(root.iterdir()), table


@pytest.mark.parametrize("kind", ["nuscenes", "kitti", "table"])
@settings(max_examples=60)
@given(data=st.data())
def test_damage_is_read_or_named(tmp_path_factory: pytest.TempPathFactory, kind: str, data: st.DataObject) -> None:
    files, read = make(tmp_path_factory.mktemp(kind))
    root = next(p for p in files[0].parents if p.name.startswith(kind))
    read(root)
    path = data.draw(st.sampled_from(files))
    content = path.read_bytes()
    start = data.draw(st.integers(0, len(content) - 1))
    end = data.draw(st.integers(start, min(len(content), start + 20)))
    path.write_bytes(content[:start] + data.draw(st.sampled_from(PIECES)) + content[end:])
    with suppress(InputError):
        read(root)
