"""Sensors, and the graph of a scene."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from saga_fg import (
    Boxes,
    ConstantAcceleration,
    ConstantVelocity,
    Detections,
    Edges,
    InputError,
    NodeType,
    RandomWalk,
    SceneGraph,
    Sensor,
)
from saga_fg.model.sensor import Extrinsics, FieldOfView, NoiseModel, ScoreCalibration
from saga_fg.numerics.geometry import transform_points, yaw_transform

metres = st.floats(-200, 200)


def labels(*names):
    return np.array(names, dtype=np.str_)


def covariance(noise, position, probability=1.0, origin=(0.0, 0.0), label="car"):
    sensor = Sensor(noise={"default": noise})
    return sensor.position_covariance(labels(label), np.array([position]), np.array([probability]), np.array(origin))[0]


# noise


@given(metres, metres, st.tuples(metres, metres), st.floats(0.01, 1), st.floats(0, 0.1), st.floats(0, 0.1))
def test_the_covariance_formula(x, y, origin, position, range_noise, bearing_noise):
    offset = np.array([x, y]) - origin
    r = np.linalg.norm(offset)
    R = covariance(NoiseModel(position, range_noise, bearing_noise), (x, y), origin=origin)
    assert np.array_equal(R, R.T)
    if r > 1e-3:
        u = offset / r
        n = np.array([-u[1], u[0]])
        assert u @ R @ u == pytest.approx(position**2 + (range_noise * r) ** 2)
        assert n @ R @ n == pytest.approx(position**2 + (bearing_noise * r) ** 2)
        assert u @ R @ n == pytest.approx(0, abs=1e-9 * np.trace(R))
    else:
        assert np.allclose(R, position**2 * np.eye(2), rtol=1e-3)


def test_deviations_grow_as_the_score_falls_class_by_class():
    noise = NoiseModel(position=0.2, low_score_growth=1.5)
    assert covariance(noise, (5.0, 0.0), probability=1.0) == pytest.approx(0.04 * np.eye(2))
    assert covariance(noise, (5.0, 0.0), probability=0.4) == pytest.approx((0.2 * (1 + 1.5 * 0.6)) ** 2 * np.eye(2))
    sensor = Sensor(noise={"default": NoiseModel(velocity=0.5, low_score_growth=1.0)})
    seen = Detections(Boxes.of(["car", "car"], np.zeros((2, 3))), np.ones(2))
    velocity = sensor.detection_covariance(seen, None, np.array([1.0, 0.5]))[:, 2:, 2:]
    assert velocity == pytest.approx(np.stack([0.25 * np.eye(2), (0.5 * 1.5) ** 2 * np.eye(2)]))
    sensor = Sensor(noise={"car": NoiseModel(position=1.0), "default": NoiseModel(position=2.0)})
    assert sensor.deviations(labels("bus", "car", "bus"), "position").tolist() == [[2.0, 1.0, 2.0]]
    assert Sensor(noise={"car": NoiseModel()}).deviations(labels("bus"), "position").tolist() == [[0.3]]
    assert sensor.deviations(labels(), "position", "yaw").shape == (2, 0)
    none = np.empty((0, 2))
    assert sensor.position_covariance(labels(), none, np.empty(0), np.zeros(2)).shape == (0, 2, 2)


# scores


@given(st.floats(-1e300, 1e300))
def test_probabilities_are_never_certain(score):
    for kind in ("probability", "logit"):
        p = Sensor(score=kind).probability(np.array([score]), labels("car"))[0]
        assert 1e-3 <= p <= 1 - 1e-3


def test_scores_are_probabilities_or_logits_calibrated_class_by_class():
    assert Sensor().probability(np.array([0.25]), labels("car")) == pytest.approx([0.25])
    logits = np.array([-2.0, 0.0, 1.5])
    assert Sensor(score="logit").probability(logits, labels("a", "a", "b")) == pytest.approx(1 / (1 + np.exp(-logits)))
    calibration = {"car": ScoreCalibration(slope=2.0, offset=-1.0), "default": ScoreCalibration(offset=0.5)}
    sensor = Sensor(calibration=calibration)
    p = sensor.probability(np.array([0.7, 0.7]), labels("car", "bus"))
    logit = np.log(0.7 / 0.3)
    assert np.log(p / (1 - p)) == pytest.approx([2 * logit - 1, logit + 0.5])


def test_chances_differ_by_class_and_without_a_pose_everything_may_be_seen():
    sensor = Sensor(detection_probability=0.8, class_detection_probability={"pedestrian": 0.5})
    assert sensor.detection_chance(labels("car", "pedestrian")).tolist() == [0.8, 0.5]
    with pytest.raises(InputError, match=r"class_detection_probability\.car: expected a number from 0 to 1"):
        Sensor(class_detection_probability={"car": 1.5})
    assert Sensor().sees(np.array([[1e6, 0.0]]), None).tolist() == [True]


# field of view


@given(metres, metres, st.floats(-7, 7), st.floats(-3, 3), st.floats(-0.95, 0.95), st.floats(1, 79))
def test_the_field_of_view_turns_with_vehicle_and_mount(x, y, yaw, mount_yaw, azimuth, distance):
    view = FieldOfView(min_azimuth=-0.5, max_azimuth=0.7, max_range=40.0)
    sensor = Sensor(field_of_view=view, extrinsics=Extrinsics(x=1.5, y=-0.3, z=1.2, yaw=mount_yaw))
    world_T_ego = yaw_transform(x, y, 0.5, yaw)
    in_sensor = distance * np.array([[np.cos(azimuth), np.sin(azimuth), 0.0]])
    in_world = transform_points(world_T_ego @ sensor.extrinsics.ego_T_sensor, in_sensor)[:, :2]
    margin = min(abs(azimuth + 0.5), abs(azimuth - 0.7), abs(distance - 40))
    if margin > 1e-6:
        assert sensor.sees(in_world, world_T_ego).tolist() == [-0.5 <= azimuth <= 0.7 and distance <= 40]


def test_fields_of_view_go_across_the_seam_and_all_round():
    sensor = Sensor(field_of_view=FieldOfView(min_azimuth=3 * np.pi / 4, max_azimuth=5 * np.pi / 4))
    behind = np.array([[-10.0, 0.1], [-10.0, -0.1], [-10.0, 9.0], [-10.0, 11.0], [10.0, 0.0]])
    assert sensor.sees(behind, np.eye(4)).tolist() == [True, True, True, False, False]
    around = 20 * np.stack([np.cos(np.linspace(-4, 4, 50)), np.sin(np.linspace(-4, 4, 50))], axis=-1)
    assert Sensor().sees(around, np.eye(4)).all()


def test_extrinsics_are_finite(subtests):
    for key in ["x", "y", "z", "yaw"]:
        for value in [float("nan"), float("inf"), -float("inf")]:
            with (
                subtests.test(key=key, value=value),
                pytest.raises(InputError, match=f"^{key}: expected a finite number, got"),
            ):
                Extrinsics(**{key: value})


# The scene graph: edges fit their nodes, and what does not fit is named

CAR = NodeType("car", ConstantVelocity())
TRUCK = NodeType("truck", ConstantAcceleration())
LINE = NodeType("stop line", RandomWalk())


def edges(target=(0,), source=(1,), d_i=4, d_j=4, **columns):
    count = np.size(target)
    good = {
        "interaction": "pull",
        "target": target,
        "source": source,
        "rate": np.ones(count),
        "A_self": np.zeros((count, d_i, d_i)),
        "A_other": np.zeros((count, d_i, d_j)),
        "b": np.zeros((count, d_i)),
    }
    return Edges(**(good | columns))


def test_a_heterogeneous_graph():
    pulls = edges((0, 1), (1, 0))
    stops = edges((0, 2), (3, 3), rate=[0.5, 0.0], d_j=2)
    graph = SceneGraph([11, 5, 7, 9], (CAR, CAR, CAR, LINE), (pulls, stops))
    assert len(graph) == 4
    assert graph.nodes.tolist() == [11, 5, 7, 9]
    assert graph.dims.tolist() == [4, 4, 4, 2]
    assert graph.edge_count == 4
    assert len(pulls) == 2


def test_graphs_without_nodes_or_edges_and_read_only_columns():
    assert len(SceneGraph([], ())) == 0
    assert SceneGraph.of([1, 2], CAR).types == (CAR, CAR)
    empty = edges((), ())
    assert SceneGraph.of([1, 2], CAR, [empty]).edge_count == 0
    assert SceneGraph.of([1], TRUCK, [empty]).edge_count == 0  # no edge, so none that does not fit
    assert not edges().rate.flags.writeable
    assert not edges().target.flags.writeable
    assert not SceneGraph.of([1], CAR).nodes.flags.writeable


def test_wrong_edges_are_named(subtests):
    for columns, message in [
        ({"target": (0, 1)}, "edges of pull: source: expected 2 entries, got 1"),
        ({"target": 0}, "edges of pull: target: expected a list of integers, got 0"),
        ({"source": (0,)}, "edges of pull: node row 0 has an edge to itself"),
        ({"rate": [-0.5]}, r"edges of pull: rate\[0\]: expected a rate >= 0 in 1/s, got -0.5"),
        ({"rate": [1.0, 1.0]}, r"edges of pull: rate: expected shape \(1,\)"),
        ({"A_self": np.zeros((1, 4, 3))}, r"edges of pull: A_self: expected shape \(1, 4, 4\), got \(1, 4, 3\)"),
        ({"A_other": np.full((1, 4, 4), np.inf)}, r"edges of pull: A_other\[0, 0, 0\]: expected a finite number"),
        ({"b": np.zeros((1, 3))}, r"edges of pull: b: expected shape \(1, 4\)"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            edges(**columns)


def test_wrong_graphs_are_refused(subtests):
    for nodes, types, groups, message in [
        ([1, 1], (CAR, CAR), (), "nodes: expected unique ids, 1 occurs more than once"),
        ([1, 2], (CAR,), (), "types: expected 2 node types, got 1"),
        ([1, 2], (CAR, CAR), (edges((0,), (2,)),), "edges of pull: source: row 2 is outside 2 nodes"),
        ([1, 2], (CAR, CAR), (edges((-1, 0), (1, 1)),), "edges of pull: target: row -1 is outside 2 nodes"),
        ([8, 9], (CAR, TRUCK), (edges((0,), (1,)),), "source: node 9 has 6 components, the interaction 4"),
        ([8, 9], (CAR, TRUCK), (edges((1,), (0,)),), "target: node 9 has 6 components, the interaction 4"),
    ]:
        with subtests.test(message), pytest.raises(InputError, match=message):
            SceneGraph(nodes, types, groups)


def test_diffusion_may_be_scaled_node_by_node():
    assert SceneGraph.of([1, 2], CAR).diffusion_scale.tolist() == [1.0, 1.0]
    assert SceneGraph([1, 2], (CAR, CAR), (), [0.5, 2.0]).diffusion_scale.tolist() == [0.5, 2.0]
    for scale, message in (
        ([0.5], r"diffusion_scale: expected shape \(2,\)"),
        ([0.5, 0.0], r"diffusion_scale\[1\]: expected a factor > 0, got 0"),
        ([np.nan, 1.0], r"diffusion_scale\[0\]: expected a finite number"),
    ):
        with pytest.raises(InputError, match=message):
            SceneGraph([1, 2], (CAR, CAR), (), scale)


def test_a_part_of_a_graph_keeps_the_edges_within_it():
    ring = edges((0, 1, 2), (1, 2, 0), rate=[0.1, 0.2, 0.3])
    graph = SceneGraph(np.array([7, 5, 9]), (CAR,) * 3, (ring,), np.array([1.0, 2.0, 3.0]))
    part = graph.only(np.array([9, 5, 100]))
    assert part.nodes.tolist() == [5, 9]
    assert part.diffusion_scale.tolist() == [2.0, 3.0]
    (group,) = part.edges
    assert (group.target.tolist(), group.source.tolist(), group.rate.tolist()) == ([0], [1], [0.2])
