"""Road maps of lanelets: lanes, stop lines, and which lights govern them, on crossings written by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.recordings.lanelets import road_of
from saga_fg.errors import InputError
from tests.benchmarks.recordings.ngsim_example import crossing, lanelet

STEPS = np.arange(2)


def test_lanelets_without_a_branch_are_one_lane_and_lines_side_by_side_one_line() -> None:
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


def test_a_branch_ends_a_lane_and_a_circle_is_one() -> None:
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


def test_a_line_is_governed_by_the_lights_of_the_movements_possible_from_it(subtests: pytest.Subtests) -> None:
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


def test_a_signal_without_a_cycle_is_an_error_that_says_how_to_go_without() -> None:
    entry = crossing()
    del entry["lights"][0]["cycle"]
    with pytest.raises(InputError, match=r"map: light 7: cycle: expected \[colour, steps\], .*; --road map leaves"):
        road_of(entry, "map", steps=STEPS)
    road, cycles = road_of(entry, "map", steps=None)
    assert len(road.stop_lines) == 1
    assert cycles == {}


def test_what_is_wrong_in_a_map_is_named(subtests: pytest.Subtests) -> None:
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
