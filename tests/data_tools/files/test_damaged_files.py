"""Whatever happens to a file, its reader either reads it or says in one `InputError` what is wrong.

`python tests/fuzz_readers.py` does the same for hours.
"""

from __future__ import annotations

import json
import random
from collections.abc import Sized
from contextlib import suppress
from typing import Any

import pytest

from saga_fg import InputError
from tests.data_tools.damage import Target, another, targets

INPUTS = 20
SIZES = {
    "nuScenes": 2,
    "nuScenes detections": 2,
    "nuScenes results": 2,
    "KITTI": 3,
    "KITTI results": 1,
    "detections, CSV": 1,
    "detections, NDJSON": 1,
    "detections, NumPy": 1,
    "ETH and UCY": 2,
    "NGSIM": 3,
    "pose graph, plane": 2,
    "pose graph, space": 2,
    "poses, KITTI": 2,
    "poses, TUM": 2,
    "scan, KITTI": 3,
    "tracks of others": 1,
    "scan, nuScenes": 3,
    "scan, PCD": 2,
    "scan, PLY": 2,
    "scan, NumPy": 3,
    "list of files": 2,
    "log of a sensor": 2,
    "laser logs": 3,
    "predictions": 1,
    "tracks": 2,
    "labels": 2,
    "journal": 2,
    "stream": 4,
}
"""Scenes, moments, poses, points or messages of the valid files that have a length."""


@pytest.fixture(scope="module")
def valid(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Target]:
    return targets(tmp_path_factory.mktemp("damage"))


def test_what_is_whole_is_read(valid: dict[str, Target]) -> None:
    read: dict[str, Any] = {name: target.read() for name, target in valid.items()}
    assert len(read.pop("Argoverse", "ab")) == len(read.pop("OpenACC", "ab")) == 2  # need pyarrow
    for name in ("recording, MCAP", "recording, SQLite"):
        assert len(read.pop(name, "ab")) == 2  # need the packages that write them
    for name in ("detections, Parquet", "detections, Feather", "image"):
        assert len(read.pop(name, "a")) == 1
    assert json.loads(read.pop("state"))["type"] == "tracks"
    assert {name: len(content) for name, content in read.items() if isinstance(content, Sized)} == SIZES
    assert len(read["map"].points) == 1
    assert [len(scene) for scene in read["nuScenes"]] == [3, 2]
    assert read["configuration"].tracker.max_delay == 0.5
    assert read["run record"].method == "kf"


@pytest.mark.parametrize("seed", range(4))
def test_damage_is_read_or_named(valid: dict[str, Target], seed: int) -> None:
    for number, (name, target) in enumerate(valid.items()):
        rng = random.Random(1000 * seed + number)
        originals = {path: path.read_bytes() for path in target.files}
        for _ in range(INPUTS):
            path = rng.choice(target.files)
            path.write_bytes(another(path, originals[path], rng))
            try:
                with suppress(InputError):
                    target.read()
            except Exception as error:
                raise AssertionError(f"{name}: {path.read_bytes()!r}") from error
            finally:
                path.write_bytes(originals[path])
