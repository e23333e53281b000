"""Labels out to labelling tools and back: laws of the round trip, and edits as corrections."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from data_tools.datasets.corrections import SAME, Edits
from data_tools.datasets.labelling_tools import exchanged, read_from_tool, write_for_tool
from data_tools.datasets.results import SceneResult
from data_tools.metrics import SceneBoxes
from saga_fg import InputError
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.smoothing.corrections import correction_from
from saga_fg.types.boxes import Boxes
from saga_fg.types.dataset import Scene

TOOLS = ("openlabel", "cvat", "sustechpoints")
CLASSES = ("car", "bus", "pedestrian", "Traffic_Cone")
MOMENTS = 6


def made(seed: int = 0, objects: int = 5) -> SceneResult:
    """Objects 12 m apart that drive along x, seen from a vehicle that turns and nods a little; one of unknown size."""
    rng = np.random.default_rng(seed)
    poses = np.array([yaw_transform(600 + 3 * k, -80.0, 2.0, 0.3 * k) for k in range(MOMENTS)])
    poses[:, :3, :3] = poses[:, :3, :3] @ _nod(0.02)
    frame, number = (grid.ravel() for grid in np.meshgrid(np.arange(MOMENTS), np.arange(objects + 1), indexing="ij"))
    label = np.array([CLASSES[n % len(CLASSES)] for n in range(objects + 1)])
    size = rng.uniform(0.5, 5, (objects + 1, 3))
    size[objects] = np.nan
    place = np.column_stack([600 + 2.0 * frame, 12.0 * number, rng.normal(1, 0.1, len(frame))])
    boxes = Boxes.of(label[number], place, size[number], rng.uniform(-3, 3, len(frame)))
    boxes.yaw.flags.writeable = True
    boxes.yaw[number == 1] = np.nan
    found = SceneBoxes(frame, number.astype(np.str_), boxes, np.ones(len(frame)))
    return SceneResult(Scene("a b", 0.5 * np.arange(MOMENTS), poses, ("",) * MOMENTS, ()), found)


def _nod(angle: float) -> Any:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def changed(result: SceneResult, change: Callable[[SceneBoxes], SceneBoxes], folder: Path, tool: str) -> Any:
    """What comes back of labels that are changed in a tool."""
    edited = SceneResult(result.scene, change(exchanged(result).found))
    write_for_tool(folder / "a", tool, edited)
    back, frames = read_from_tool(folder / "a", tool, result.scene, CLASSES)
    return edits(exchanged(result), back, frames)


def edits(result: SceneResult, back: SceneBoxes, frames: Any) -> tuple[list[dict[str, Any]], list[str]]:
    compared = Edits(result, back, frames)
    return compared.corrections(), compared.problems


def with_boxes(found: SceneBoxes, rows: Any, **columns: Any) -> SceneBoxes:
    """Boxes of which some have other values."""
    values = {}
    for name, value in columns.items():
        values[name] = getattr(found.boxes, name).copy()
        values[name][rows] = value
    return replace(found, boxes=replace(found.boxes, **values))


def without(found: SceneBoxes, rows: Any) -> SceneBoxes:
    return found.select(~rows)


@pytest.mark.parametrize("tool", TOOLS)
def test_boxes_that_go_out_and_come_back_are_the_same_and_ask_for_nothing(tool, tmp_path):
    result = made()
    write_for_tool(tmp_path / "a", tool, result)
    back, frames = read_from_tool(tmp_path / "a", tool, result.scene, CLASSES)
    out = exchanged(result).found
    assert frames.tolist() == list(range(MOMENTS))
    assert back.id.tolist() == out.id.tolist()
    assert "5" not in out.id
    assert back.boxes.label.tolist() == out.boxes.label.tolist()
    assert_allclose(back.boxes.position, out.boxes.position, atol=1e-6)
    assert_allclose(back.boxes.size, out.boxes.size)
    assert_allclose(np.cos(back.boxes.yaw - out.boxes.yaw), 1, atol=1e-6)  # the vehicle nods
    assert edits(exchanged(result), back, frames) == ([], [])


def of(id_: str, *frames: int) -> Callable[[SceneBoxes], Any]:
    """Mask of the boxes of an object, at some frames or all."""
    return lambda found: (found.id == id_) & (np.isin(found.frame, frames) if frames else True)


EDITS: dict[str, tuple[Callable[[SceneBoxes], SceneBoxes], list[dict[str, Any]]]] = {
    "moved": (
        lambda found: with_boxes(found, of("0", 2)(found), position=[604.5, 0.4, 1.5]),
        [{"what": "box", "box": {"x": 604.5, "y": 0.4, "z": 1.5}}],
    ),
    "turned": (
        lambda found: with_boxes(found, of("3", 1)(found), yaw=1.25),
        [{"what": "box", "box": {"x": 602.0, "y": 36.0, "yaw": 1.25}}],
    ),
    "a heading for one unknown": (
        lambda found: with_boxes(found, of("1", 1)(found), yaw=1.25),
        [{"what": "box", "box": {"x": 602.0, "y": 12.0, "yaw": 1.25}}],
    ),
    "resized in all frames": (
        lambda found: with_boxes(found, of("2")(found), size=[4.1, 2.2, 1.3]),
        [{"what": "size", "box": {"length": 4.1, "width": 2.2, "height": 1.3}}],
    ),
    "deleted": (lambda found: without(found, of("4")(found)), [{"what": "exists", "value": False}]),
    "another class": (
        lambda found: with_boxes(found, of("0")(found), label="bus"),
        [{"what": "class", "label": "bus"}],
    ),
    "ids exchanged": (
        lambda found: replace(
            found, id=np.select([of("0", 3, 4, 5)(found), of("4", 3, 4, 5)(found)], ["4", "0"], found.id)
        ),
        [{"what": "same", "value": value} for value in (False, False, True, True)],
    ),
    "a track cut": (
        lambda found: replace(found, id=np.where(of("2", 3, 4, 5)(found), "77", found.id)),
        [{"what": "same", "value": False}],
    ),
    "its end gone": (
        lambda found: without(found, of("2", 4, 5)(found)),
        [{"what": "same", "value": False}, {"what": "exists", "value": False}],
    ),
}


@pytest.mark.parametrize("tool", TOOLS)
@pytest.mark.parametrize("name", EDITS)
def test_an_edit_is_the_correction_that_says_so(tool, name, tmp_path):
    result = made()
    change, expected = EDITS[name]
    records, problems = changed(result, change, tmp_path, tool)
    assert not problems
    found = [{key: record[key] for key in wanted} for wanted, record in zip(expected, records, strict=True)]
    for wanted, got in zip(expected, found, strict=True):
        assert got.pop("box", None) == pytest.approx(wanted.pop("box", None), abs=2e-3)
        assert got == wanted
    for record in records:
        assert correction_from(record).scene == "a b"


@pytest.mark.parametrize("tool", TOOLS)
def test_an_object_that_is_added_is_one_object_of_all_its_boxes(tool, tmp_path):
    def add(found: SceneBoxes) -> SceneBoxes:
        more = with_boxes(found.select(of("0", 1, 2, 3)(found)), slice(None), label="Traffic_Cone")
        more = with_boxes(more, slice(None), position=more.boxes.position - np.array([0, 30, 0]))
        frame = np.concatenate([found.frame, more.frame])
        order = np.argsort(frame, kind="stable")
        boxes = Boxes.concatenate([found.boxes, more.boxes]).select(order)
        ids = np.concatenate([found.id, np.full(len(more), "99")])[order]
        return SceneBoxes(frame[order], ids, boxes, np.ones(len(ids)))

    records, _ = changed(made(), add, tmp_path, tool)
    assert [record["what"] for record in records] == ["box"] * 3
    assert {json.dumps(record["at"]) for record in records} == {json.dumps(records[0]["at"])}
    assert [record["box"]["time"] for record in records] == [0.5, 1.0, 1.5]
    assert all(record["label"] == "Traffic_Cone" and record["box"]["length"] > 0 for record in records)


def test_two_objects_with_one_id_are_one(tmp_path):
    result = made()
    fragments = replace(result.found, id=np.where(of("2", 3, 4, 5)(result.found), "22", result.found.id))
    write_for_tool(tmp_path / "a", "cvat", result)
    back = read_from_tool(tmp_path / "a", "cvat", result.scene, CLASSES)
    ((record,), _) = edits(exchanged(SceneResult(result.scene, fragments)), *back)
    assert (record["what"], record["value"]) == ("same", True)
    assert record["at"]["time"] < 1.5 <= record["and"]["time"]


def test_a_box_added_to_a_track_is_of_its_object(tmp_path):
    result = made()
    shorter = SceneResult(result.scene, without(result.found, of("0", 5)(result.found)))
    write_for_tool(tmp_path / "a", "openlabel", result)
    back, frames = read_from_tool(tmp_path / "a", "openlabel", result.scene, CLASSES)
    ((record,), problems) = edits(exchanged(shorter), back, frames)
    assert (record["what"], record["at"]["time"], record["box"]["time"], problems) == ("box", 2.0, 2.5, [])


def test_tools_may_number_tracks_anew_and_round(tmp_path):
    def renumbered(found: SceneBoxes) -> SceneBoxes:
        names = {"0": "3", "1": "0", "2": "1", "3": "2", "4": "4"}
        boxes = replace(found.boxes, position=found.boxes.position.round(2), yaw=found.boxes.yaw.round(2))
        found = replace(found, id=np.array([names[one] for one in found.id.tolist()]), boxes=boxes)
        return with_boxes(found, (found.id == "2") & (found.frame == 4), position=[615.0, 36.0, 1.0])  # 7 m away

    records, problems = changed(made(), renumbered, tmp_path, "cvat")
    assert not problems
    assert [(record["what"], record["at"]["y"], record["box"]["x"]) for record in records] == [("box", 36.0, 615.0)]


def test_moments_that_do_not_come_back_stay_as_they_are(tmp_path):
    result = made()
    write_for_tool(tmp_path / "a", "sustechpoints", result)
    for k in (0, 4, 5):
        (tmp_path / "a" / "label" / f"{k:06d}.json").unlink()
    back = read_from_tool(tmp_path / "a", "sustechpoints", result.scene, CLASSES)
    records, problems = edits(exchanged(result), *back)
    assert not records
    assert problems == ["3 frames, the first 0, did not come back: their labels stay as they are"]


def test_what_corrections_cannot_say_is_named(tmp_path):
    result = replace(made(), coasting=np.where(made().found.frame < 2, 3.0, 0.0))
    edited = SceneResult(result.scene, without(exchanged(result).found, of("2", 0, 1)(exchanged(result).found)))
    edited = replace(edited, found=without(edited.found, of("3", 3)(edited.found)))
    write_for_tool(tmp_path / "a", "openlabel", edited)
    back = read_from_tool(tmp_path / "a", "openlabel", result.scene, CLASSES)
    records, problems = edits(exchanged(result), *back)
    assert not records
    assert [line.split(":")[0] for line in problems] == ["object 2", "object 3"]


def test_classes_that_differ_in_capitals_are_the_same(tmp_path):
    result = made()
    write_for_tool(tmp_path / "a", "sustechpoints", result)
    for file in (tmp_path / "a" / "label").iterdir():
        file.write_text(file.read_text().replace('"car"', '"Car"').replace("Traffic_Cone", "traffic_cone"))
    back, _ = read_from_tool(tmp_path / "a", "sustechpoints", result.scene, CLASSES)
    assert set(back.boxes.label.tolist()) == set(CLASSES)


def replaced(old: str, new: str) -> Callable[[str], str]:
    return lambda text: text.replace(old, new, 1)


BROKEN: dict[str, tuple[str, Callable[[str], str], str]] = {
    "cut in the middle": ("openlabel", lambda text: text[: len(text) // 2], "broken or truncated JSON"),
    "of another form": ("cvat", lambda _: "[]", "categories: expected an object"),
    "another class": ("cvat", replaced('"pedestrian"', '"walker"'), "frame 000000: unknown class 'walker'"),
    "an unknown frame": ("openlabel", replaced('"5": {"frame_pro', '"9": {"frame_pro'), "frame 9: expected each frame"),
    "a frame that is a word": ("cvat", replaced('"000001"', '"one"'), "frame one: expected each frame once"),
    "other coordinates": ("openlabel", replaced('system": "vehicle-iso8855"', 'system": "lidar"'), "coordinate_system"),
    "no such class": ("cvat", replaced('"label_id": 0', '"label_id": 12'), "label_id: expected 0 to"),
    "an unknown object": ("openlabel", replaced('"objects": {"0"', '"objects": {"70"'), "object 0: 0: expected an obj"),
    "no numbers": ("sustechpoints", replaced('"x": ', '"x": "1" , "u": '), "position: expected 3 finite numbers"),
    "not a number": ("sustechpoints", replaced('"x": ', '"x": NaN, "u": '), "position: expected 3 finite numbers"),
    "no extent": ("sustechpoints", replaced('"scale": {"x": ', '"scale": {"x": -'), "size[0]: expected positive"),
    "an object twice": ("sustechpoints", replaced('"obj_id": "1"', '"obj_id": "0"'), "'0' occurs twice in frame"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_wrong_in_a_file_of_a_tool_is_one_line(name, tmp_path):
    tool, damage, expected = BROKEN[name]
    result = made()
    write_for_tool(tmp_path / "a", tool, result)
    for file in [tmp_path / "a"] if tool == "openlabel" else (tmp_path / "a").rglob("*.json"):
        file.write_text(damage(file.read_text()))
    with pytest.raises(InputError) as error:
        read_from_tool(tmp_path / "a", tool, result.scene, CLASSES)
    assert str(error.value).startswith(str(tmp_path / "a"))
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


def test_differences_within_what_tools_round_are_none():
    result = exchanged(made())
    boxes = replace(result.found.boxes, position=result.found.boxes.position + 0.9 * SAME * np.array([1, 0, 0]))
    assert edits(result, replace(result.found, boxes=boxes), np.arange(MOMENTS)) == ([], [])
