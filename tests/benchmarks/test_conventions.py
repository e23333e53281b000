"""Made tables in other conventions: each trap is named, and tables as they should be pass without a word."""

from itertools import cycle

import numpy as np
import pytest

from benchmarks.conventions import KINDS, SPEEDS, TRAPS, _of_ego, table
from saga_fg import InputError
from saga_fg.numerics.geometry import wrap_angle
from saga_fg.tables.column_names import COMMAND, TableImport
from saga_fg.tables.detections import raw_table, scenes_of
from saga_fg.types.dataset import refuse_contradictions

MENDS = {
    "vehicle's frame as world": "--coordinates ego",
    "camera axes": "--coordinates camera",
    "compass": "--units yaw=compass",
    "mirrored headings": "--units yaw=clockwise",
    "headings in degrees": "--units yaw=deg",
    "elapsed ns": "--units time=ns",
    "km/h": "--units speed=km/h",
    "sizes exchanged": "--columns length=width,width=length",
}


def read(made, how=None):
    (scene,) = scenes_of(raw_table(made, how, within=COMMAND))
    return scene


@pytest.mark.parametrize(("seed", "kind"), [(4711, "parked street"), (51907, "motorway")])
def test_mirrored_headings_nearly_along_an_axis_are_told_and_stop_nothing(seed, kind):
    rng = np.random.default_rng([seed, 0, *map(ord, kind + "mirrored headings")])
    made = table(kind, rng, True)
    assert not read(made).findings
    (told,) = read(TRAPS["mirrored headings"](made)).findings
    assert told.what.startswith("table: headings may be clockwise, or all turned: ")
    assert not told.stops


@pytest.mark.parametrize("kind", ["queue", "crossing", "parked street"])
def test_headings_of_the_world_beside_positions_of_the_vehicles_frame_are_named(kind):
    world = table(kind, np.random.default_rng([88111, *map(ord, kind)]), False)
    ego = _of_ego(world).assign(coordinates="ego")
    assert not read(ego).findings
    with pytest.raises(InputError, match=r"headings look like those in the world.* --columns yaw=;"):
        refuse_contradictions(read(ego.assign(yaw=world.yaw)).findings)


def relative(made):
    speed = 10 * np.hypot(*np.gradient(made.drop_duplicates("timestamp")[["ego_x", "ego_y"]].to_numpy(), axis=0).T)
    driven = speed[np.unique(made.timestamp, return_inverse=True)[1]]
    return made.assign(vx=made.vx - driven * np.cos(made.ego_yaw), vy=made.vy - driven * np.sin(made.ego_yaw))


WRONG_VELOCITIES = {
    "0.2": (lambda made: made.assign(vx=made.vx / 3.6, vy=made.vy / 3.6), "vx=,vy="),
    "reversed": (lambda made: made.assign(vx=-made.vx, vy=-made.vy), "vx=,vy="),
    "exchanged": (lambda made: made.assign(vx=made.vy, vy=made.vx), "vx=vy,vy=vx"),
    "relative to the vehicle": (relative, "vx=,vy="),
}


@pytest.mark.parametrize("kind", ["queue", "motorway"])
@pytest.mark.parametrize("wrong", WRONG_VELOCITIES)
def test_velocities_that_contradict_the_motion_are_named_as_such(kind, wrong):
    change, option = WRONG_VELOCITIES[wrong]
    right = table(kind, np.random.default_rng([6007, *map(ord, kind)]), True)
    of_ego = _of_ego(change(right) if wrong.startswith("relative") else right)
    for made in (change(right), (of_ego if wrong.startswith("relative") else change(of_ego)).assign(coordinates="ego")):
        with pytest.raises(InputError, match=rf"measured velocities vx, vy .*{wrong}.*--columns {option};"):
            refuse_contradictions(read(made).findings)


@pytest.mark.parametrize(("kind", "speeds"), [("queue", True), ("crossing", True), ("parked street", False)])
def test_rows_of_the_vehicles_frame_without_its_pose_are_named(kind, speeds):
    world = table(kind, np.random.default_rng([88112, *map(ord, kind)]), speeds)
    pose = ["ego_x", "ego_y", "ego_yaw"]
    assert not read(world.drop(columns=pose)).findings
    with pytest.raises(InputError, match=r"that moves, whose pose is needed.*--coordinates ego"):
        refuse_contradictions(read(_of_ego(world).drop(columns=pose)).findings)


def test_cross_traffic_tells_the_vehicles_frame_without_velocities():
    world = table("crossing", np.random.default_rng([13, *map(ord, "crossing")]), False)
    assert not read(world).findings
    with pytest.raises(InputError, match="they move with it; add --coordinates ego"):
        refuse_contradictions(read(_of_ego(world)).findings)


@pytest.mark.parametrize(("kind", "seed"), [("crowd", 3), ("parked street", 3)])
def test_compass_headings_of_the_vehicle_alone_are_named(kind, seed):
    rows = _of_ego(table(kind, np.random.default_rng([seed, *map(ord, kind)]), False)).assign(coordinates="ego")
    assert not read(rows).findings
    with pytest.raises(InputError, match="headings of the vehicle look clockwise from north"):
        refuse_contradictions(read(rows.assign(ego_yaw=wrap_angle(np.pi / 2 - rows.ego_yaw.to_numpy()))).findings)


def placed(scene):
    """Positions, headings and velocities in the world."""
    boxes = [
        frame.detections.boxes
        if frame.coordinates == "world"
        else frame.detections.boxes.transformed(frame.world_T_ego)
        for frame in scene.frames
    ]
    return [np.concatenate(each) for each in zip(*((b.position[:, :2], b.yaw, b.velocity) for b in boxes), strict=True)]


def assert_same(found, wanted):
    np.testing.assert_allclose(found[0], wanted[0], atol=1e-6)
    np.testing.assert_allclose(wrap_angle(found[1] - wanted[1]), 0.0, atol=1e-6)
    if np.isfinite(found[2]).any():
        np.testing.assert_allclose(found[2], wanted[2], atol=1e-6)


def test_traps_are_named_and_what_mends_them_gives_the_right_table(subtests):
    kinds = cycle(KINDS)
    for number, (trap, change) in enumerate(TRAPS.items()):
        for kind in (next(kinds), next(kinds)):
            right = table(kind, np.random.default_rng(number), trap == SPEEDS)
            made = change(right)
            with subtests.test(trap=trap, kind=kind):
                scene = read(made)
                with pytest.raises(InputError, match=f"add {MENDS[trap]}.*; --as-given reads"):
                    refuse_contradictions(scene.findings)
                refuse_contradictions(read(made, TableImport(as_given=True)).findings)
                mend = next(finding.mend for finding in scene.findings if finding.stops)
                mended = read(made, TableImport().mended(mend, {}))
                assert mended.findings == ()
                assert_same(placed(mended), placed(read(right.loc[made.index])))


@pytest.mark.parametrize(
    ("trap", "kinds"), [("compass", KINDS), ("mirrored headings", ("crossing", "crowd")), (SPEEDS, KINDS)]
)
def test_traps_in_the_vehicles_frame(trap, kinds, subtests):
    for number, kind in enumerate(kinds):
        right = table(kind, np.random.default_rng(40 + number), trap == SPEEDS)
        with subtests.test(kind):
            how = TableImport(coordinates="ego")
            of_ego = TRAPS["vehicle's frame as world"](right)
            assert read(of_ego, how).findings == ()
            made = TRAPS[trap](of_ego)
            (finding,) = read(made, how).findings
            assert finding.mend.units.keys() <= {"yaw", "speed"}  # the vehicle's heading is right
            mended = read(made, how.mended(finding.mend, {}))
            assert mended.findings == ()
            assert_same(placed(mended), placed(read(right)))


def test_the_world_is_not_taken_for_the_vehicles_frame(subtests):
    for number, kind in enumerate(KINDS):
        made = table(kind, np.random.default_rng(60 + number), True)
        with subtests.test(kind):
            (finding,) = read(made, TableImport(coordinates="ego")).findings
            assert finding.option == "--coordinates world"
            (finding,) = read(TRAPS["vehicle's frame as world"](made).assign(coordinates="world")).findings
            assert finding.option == "--columns coordinates= --coordinates ego"


def test_right_tables_pass(subtests):
    for number, kind in enumerate(KINDS):
        for speeds in (False, True):
            with subtests.test(kind=kind, speeds=speeds):
                assert read(table(kind, np.random.default_rng(100 + number), speeds)).findings == ()
