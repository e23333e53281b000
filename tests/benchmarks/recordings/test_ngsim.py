"""NGSIM: roads, windows, boxes that overlap."""

import gzip
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.recordings.lanelets import road_of
from benchmarks.recordings.ngsim import ngsim_windows
from benchmarks.recordings.sources import TrafficScenes, true_scene
from benchmarks.recordings.traffic import SHARED_MOMENTS, RecordedTraffic, Recordings, overlapping
from data_tools.simulator.traffic import SimulatedTrajectories
from saga_fg.errors import InputError
from saga_fg.numerics.arrays import FloatArray
from tests.benchmarks.recordings.ngsim_example import HEADER, crossing, lanelet, rows, write_ngsim

STEPS = np.arange(2)


def test_lanelets_without_a_branch_are_one_lane_and_lines_side_by_side_one_line():
    steps = np.array([0, 3, 12, 13, 17, 18, 37, 38, 38 + 35 * 7])
    road, cycles = road_of(crossing(), "map", steps)
    assert {lane.name: (lane.centre[0], lane.centre[-1]) for lane in road.lanes} == {
        "lane-1": ((-50.0, 4.0), (50.0, 4.0)),
        "lane-2": ((-50.0, 0.0), (0.0, 0.0)),  # ends
    }
    assert [lane.width for lane in road.lanes] == [4.0, 4.0]
    (line,) = road.stop_lines
    assert (line.left, line.right, line.light) == ((0.0, 6.0), (0.0, -2.0), "light-7")
    assert line.heading == pytest.approx(0.0)
    assert road.lights[0].position == pytest.approx((12.0, 2.0))  # beyond the line, where signal heads are
    shown = cycles["light-7"]
    assert shown.tolist() == ["red", "green", "green", "amber", "amber", "red", "red", "green", "green"]


def test_a_branch_ends_a_lane_and_a_circle_is_one():
    branch = [lanelet(1, 0.0, (0.0, 9.0), successor=[2, 3]), lanelet(2, 0.0, (9.0, 20.0)), lanelet(3, 1.0, (9.0, 20.0))]
    branch[1]["successor"] = [99]  # not in the map, which ends there
    circle = [lanelet(4, 0.0, (9.0, 20.0), successor=[5]), lanelet(5, 8.0, (20.0, 9.0), successor=[4])]
    road, _ = road_of({"lanelets": branch + circle, "lights": []}, "map", steps=STEPS)
    assert {lane.name: len(lane.centre) for lane in road.lanes} == {"lane-1": 2, "lane-2": 2, "lane-3": 2, "lane-4": 4}


def turning(directions: dict[int, str], successors: list[int], lights: list[int]) -> dict[str, Any]:
    """One lane at a line; 2 goes straight on, 3 turns right. Light 10 is red, others green, at once."""
    right = {"left": [[0.0, 2.0], [4.0, -30.0]], "right": [[0.0, -2.0], [-1.0, -30.0]]}
    cycles = {10: "red", 11: "green", 12: "inactive"}
    return {
        "lanelets": [
            lanelet(1, 0.0, (-50.0, 0.0), successor=successors, stop_line=[[0.0, -2.0], [0.0, 2.0]], lights=lights),
            lanelet(2, 0.0, (0.0, 50.0)),
            {**lanelet(3, 0.0, (0.0, 1.0)), **right},
        ],
        "lights": [{"id": k, "direction": d, "cycle": [[cycles[k], 10]]} for k, d in directions.items()],
    }


def test_a_line_is_governed_by_the_lights_of_the_movements_possible_from_it(subtests):
    for directions, successors, name, shown in [
        ({10: "straight", 11: "right"}, [2], "light-10", "red"),
        ({10: "straight", 11: "right"}, [3], "light-11", "green"),
        ({10: "straightRight", 11: "right"}, [2, 3], "light-10", "red"),
        ({10: "straightRight", 11: "right"}, [3], "light-10-11", "green"),
        ({10: "all", 12: "right"}, [3], "light-10-12", "red"),  # an arrow that shows nothing decides nothing
        ({10: "left", 11: "left"}, [2], "light-10-11", "green"),  # none for this movement: all of the line
        ({12: "right"}, [3], "light-12", ""),
    ]:
        with subtests.test(name):
            road, cycles = road_of(turning(directions, successors, list(directions)), "map", steps=STEPS)
            assert road.stop_lines[0].light == name
            assert cycles[name].tolist() == [shown] * 2
            assert road.stop_lines[0].heading == pytest.approx(0.0)  # its ends were given from right to left


def test_a_signal_without_a_cycle_is_an_error_that_says_how_to_go_without():
    entry = crossing()
    del entry["lights"][0]["cycle"]
    with pytest.raises(InputError, match=r"map: light 7: cycle: expected \[colour, steps\], .*; --road map leaves"):
        road_of(entry, "map", steps=STEPS)
    road, cycles = road_of(entry, "map", steps=None)
    assert len(road.stop_lines) == 1
    assert cycles == {}


def test_what_is_wrong_in_a_map_is_named(subtests):
    for change, message in [
        (lambda e: e["lights"][0].update(cycle=[["blue", 3]]), r"light 7: cycle: expected \[one of red, .*blue"),
        (lambda e: e["lights"][0].update(cycle=[["red", 0]]), r"light 7: cycle: expected .* steps above 0"),
        (lambda e: e["lights"][0].update(time_offset=0.5), r"light 7: time_offset: expected a whole number"),
        (lambda e: e["lanelets"][0].update(lights=[8]), r"lanelet 1: lights: there is no light 8"),
        (lambda e: e["lanelets"][0].update(left=[[0, 1]]), r"lanelet 1: left, right: expected at least two points"),
        (lambda e: e["lanelets"][0].update(left=[[0, 1], [2, None]]), r"lanelet 1: left: expected points \[x, y\]"),
        (
            lambda e: e["lanelets"][0].update(stop_line=[[0, 1], [0, 1]]),
            r"lanelet 1: stop_line: expected two different",
        ),
        (lambda e: e["lanelets"][0].update(successor="3"), r"lanelet 1: successor: expected a list"),
        (lambda e: e["lanelets"][1].update(id=1), r"lanelets: expected unique ids, 1 occurs twice"),
        (lambda e: e.pop("lanelets"), r"map: lanelets: expected a list, got None"),
    ]:
        with subtests.test(message):
            entry = crossing()
            change(entry)
            with pytest.raises(InputError, match=message):
                road_of(entry, "map", steps=STEPS)


# The reader of NGSIM windows, on files written by hand


def test_rows_become_states_on_a_common_grid(tmp_path):
    windows = ngsim_windows(write_ngsim(tmp_path, rows() + rows("B"), {"A": crossing(), "B": crossing()}))
    assert windows.names == ("A", "B")
    traffic = windows.read("A")
    assert traffic.vehicles.id.tolist() == ["1", "2", "3"]
    assert traffic.vehicles.label.tolist() == ["car", "car", "truck"]  # of its length
    np.testing.assert_allclose(traffic.vehicles.time, 0.1 * np.arange(12))
    np.testing.assert_allclose(traffic.vehicles.position[7], [[-33.0, 4.0], [-3.0, 0.0], [-26.5, 0.0]])
    np.testing.assert_allclose(traffic.vehicles.velocity[7], [[10.0, 0.0], [0.0, 0.0], [5.0, 0.0]])
    assert traffic.vehicles.present[:, 2].tolist() == [False] * 5 + [True] * 7
    np.testing.assert_allclose(
        traffic.vehicles.position[0, 2], traffic.vehicles.position[5, 2]
    )  # of the nearest moment where absent
    assert (traffic.vehicles.size[:, 2] > 1).all()


def test_columns_come_in_any_order_and_without_compression(tmp_path):
    names = HEADER.split(",")
    turned = [",".join(row.split(",")[::-1]) for row in rows()]
    (tmp_path / "windows.csv").write_text("\n".join([",".join(names[::-1]), *turned]))
    traffic = ngsim_windows(tmp_path, "none").read("A")
    np.testing.assert_allclose(traffic.vehicles.position[3, 0], [-37.0, 4.0])
    assert traffic.road_map is None


def test_a_window_of_one_moment_and_an_unknown_one_are_errors_and_late_steps_keep_the_phase(tmp_path):
    late = [row.replace(f",{k},car", f",{k + 10},car") for k in range(12) for row in rows() if f",{k},car" in row]
    colours = ngsim_windows(write_ngsim(tmp_path, late, {"A": crossing()})).read("A").colours["light-7"]
    assert colours.tolist() == ["green"] * 3 + ["amber"] * 5 + ["red"] * 4
    windows = ngsim_windows(write_ngsim(tmp_path, rows(steps=1), {"A": crossing()}))
    with pytest.raises(InputError, match=r"windows.csv.gz: A: expected at least two moments, got 1"):
        windows.read("A")
    with pytest.raises(InputError, match=r"unknown recording 'B'"):
        TrafficScenes(windows, true_scene).scene("B")


def test_what_is_wrong_in_a_row_is_named(tmp_path, subtests):
    for line, message in [
        ("X,A,4,0,car,1,2,0,1,,4.5", r"windows.csv.gz: line 33: expected 12 columns, got 11"),
        ("X,A,4,0,car,east,2,0,1,,4.5,2", r"line 33: x: expected a finite number, got 'east'"),
        ("X,A,4,0.5,car,1,2,0,1,,4.5,2", r"line 33: step: expected a whole number from 0"),
        ("X,A,4,0,car,1,2,0,1,,0,2", r"line 33: length: expected a number above 0, got 0"),
        ("X,A,,0,car,1,2,0,1,,4,2", r"line 33: scenario, id, type: expected a value"),
        ("X,A,1,0,car,1,2,0,1,,4.5,2", r"A: vehicle 1: expected one state at 0.0 s, there are more"),
    ]:
        with subtests.test(message):
            write_ngsim(tmp_path, [*rows(), line], {"A": crossing()})
            with pytest.raises(InputError, match=message):
                ngsim_windows(tmp_path).read("A")


def test_wrong_columns_empty_files_and_missing_files_are_errors(tmp_path):
    with pytest.raises(InputError, match=r"expected windows.csv.gz or windows.csv, there is neither"):
        ngsim_windows(tmp_path)
    write_ngsim(tmp_path, rows(), header=HEADER.replace("yaw", "heading"))
    with pytest.raises(InputError, match=r"windows.csv.gz: yaw: expected this column, the file has site, scenario"):
        ngsim_windows(tmp_path)
    write_ngsim(tmp_path, [])
    with pytest.raises(InputError, match=r"windows.csv.gz: expected rows, there are none"):
        ngsim_windows(tmp_path)
    (tmp_path / "windows.csv.gz").write_bytes(gzip.compress(b""))
    with pytest.raises(InputError, match=r"scenario: expected this column, the file has none"):
        ngsim_windows(tmp_path)
    (tmp_path / "windows.csv.gz").write_bytes(b"not compressed")
    with pytest.raises(InputError, match=r"windows.csv.gz: expected text in UTF-8, compressed by gzip"):
        ngsim_windows(tmp_path)


def test_a_window_without_a_map_is_an_error_that_says_how_to_go_without(tmp_path):
    write_ngsim(tmp_path, rows(), {"B": crossing()})
    with pytest.raises(InputError, match=r"maps.json.gz: A: expected a map, there is none; --road none goes without"):
        ngsim_windows(tmp_path).read("A")
    assert ngsim_windows(tmp_path, "none").read("A").road_map is None
    (tmp_path / "maps.json.gz").unlink()
    with pytest.raises(InputError, match=r"expected maps.json.gz or maps.json, there is neither; --road none"):
        ngsim_windows(tmp_path).read("A")
    (tmp_path / "maps.json").write_text("{")
    with pytest.raises(InputError, match=r"maps.json: expected JSON"):
        ngsim_windows(tmp_path).read("A")


# Recordings that hold the same traffic at a shift of time and place, and the middle of long ones


def traffic(name: str, seed: int, moments: int = 30, vehicles: int = 4) -> RecordedTraffic:
    rng = np.random.default_rng(seed)
    velocity = 10 + rng.normal(0, 0.3, (moments, vehicles, 2)).cumsum(axis=0)
    names = np.array([str(n) for n in range(vehicles)])
    states = SimulatedTrajectories(
        names,
        np.full(vehicles, "car"),
        np.tile([4.5, 1.8, 1.5], (vehicles, 1)),
        0.1 * np.arange(moments),
        np.cumsum(0.1 * velocity, axis=0),
        velocity,
        np.arctan2(velocity[..., 1], velocity[..., 0]),
        np.ones((moments, vehicles), dtype=np.bool_),
    )
    return RecordedTraffic(name, states)


def with_velocity(recording: RecordedTraffic, velocity: FloatArray) -> RecordedTraffic:
    return replace(recording, vehicles=replace(recording.vehicles, velocity=velocity))


def test_windows_are_one_group_by_the_same_motion_and_not_by_chance():
    whole = traffic("whole", seed=1)
    late = replace(whole.moments(slice(15, None)), name="late")
    late = replace(late, vehicles=replace(late.vehicles, position=late.vehicles.position + 100.0))
    early = replace(whole.moments(slice(0, SHARED_MOMENTS + 2)), name="early")
    found = overlapping([late, traffic("other", seed=2), whole, early])
    assert found == {"late": "late", "other": "other", "whole": "late", "early": "late"}
    one, other = traffic("one", seed=1), traffic("other", seed=2)
    velocity = other.vehicles.velocity.copy()
    velocity[:, 0] = one.vehicles.velocity[:, 0]
    assert overlapping([one, with_velocity(other, velocity)]) == {"one": "one", "other": "other"}
    steady = [with_velocity(each, np.ones_like(velocity)) for each in (one, other)]
    assert overlapping(steady) == {"one": "one", "other": "other"}
    assert overlapping([traffic("short", seed=3, moments=SHARED_MOMENTS - 1)]) == {"short": "short"}


def test_the_middle_of_a_recording():
    one = Recordings(("one",), lambda name: traffic(name, seed=1, moments=101))
    whole = one.read("one").vehicles.position
    for longest, moments, first in ((4.0, 41, 30), (np.inf, 101, 0)):
        found = one.middle(longest).read("one")
        assert len(found) == moments
        assert (found.vehicles.position == whole[first : first + moments]).all()
        assert found.vehicles.time[0] == 0.0
