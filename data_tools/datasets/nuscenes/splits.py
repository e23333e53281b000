"""Scenes of the splits.

The tables do not say it. The official splits are lists of scenes published with the development kit
(https://github.com/nutonomy/nuscenes-devkit, `utils/splits.py`); scene names are numbered, and of the scenes of
v1.0-trainval a few number ranges are `val` and `train_detect`, the rest `train` and `train_track`. Splits of one's own
are lists of scene names in `splits.json` beside the tables, the place the development kit looks in.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from data_tools.datasets.nuscenes.tables import read_table, table_folder
from data_tools.files.error_messages import unknown_name
from data_tools.files.json_stream import JsonStream, open_json
from saga_fg.errors import InputError

_MINI_VAL = {"scene-0103", "scene-0916"}

_VAL = (
    *((3, 3), (12, 18), (35, 39), (92, 110), (221, 221), (268, 278), (329, 346), (519, 524), (552, 565), (625, 638)),
    *((770, 784), (794, 802), (904, 931), (962, 972), (1059, 1073)),
)
_TRAIN_DETECT = (
    *((1, 2), (41, 76), (161, 176), (190, 214), (254, 264), (283, 324), (347, 375), (382, 382), (420, 439), (457, 480)),
    *((566, 583), (665, 689), (739, 769), (868, 903), (945, 961), (975, 991), (1011, 1025), (1074, 1105)),
)

_VERSION_OF_SPLIT = {
    "mini_train": "mini",
    "mini_val": "mini",
    "train": "trainval",
    "train_detect": "trainval",
    "train_track": "trainval",
    "val": "trainval",
    "test": "test",
}


def split_scenes(dataroot: str | Path, version: str, split: str) -> tuple[str, ...]:
    """The names of the scenes of a split that the tables hold, in the order of the tables.

    Reads the scene table and `splits.json` alone. Raises `InputError` for an unknown split, an official one that does
    not belong to this version, and one of which no scene is present.
    """
    folder = table_folder(dataroot, version)
    scenes = [name for (name,) in read_table(folder, "scene", ("name",))]
    own = _own_splits(folder)
    if split in _VERSION_OF_SPLIT:
        wanted_version = _VERSION_OF_SPLIT[split]
        if not version.endswith(wanted_version):
            raise InputError(f"split {split} belongs to v1.0-{wanted_version}, the tables read are {version}")
        chosen = [name for name in scenes if _in_official_split(name, split)]
    elif split in own:
        chosen = [name for name in scenes if name in own[split]]
    else:
        official = [name for name, kind in _VERSION_OF_SPLIT.items() if version.endswith(kind)]
        raise InputError(f"{folder / 'splits.json'}: {unknown_name('split', split, (*official, *own))}")
    if not chosen:
        raise InputError(f"{folder / 'scene.json'}: expected scenes of split {split}, the table holds none of them")
    return tuple(chosen)


def _in_official_split(name: str, split: str) -> bool:
    if split == "test":
        return True
    if split.startswith("mini"):
        return (name in _MINI_VAL) == (split == "mini_val")
    number = name.removeprefix("scene-")
    if not number.isdecimal() or len(number) > 9:
        raise InputError(f"scene {name[:40]}: expected a name scene-NNNN to find its place in split {split}")
    val = _within(int(number), _VAL)
    detect = _within(int(number), _TRAIN_DETECT)
    return {"val": val, "train": not val, "train_detect": detect, "train_track": not (val or detect)}[split]


def _within(number: int, ranges: Iterable[tuple[int, int]]) -> bool:
    return any(first <= number <= last for first, last in ranges)


def _own_splits(folder: Path) -> dict[str, frozenset[str]]:
    path = folder / "splits.json"
    if not path.exists():
        return {}
    with open_json(path) as file:
        stream = JsonStream(file, str(path))
        splits = stream.value()
        stream.end()
    if not isinstance(splits, dict) or not all(
        isinstance(names, list) and all(isinstance(name, str) for name in names) for names in splits.values()
    ):
        raise InputError(f"{path}: expected an object of lists of scene names")
    return {split: frozenset(names) for split, names in splits.items()}
