from __future__ import annotations

import json
from pathlib import Path

import pytest

from data_tools.datasets.nuscenes import split_scenes
from saga_fg import InputError
from tests.data_tools.nuscenes_example import write_tables


def scenes(root: Path, version: str, names: list[str], splits: object = None) -> Path:
    folder = root / version
    folder.mkdir()
    (folder / "scene.json").write_text(json.dumps([{"name": name} for name in names]))
    if splits is not None:
        (folder / "splits.json").write_text(json.dumps(splits))
    return root


def test_official_mini_splits(tmp_path: Path) -> None:
    write_tables(tmp_path)
    assert split_scenes(tmp_path, "v1.0-mini", "mini_val") == ("scene-0103",)
    assert split_scenes(tmp_path, "v1.0-mini", "mini_train") == ("scene-0061",)


def test_official_trainval_splits(tmp_path: Path) -> None:
    names = [f"scene-{n:04}" for n in (1, 3, 4, 12, 18, 19, 92, 110, 1059, 1073, 1074, 1110)]
    root = scenes(tmp_path, "v1.0-trainval", names)
    val = {name for name in names if int(name[-4:]) in (3, 12, 18, 92, 110, 1059, 1073)}
    assert set(split_scenes(root, "v1.0-trainval", "val")) == val
    assert set(split_scenes(root, "v1.0-trainval", "train")) == set(names) - val
    detect = split_scenes(root, "v1.0-trainval", "train_detect")
    assert detect == ("scene-0001", "scene-1074")
    assert set(split_scenes(root, "v1.0-trainval", "train_track")) == set(names) - val - set(detect)


def test_test_split_is_the_whole_test_version(tmp_path: Path) -> None:
    root = scenes(tmp_path, "v1.0-test", ["scene-0077", "scene-0078"])
    assert split_scenes(root, "v1.0-test", "test") == ("scene-0077", "scene-0078")


def test_own_splits_keep_the_order_of_the_table(tmp_path: Path) -> None:
    root = scenes(tmp_path, "v1.0-mini", ["a", "b", "c"], {"mine": ["c", "a", "absent"]})
    assert split_scenes(root, "v1.0-mini", "mine") == ("a", "c")


def test_splits_that_cannot_be_found(tmp_path: Path, subtests: pytest.Subtests) -> None:
    root = scenes(tmp_path, "v1.0-mini", ["a"], {"mine": ["a"], "none": []})
    for split, message in (
        (
            "mini_vall",
            r"splits\.json: unknown split 'mini_vall'; did you mean 'mini_val'\? .*: mini_train, mini",
        ),
        ("train", r"split train belongs to v1\.0-trainval, the tables read are v1\.0-mini"),
        ("none", r"expected scenes of split none, the table holds none of them"),
    ):
        with subtests.test(split), pytest.raises(InputError, match=message):
            split_scenes(root, "v1.0-mini", split)
    for content in (["a"], {"mine": "a"}, {"mine": [1]}):
        (root / "v1.0-mini" / "splits.json").write_text(json.dumps(content))
        with (
            subtests.test(content=content),
            pytest.raises(InputError, match="expected an object of lists"),
        ):
            split_scenes(root, "v1.0-mini", "mine")
    with pytest.raises(InputError, match="scene mine: expected a name scene-NNNN"):
        split_scenes(scenes(tmp_path, "v1.0-trainval", ["mine"]), "v1.0-trainval", "val")
