"""What would have matched is said where it explains the tracks, and nowhere else."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from data_tools.metrics import SceneBoxes
from data_tools.metrics.misalignment import misalignment
from saga_fg import Boxes, Scene
from saga_fg.numerics import FloatArray, yaw_transform

STEPS = 30
SILENT = "no usual unit, turn, offset or shift in time explains it"
POSES = np.array([yaw_transform(40.0 + 5.0 * k, 90.0 + 2.0 * k, 0.0, 0.3 + 0.05 * k) for k in range(STEPS)])
SEEDS = range(2)


def moving(seed: int, objects: int = 12, label: str = "car") -> SceneBoxes:
    """Objects that drive in all directions about (60, 120), at 2 to 15 m/s, seen every 0.5 s."""
    rng = np.random.default_rng(seed)
    start, heading = np.array([60, 120]) + rng.uniform(-60, 60, (objects, 2)), rng.uniform(-np.pi, np.pi, objects)
    velocity = rng.uniform(2, 15, objects)[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    places = start + 0.5 * np.arange(STEPS)[:, None, None] * velocity
    boxes = Boxes.of([label] * STEPS * objects, np.pad(places.reshape(-1, 2), ((0, 0), (0, 1))))
    ids = np.tile(np.arange(objects).astype(np.str_), STEPS)
    return SceneBoxes(np.repeat(np.arange(STEPS), objects), ids, boxes, np.ones(len(ids)))


def scene_of(truth: SceneBoxes) -> Scene:
    return Scene("s", 0.5 * np.arange(STEPS), POSES, ("",) * STEPS, (), truth.annotations(STEPS))


def at(found: SceneBoxes, place: FloatArray) -> SceneBoxes:
    return replace(found, boxes=replace(found.boxes, position=np.pad(place, ((0, 0), (0, 1)))))


def noisy(truth: SceneBoxes, seed: int) -> SceneBoxes:
    rng = np.random.default_rng(100 + seed)
    return at(truth, truth.boxes.position[:, :2] + rng.normal(0, 0.3, (len(truth), 2)))


def in_vehicle(truth: SceneBoxes) -> FloatArray:
    R, t = POSES[truth.frame][:, :2, :2], POSES[truth.frame][:, :2, 3]
    return np.einsum("nji,nj->ni", R, truth.boxes.position[:, :2] - t)


def in_world(truth: SceneBoxes) -> FloatArray:
    R, t = POSES[truth.frame][:, :2, :2], POSES[truth.frame][:, :2, 3]
    return np.einsum("nij,nj->ni", R, truth.boxes.position[:, :2]) + t


def place(change: Callable[[FloatArray], FloatArray]) -> Callable[[SceneBoxes], SceneBoxes]:
    return lambda found: at(found, change(found.boxes.position[:, :2]))


def earlier(found: SceneBoxes) -> SceneBoxes:
    kept = found.select(found.frame >= 6)
    return replace(kept, frame=kept.frame - 6)


MISREAD = {
    "with x and y exchanged": place(lambda p: p[:, ::-1]),
    "turned by 90 degrees": place(lambda p: p[:, ::-1] * [1, -1]),
    "turned by -90 degrees": place(lambda p: p[:, ::-1] * [-1, 1]),
    "turned by 180 degrees": place(lambda p: -p),
    "with y mirrored": place(lambda p: p * [1, -1]),
    "read as feet": place(lambda p: p / 0.3048),
    "read as centimetres": place(lambda p: 100 * p),
    "moved from the vehicle's frame to the world": lambda found: at(found, in_vehicle(found)),
    "moved from the world to the vehicle's frame": lambda found: at(found, in_world(found)),
    "+3 s later": earlier,
    "moved by -321": place(lambda p: np.array([321.0, -40.0]) + p),
    "moved by -410000": place(lambda p: np.array([410_000.0, 5_400_000.0]) + p),
}


@pytest.mark.parametrize("how", MISREAD)
def test_a_misreading_is_named(how):
    for seed in SEEDS:
        truth = moving(seed)
        told = misalignment([(scene_of(truth), MISREAD[how](noisy(truth, seed)))])
        assert how in told, (seed, told)
        assert SILENT not in told


def test_a_shift_in_time_is_named_beside_cars_that_stand():
    for seed in SEEDS:
        parked, driving = moving(seed, 4), moving(seed + 10, 12)
        first = parked.boxes.position[parked.frame == 0, :2] + [300, 0]
        parked = replace(at(parked, np.tile(first, (STEPS, 1))), id=np.char.add("p", parked.id))
        rows = [parked, driving]
        order = np.argsort(np.concatenate([each.frame for each in rows]), kind="stable")
        truth = SceneBoxes(
            np.concatenate([each.frame for each in rows])[order],
            np.concatenate([each.id for each in rows])[order],
            Boxes.concatenate([each.boxes for each in rows]).select(order),
            np.ones(len(order)),
        )
        assert "+3 s later" in misalignment([(scene_of(truth), earlier(noisy(truth, seed)))])


def test_tracks_that_match_are_not_doubted():
    for seed in SEEDS:
        truth = moving(seed)
        found = noisy(truth, seed)
        assert misalignment([(scene_of(truth), found)]) == ""
        some = found.select(np.isin(found.id, ["0", "1"]))  # two of twelve objects
        assert misalignment([(scene_of(truth), some)]) == ""


@pytest.mark.parametrize("objects", [1, 2, 5, 12, 60])
def test_tracks_of_other_traffic_are_explained_by_nothing(objects):
    for seed in SEEDS:
        truth, other = moving(seed, objects), moving(seed + 50, objects)
        told = misalignment([(scene_of(truth), at(other, other.boxes.position[:, :2] + [500.0, 0.0]))])
        assert told.endswith(SILENT), (seed, told)


def test_one_object_is_no_offset():
    truth = moving(0, objects=1)
    assert misalignment([(scene_of(truth), MISREAD["moved by -321"](truth))]).endswith(SILENT)


@pytest.mark.parametrize("cars", [3, 4, 12])
def test_a_row_of_parked_cars_tells_no_offset(cars):
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        truth, found = moving(0, cars), moving(1, cars)
        row, other = (np.cumsum(rng.uniform(5.5, 8, cars)) for _ in range(2))
        truth = at(truth, np.tile(np.stack([row, np.zeros(cars)], axis=1), (STEPS, 1)))
        found = at(found, np.tile(np.stack([other, np.full(cars, 300.0)], axis=1), (STEPS, 1)))
        assert misalignment([(scene_of(truth), found)]).endswith(SILENT)


def test_tracks_that_jump_about_are_no_reading():
    rng = np.random.default_rng(1)
    truth = moving(1, objects=40)
    there = at(truth, np.array([300.0, 0.0]) + rng.permutation(truth.boxes.position[:, :2]))
    assert misalignment([(scene_of(truth), there)]).endswith(SILENT)


def test_there_is_nothing_to_say_without_tracks_truth_or_a_common_class():
    truth = moving(0)
    assert misalignment([(scene_of(truth), truth.select(slice(0, 0)))]) == ""
    assert misalignment([(replace(scene_of(truth), ground_truth=None), truth)]) == ""
    assert misalignment([(scene_of(truth), moving(5, label="truck"))]) == ""
    assert misalignment([]) == ""
