"""Trees of values: what comes back is what was written, whatever it is, and nothing else is made."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factors import PlanarPose, RangeBearing
from pipelines.config import load_config
from pipelines.serving.state import TreeWriter, read_tree
from saga_fg import Detection, Detections, Frame, InputError, SceneGraph
from saga_fg.estimators import GraphFilter, Measurements, Observations
from saga_fg.graph import OBJECT, GraphError, NewVariable, SceneFactorGraph
from saga_fg.graph.scene_factor_graph import GraphRecord
from saga_fg.model.discretisation import discretise
from saga_fg.model.motion import ConstantVelocity, NodeType
from saga_fg.model.nonlinear_interactions import SocialForce
from saga_fg.model.scene_graph import NonlinearEdges
from saga_fg.tracking.settings import TrackerSettings
from saga_fg.tracking.traffic import SpeedPrior


def again(value: Any) -> Any:
    tree = TreeWriter(value)
    return read_tree(json.loads(json.dumps(tree.nodes)), bytes(tree.arrays))


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.lists(inner, max_size=3).map(tuple)
        | st.dictionaries(st.text(max_size=3) | st.integers(), inner, max_size=3)
    ),
    max_leaves=20,
)


def same(a: Any, b: Any) -> bool:
    if type(a) is not type(b):
        return False
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    return bool(a == b) and (not isinstance(a, float) or math.copysign(1, a) == math.copysign(1, b))


@given(VALUES)
def test_plain_values_come_back_with_their_types(value: Any):
    assert same(again(value), value)


def test_infinities_and_nan_come_back():
    low, high, none = again((-math.inf, math.inf, math.nan))
    assert (low, high) == (-math.inf, math.inf)
    assert math.isnan(none)


ARRAYS: list[np.ndarray[Any, Any]] = [
    np.arange(6.0).reshape(2, 3),
    np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    np.arange(24)[::3],
    np.array(["car", "bücher"]),
    np.empty((0, 3)),
    np.empty(0, dtype="<U1"),
    np.array([True, False]),
    np.array(3.5),
    np.array([np.nan, np.inf]),
]


def test_arrays_come_back_with_type_shape_and_order():
    for array in ARRAYS:
        back = again((1, array))[1]
        np.testing.assert_array_equal(back, array)
        assert (back.dtype, back.shape) == (array.dtype, array.shape)
        assert back.flags.f_contiguous == np.ascontiguousarray(array).flags.f_contiguous or array.flags.f_contiguous
        back[...] = back  # writeable, as it was
        array.flags.writeable = False
        assert not again(array).flags.writeable


def test_what_is_shared_stays_shared():
    shared = np.arange(3.0)
    first, (second,), scalar = again([shared, [shared], np.float64(2.5)])
    assert first is second
    assert type(scalar) is np.float64


def test_objects_are_made_again_by_their_constructors():
    settings = TrackerSettings(estimator="fixed-lag")
    assert again(settings.classes) == settings.classes
    assert again(ConstantVelocity(3.0)) == ConstantVelocity(3.0)
    expected = SpeedPrior(np.zeros(1), np.ones(1), np.ones(1))
    assert type(again(expected)) is SpeedPrior
    tree = TreeWriter(ConstantVelocity(3.0))
    tree.nodes[0] = -1.0
    with pytest.raises(InputError, match="acceleration_noise"):
        read_tree(tree.nodes, b"")


UNWRITTEN: list[list[Any]] = [
    [],
    [{"object": ["os", "system"], "parts": {}}],
    [{"object": ["pathlib", "Path"], "parts": {}}],
    [{"object": ["saga_fg.tracking.tracker", "np"], "parts": {}}],
    [{"object": ["saga_fg.tracking.tracker", "InputError"], "parts": {}}],
    [{"object": ["saga_fg.errors", "InputError"], "parts": {}}],
    [{"object": ["saga_fg.types.frame", "Frame.__init__"], "parts": {}}],
    [{"object": ["saga_fg.no_such_module", "Frame"], "parts": {}}],
    [{"list": [0]}],
    [1, {"list": [-1]}],
    [{"pickle": "gASV"}],
    [{"array": ["|O", [1], "C", True, 0]}],
    [{"array": ["<f8", [1000000000], "C", True, 0]}],
    [{"array": ["<f8", [-1], "C", True, 0]}],
    [{"array": ["<f8", [1], "C", True, -8]}],
    [1, {"graph": 0}],
    [1, {"method": [0, "residual"]}],
    [{"object": ["saga_fg.tracking.settings", "TrackerSettings"], "parts": {}}, {"method": [0, "__init__"]}],
]


def test_what_no_writer_writes_is_refused():
    for nodes in UNWRITTEN:
        with pytest.raises(InputError):
            read_tree(nodes, bytes(8))


def test_what_cannot_be_written_is_refused():
    circle: list[Any] = []
    circle.append(circle)
    for value in (circle, object(), Path("x"), np.array([None]), {1, 2}, lambda: 0):
        with pytest.raises(InputError):
            TreeWriter(value)


def frame(k: float) -> Frame:
    rng = np.random.default_rng(int(2 * k))
    places = np.array([[8.0 * k / 10 + 12 * i, 3.0 * i, 0.0] for i in range(4)]) + rng.normal(0, 0.2, (4, 3))
    return Frame(k / 10, "lidar", Detections.of([Detection("car", (x, y, z)) for x, y, z in places.tolist()]))


@pytest.mark.parametrize(
    ("method", "estimator"), [("saga", "kalman"), ("kf", "kalman"), ("saga", "isam2"), ("saga", "fixed-lag")]
)
def test_a_tracker_goes_on_from_its_written_snapshot_to_the_last_bit(method: Any, estimator: Any):
    config = load_config("file")
    config = replace(config, tracker=replace(config.tracker, estimator=estimator))
    first, second = config.new_tracker(method), config.new_tracker(method)
    for k in range(12):
        first.step(frame(k))
    second.restore(again(first.snapshot()))
    for k in (12, 13, 11.5, 14, 15, 16):  # one of them late
        one, other = first.step(frame(k)), second.step(frame(k))
        np.testing.assert_array_equal(one.id, other.id)
        np.testing.assert_array_equal(one.boxes.position, other.boxes.position)
        np.testing.assert_array_equal(one.position_covariance, other.position_covariance)


CAR = NodeType("car", ConstantVelocity(0.5))
NODES = [1, 2, 3]


def drive(estimator: GraphFilter, seeds: range) -> GraphFilter:
    """Two cars that avoid each other, one who is alone; nonlinear and late measurements."""
    away = NonlinearEdges(SocialForce(), [0, 1], [1, 0], np.ones(2), np.zeros((2, 1, 4)))
    graph = SceneGraph(np.array(NODES), (CAR,) * 3, nonlinear=(away,))
    for seed in seeds:
        rng = np.random.default_rng(seed)
        estimator.predict(discretise(graph, 0.2))
        z = estimator.mean(NODES)[:, :2] + rng.normal(0, 0.1, (3, 2))
        estimator.update(Measurements(NODES, z, np.eye(2, 4), 0.01 * np.eye(2)))
        radar = RangeBearing(4, sensor_pose=(20.0, 0.0, 0.0))
        estimator.update(Observations([3], radar.predict(estimator.mean([3])), radar, 0.01 * np.eye(2)))
        late = estimator.time - (0.1 if estimator.lag else 0.0)
        estimator.update(Measurements([1], z[:1], np.eye(2, 4), np.eye(2)), time=late)
    return estimator


@pytest.mark.parametrize("lag", [0.0, 0.5])
def test_a_running_graph_goes_on_from_its_written_state(lag: float):
    first, second = (GraphFilter(lag=lag) for _ in range(2))
    first.add(NODES, [[0, 0, 1, 0], [2, 0.1, -1, 0], [9, 9, 0, 0]], np.stack([np.eye(4)] * 3))
    second.restore(again(drive(first, range(4)).snapshot()))
    for estimator in (first, second):
        drive(estimator, range(4, 8))
    np.testing.assert_array_equal(first.joint_mean(NODES), second.joint_mean(NODES))
    np.testing.assert_array_equal(first.joint_covariance(NODES), second.joint_covariance(NODES))


def record() -> GraphRecord:
    estimator = GraphFilter()
    estimator.add(NODES, np.zeros((3, 4)), np.stack([np.eye(4)] * 3))
    return GraphRecord.from_graph(estimator.graph())


def test_a_graph_whose_parts_do_not_fit_is_refused():
    sound = record()
    changes: list[tuple[dict[str, Any], str]] = [
        ({"elimination": "lu"}, "elimination"),
        ({"values": (np.zeros(3), *sound.values[1:])}, "expected a state"),
        ({"values": (np.full(4, np.nan), *sound.values[1:])}, "finite"),
        ({"variables": (sound.variables[0],) * 3}, "a key of its own"),
        ({"variables": (replace(sound.variables[0], id=7), *sound.variables[1:])}, "a key of its own"),
        ({"variables": (replace(sound.variables[0], type=PlanarPose()), *sound.variables[1:])}, "vector"),
        ({"groups": {0: replace(sound.groups[0], active=np.ones(2, dtype=bool))}}, "one truth value a row"),
        ({"variables": (), "base": (), "values": (), "births": ()}, "never added"),
    ]
    for change, message in changes:
        with pytest.raises(GraphError, match=message):
            replace(sound, **change).restored()


def test_factors_that_are_more_than_arrays_are_refused_by_name():
    graph = SceneFactorGraph()
    graph.advance(0.0)
    (key,) = graph.add_variables("start", [NewVariable(OBJECT, 1, np.zeros(2))])
    graph.add_factors("start", [gtsam.PriorFactorVector(key, np.zeros(2), gtsam.noiseModel.Unit.Create(2))])
    with pytest.raises(GraphError, match="provider start: PriorFactorVector: it can't be written to a file"):
        TreeWriter(graph)
