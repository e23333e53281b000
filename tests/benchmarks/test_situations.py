"""Situations of hidden objects: who leads, who halts, starts, turns, and who is at red; figures by situation."""

from collections.abc import Mapping

import numpy as np
import pytest

from benchmarks.gap_runs import CurveRun, Judgement, LivedRun, Prediction, by_hindsight, judgement
from benchmarks.gaps import situation_figures
from benchmarks.situations import route_of, situations_of
from pipelines.learning.interactions import JudgedRun
from saga_fg import Annotations, Boxes, Detections, Frame, Scene, Tracks
from saga_fg.learning.labelled_scene import Gap, LabelledScene
from saga_fg.numerics.arrays import FloatArray
from saga_fg.types.road_map import RoadMap, StopLine, TrafficLight

TIMES = 0.2 * np.arange(26)
GAP = Gap(0, 5, 16, 2.0, moving=True)  # hidden from 1 to 3.2 s
LINE = StopLine("line", (30.0, 3.0), (30.0, -3.0), "light")  # across the x axis, for those who go in its direction
ROAD = RoadMap((TrafficLight("light", (42.0, 0.0)),), (LINE,))


def along(x: FloatArray, y: float = 0.0) -> FloatArray:
    return np.column_stack([x, np.full(len(TIMES), y)])


def labelled(
    ways: Mapping[str, FloatArray],
    unseen: tuple[str, ...] = (),
    colour: str | None = None,
    road: RoadMap | None = ROAD,
    label: str = "car",
    walks: str = "",
) -> LabelledScene:
    """Objects by their positions (K, 2), all detected but those unseen; the hidden one is "a", `walks` a person."""
    truth, frames = [], []
    for k, time in enumerate(TIMES.tolist()):
        step = {name: way[min(k + 1, 25)] - way[max(k - 1, 0)] for name, way in ways.items()}
        speed = [v / (0.2 * (min(k + 1, 25) - max(k - 1, 0))) for v in step.values()]
        yaw = [np.arctan2(v[1], v[0]) for v in step.values()]
        position = [(*way[k], 1.0) for way in ways.values()]
        labels = ["pedestrian" if name == walks else label for name in ways]
        boxes = Boxes.of(labels, position, None, yaw, speed)
        truth.append(Annotations(np.array(list(ways)), boxes, np.ones(len(ways), dtype=bool)))
        detected = boxes.select(np.array([name not in unseen for name in ways]))
        if colour is not None:
            light = Boxes.of([f"traffic_light_{colour}"], [[42.0, 0.0, 5.0]])
            detected = Boxes.concatenate([detected, light])
        found = Detections(detected, np.ones(len(detected)))
        frames.append(Frame(time, "lidar", found, road_map=road if k == 0 else None))
    poses = np.tile(np.eye(4), (len(TIMES), 1, 1))
    return LabelledScene.from_scene(Scene("drawn", TIMES, poses, ("",) * len(TIMES), frames, truth), {})


def found(ways: Mapping[str, FloatArray], gap: Gap = GAP, **how: object) -> Mapping[float, frozenset[str]]:
    return situations_of(labelled(ways, **how), gap)  # type: ignore[arg-type]


STEADY = along(5 * TIMES)


def test_leaders_are_ahead_on_the_way_round_bends_and_never_inside():
    ahead = along(5 * TIMES + 12)
    assert found({"a": STEADY, "b": ahead}) == {h: {"all", "moving", "visible leader"} for h in (1.0, 2.0)}
    assert found({"a": STEADY, "b": ahead}, unseen=("b",))[2.0] == {"all", "moving"}
    for other in (along(5 * TIMES + 12, 3.5), along(5 * TIMES - 12), along(5 * TIMES + 60), along(70 - 5 * TIMES)):
        assert found({"a": STEADY, "b": other})[2.0] == {"all", "moving", "free"}
    assert found({"a": STEADY, "b": ahead}, label="pedestrian")[2.0] == {"all", "moving"}
    assert "free" in found({"a": STEADY, "b": along(5 * TIMES + 0.3)})[1.0]
    angle = 0.25 * TIMES
    a, b = (20 * np.column_stack([np.sin(s), 1 - np.cos(s)]) for s in (angle, angle + 0.7))
    assert found({"a": a, "b": b})[2.0] == {"all", "moving", "visible leader", "turning"}
    assert "turning" not in found({"a": a, "b": b})[1.0], "by 14 degrees then"


def test_halting_and_starting_are_told_at_the_end():
    braked = along(np.where(TIMES < 2.5, 5 * TIMES, 12.5))
    assert "halting" not in found({"a": braked})[1.0]
    assert "halting" in found({"a": braked})[2.0]
    started = along(np.where(TIMES < 2.5, 0.0, 5 * (TIMES - 2.5)))
    assert "starting" in found({"a": started})[2.0]
    parked = found({"a": along(0 * TIMES)}, Gap(0, 5, 16, 2.0, moving=False))
    assert parked[2.0] == {"all", "stationary", "free"}


def test_at_red_is_who_comes_to_the_line_while_it_is_closed():
    assert "at red" in found({"a": STEADY}, colour="red")[1.0]
    assert "at red" in found({"a": along(0 * TIMES + 10)}, colour="amber")[1.0], "stands behind the line"
    assert "at red" not in found({"a": STEADY}, colour="green")[1.0]
    assert "at red" not in found({"a": STEADY})[1.0], "nobody told the colour"
    assert "at red" not in found({"a": STEADY}, colour="red", road=None)[1.0], "there is no map"
    assert "at red" not in found({"a": STEADY}, colour="red", road=RoadMap())[1.0], "nothing is in it"
    assert "at red" not in found({"a": along(60 - 5 * TIMES)}, colour="red")[1.0], "it comes from the other side"
    assert "at red" not in found({"a": along(5 * TIMES + 40)}, colour="red")[1.0], "it is beyond the line"


def crosswise(y: FloatArray, x: float = 12.0) -> FloatArray:
    return np.column_stack([np.full(len(TIMES), x), y])


def test_who_waits_and_who_goes_is_told_by_who_comes_first_where_ways_meet():
    halts = along(np.where(TIMES < 1.6, 5 * TIMES, np.where(TIMES < 3.0, 8.0, 8.0 + 6 * (TIMES - 3.0))))
    passes = crosswise(8 * (TIMES - 2.4))
    waiting = found({"a": halts, "b": passes})
    assert "waiting" not in waiting[1.0], "the other one is there after 1.4 s"
    assert {"waiting"} <= waiting[2.0] - {"going"}
    assert "waiting" not in found({"a": STEADY, "b": crosswise(5 * (TIMES - 1.5))})[2.0], "it never slowed down"
    assert "going" in found({"a": STEADY, "b": crosswise(3 * (TIMES - 4.0))})[2.0]
    late = crosswise(np.where(TIMES < 4.8, -20.0, 100 * (TIMES - 5.0)))
    for other in (
        crosswise(3 * (TIMES - 4.0), x=40.0),
        along(5 * TIMES + 12),
        along(5 * TIMES - 12),
        late - [0.0, 80.0],
    ):
        assert not found({"a": STEADY, "b": other})[2.0] & {"waiting", "going", "merging"}


def test_merging_are_those_who_go_on_in_one_direction():
    y = np.interp(TIMES, [0.0, 2.0, 4.5], [3.5, 3.5, 0.0])
    joins = np.column_stack([5 * TIMES - 8, y])
    assert {"going", "merging"} <= found({"a": STEADY, "b": joins})[2.0]
    assert "merging" in found({"a": joins, "b": STEADY})[2.0]
    assert "merging" not in found({"a": STEADY, "b": crosswise(3 * (TIMES - 4.0))})[2.0]


def test_people_cross_the_ways_of_vehicles_which_wait_for_them():
    halts = along(np.where(TIMES < 1.6, 5 * TIMES, np.where(TIMES < 3.0, 8.0, 8.0 + 6 * (TIMES - 3.0))))
    walks = crosswise(2 * (TIMES - 3.2))
    waiting = found({"a": halts, "b": walks}, walks="b")
    assert "for people" not in waiting[1.0], "nobody is there yet"
    assert waiting[2.0] & {"for people", "waiting", "people crossing"} == {"for people"}
    assert "people crossing" in found({"a": walks, "b": halts}, walks="a")[2.0]
    assert not found({"a": walks, "b": halts}, label="pedestrian")[2.0] & {"waiting", "people crossing"}, "all walk"


def test_a_hidden_track_goes_on_in_a_curve_and_stops_where_it_brakes():
    scene = labelled({"a": STEADY})

    def ends(speed: FloatArray, turn: float = 0.0) -> FloatArray:
        """The last place of the curve, and that of the motion with the acceleration that fades."""
        tracks, x = [], np.cumsum(0.2 * speed)
        for k, time in enumerate(TIMES.tolist()):
            course = turn * min(time, 1.0)
            velocity = speed[k] * np.array([np.cos(course), np.sin(course)])
            boxes = Boxes.of(["car"], [[x[k], 0.0, 1.0]], velocity=[velocity])
            seen = np.array([max(0.0, time - 1.0)])
            tracks.append(Tracks(time, np.array([7]), boxes, np.ones(1), np.eye(2)[None], np.eye(2)[None], seen))
        run = CurveRun(scene, tracks)
        place = run.position(7, 25)
        assert place is not None
        return place - [x[5], 0.0]

    np.testing.assert_allclose(ends(np.full(26, 5.0)), [20.0, 0.0], atol=1e-6)
    faster = 5.0 + np.minimum(TIMES, 1.0)
    t = 4.0
    np.testing.assert_allclose(ends(faster)[0], 6 * t + 4 * (t - 4 * (1 - np.exp(-t / 4))), rtol=1e-3)
    braked = np.maximum(5.0 - 3 * np.minimum(TIMES, 1.0), 0.0)
    stops = 4 * np.log(3 / (3 - 2 / 4))
    np.testing.assert_allclose(ends(braked)[0], 2 * stops - 3 * 4 * (stops - 4 * (1 - np.exp(-stops / 4))), atol=0.05)
    turned = ends(np.full(26, 5.0), turn=0.2)
    assert np.arctan2(turned[1], turned[0]) == pytest.approx(0.2 + 0.2 * 4 / 2, abs=0.02)


def test_hindsight_has_the_lower_error_at_each_length():
    ours, alone = situations_run("saga", "1", "1", [1.0, 3.0]), situations_run("trails alone", "1", "1", [2.0, 0.5])
    (best,) = by_hindsight([ours, alone, situations_run("kf", "1", "1", [0.1, 0.1])])
    assert [one.at[1.0] for one in best.outcomes] == [1.0, 0.5]
    assert [one.predicted[1.0].error for one in best.outcomes] == [1.0, 0.5]
    assert by_hindsight([ours]) == []


def test_an_object_without_direction_has_no_route():
    scene = labelled({"a": along(0 * TIMES)})
    scene.yaw[:] = np.nan
    assert route_of(scene, 0, 5) is None
    assert situations_of(scene, GAP)[1.0] == {"all", "moving"}


def test_predictions_are_judged_by_their_own_covariance():
    scene = labelled({"a": STEADY})
    tracks = []
    for k, time in enumerate(TIMES.tolist()):
        boxes = Boxes.of(["car"], [[*(STEADY[k] + [3.0 if 5 < k < 16 else 0.0, 0.0]), 1.0]], velocity=[[5.0, 0.0]])
        wide = np.diag([4.0, 1.0])[None]
        seen = np.array([0.0 if not 5 < k < 16 else 1.0])
        tracks.append(Tracks(time, np.array([7]), boxes, np.ones(1), wide, wide, seen))
    predicted = judgement(JudgedRun(scene, tracks), GAP).predicted
    assert set(predicted) == {1.0, 2.0}
    assert predicted[2.0].error == pytest.approx(3.0)
    assert predicted[2.0].nees == pytest.approx(2.25)
    assert predicted[2.0].nll == pytest.approx(1.125 + np.log(2 * np.pi * 2.0))


def situations_run(name: str, recording: str, cluster: str, errors: list[float]) -> LivedRun:
    outcomes = tuple(
        Judgement({1.0: e}, {1.0: Prediction(e, e * e, e)} if np.isfinite(e) else {}, True, True, True, e)
        for e in errors
    )
    n, at = len(errors), {1.0: frozenset({"all", "free"})}
    gaps = (Gap(0, 5, 11, 1.0, moving=True, run=1),) * n
    return LivedRun(recording, cluster, name, gaps, ("car",) * n, (at,) * n, outcomes, "kept", None)


def test_figures_are_paired_and_overlapping_recordings_are_one():
    nan = float("nan")
    ours = [
        situations_run("saga", r, c, e)
        for r, c, e in (("1", "1", [1.0, 1.0, nan]), ("2", "2", [1.0, 1.0]), ("3", "2", [1.0]))
    ]
    theirs = [
        situations_run("kf", r, c, e)
        for r, c, e in (("1", "1", [2.0, 2.0, 9.0]), ("2", "2", [2.0, 2.0]), ("3", "2", [2.0]))
    ]
    saga, kf = situation_figures([*ours, *theirs], "kf")[:2]
    assert (saga.situation, saga.length, saga.contender, saga.gaps, saga.lost) == ("all", 1.0, "saga", 5, 1)
    assert (kf.gaps, kf.lost, kf.error_change) == (6, 0, None)
    assert saga.error_change.estimate == pytest.approx(-0.5), "over gaps that both have"
    assert np.isnan(saga.error_change.low), "two clusters are too few for an interval"
    assert saga.coverage == {0.5: 1.0, 0.9: 1.0}
    assert kf.coverage == {0.5: 0.0, 0.9: pytest.approx(5 / 6)}
    assert {f.situation for f in situation_figures([*ours, *theirs], "kf")} == {"all", "free"}
    assert situation_figures([], "kf") == []
