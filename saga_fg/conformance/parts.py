"""Conformance of the parts of a tracker that users bring: one import, one call, for each kind.

    from saga_fg.conformance import check_motion

    check_motion(Drag())

A check asks the part alone for what its role promises, by random objects, and then tracks a few objects with it. It
raises `AssertionError`, or `InputError`, that names the member and what was expected.
"""

import copy
from typing import Any, NamedTuple

import numpy as np

from factors import Vector
from factors.manifolds import central_differences
from saga_fg.conformance.programs import CAR, node_table
from saga_fg.graph import FactorProvider
from saga_fg.model import (
    AccelerationLaw,
    ClassModel,
    EdgeRule,
    Interaction,
    Motion,
    NodeTable,
    NodeType,
    NonlinearMotion,
    Pairs,
    Sensor,
    build_graph,
)
from saga_fg.parts import KINDS
from saga_fg.tracking import (
    AssociationCost,
    AssociationProblem,
    AssociationSettings,
    ClassSettings,
    Tracker,
    TrackerSettings,
)
from saga_fg.types import Boxes, Detections, Frame

OBJECTS, MOMENTS = 6, 8  # that are tracked
_SLOPE = 1e-5  # relative difference of a derivative from finite differences


def check_motion(motion: Motion) -> None:
    """Components, matrices and, of a nonlinear motion, the flow and its derivative; then cars that move so are tracked.

    A motion must be hashable, as a frozen dataclass is: classes that move alike share one.
    """
    KINDS[Motion].require("motion", motion)
    node_type = NodeType("car", motion)
    node_type.index(("x", "y"))
    if isinstance(motion, NonlinearMotion):
        x = np.random.default_rng(0).normal(size=(5, node_type.dim))
        same("flow(x, 0)", motion.flow(x, 0.0), x, 1e-9)
        (slope,) = central_differences(lambda state: motion.flow(state, 0.3), [x], [Vector(node_type.dim)])
        same("flow_jacobian", motion.flow_jacobian(x, 0.3), slope, _SLOPE)
    tracked(TrackerSettings(classes={"default": ClassSettings(motion=motion)}))


def check_interaction(interaction: Interaction | AccelerationLaw) -> None:
    """Triples, or accelerations with their derivatives, of any edges; those of one edge depend on its ends alone."""
    rule = _Chain(interaction)
    nodes = node_table(np.random.default_rng(0), (CAR,) * 5)
    graph, (target, source, _) = build_graph(nodes, [rule]), rule.pairs(nodes)
    require(bool(graph.edges or graph.nonlinear), f"needs: expected components of a car, got {interaction.needs}")
    if isinstance(interaction, AccelerationLaw):
        given = interaction.given(nodes, target, source)
        states = np.concatenate([nodes.position, nodes.velocity], axis=1)
        own, other = states[target], states[source]
        slopes = central_differences(
            lambda a, b: interaction.accelerations(a, b, given)[0], [own, other], [Vector(4)] * 2
        )
        found = interaction.accelerations(own, other, given)
        same("accelerations: derivatives", np.stack(found[1:]), np.stack(slopes), _SLOPE)
    else:
        for k, whole in enumerate(zip(*interaction.triples(nodes, target, source), strict=True)):
            alone = interaction.triples(nodes, target[k : k + 1], source[k : k + 1])
            for name, one, several in zip(alone._fields, alone, whole, strict=True):
                same(f"triples: {name} of an edge alone", one[0], several, 1e-9)
    tracked(TrackerSettings(edges=(rule,)))


def check_edge_rule(rule: EdgeRule, classes: tuple[str, ...] = ("car", "truck", "pedestrian")) -> None:
    """Pairs of several crowds of these classes, of one node and of none; the same again."""
    KINDS[EdgeRule].require("edge rule", rule)
    for n in (0, 1, 2, 12):
        nodes = node_table(
            np.random.default_rng(n), [NodeType(classes[k % len(classes)], CAR.motion) for k in range(n)]
        )
        build_graph(nodes, [rule])
        first, again = Pairs(*rule.pairs(nodes)), rule.pairs(nodes)
        require(all(map(np.array_equal, first, again)), "pairs: expected the same for the same nodes")
        require(bool((first.target != first.source).all()), "pairs: expected no edge of a node to itself")
    tracked(TrackerSettings(edges=(rule,)), classes=classes)


def check_sensor(sensor: Sensor) -> None:
    """Probabilities and covariances of detections, of none too; its copies are equal."""
    KINDS[Sensor].require("sensor", sensor)
    require(copy.deepcopy(sensor) == sensor, "expected a sensor whose copy is equal")
    for count in (0, 5):
        some = Detections(boxes(count), np.full(count, 0.7))
        p = sensor.probability(some.score, some.boxes.label)
        same("probability", p, np.clip(p, 1e-9, 1 - 1e-9), 0.0, (count,))
        R = sensor.detection_covariance(some, np.zeros(2))
        same("detection_covariance: symmetry", R, np.swapaxes(R, -1, -2), 1e-9, (count, 4, 4))
        require(bool((np.linalg.eigvalsh(R) > 0).all()), "detection_covariance: expected positive definite matrices")
    tracked(TrackerSettings(), {"default": sensor})


def check_association_cost(cost: AssociationCost, classes: tuple[str, ...] = ("car", "pedestrian")) -> None:
    """Costs (n, m) of several frames, which belong to pairs: they do not depend on the order of the rows."""
    KINDS[AssociationCost].require("association cost", cost)
    for n, m in ((1, 1), (3, 5), (6, 2)):
        i, j = np.arange(n), np.arange(m)
        one = AssociationProblem("lidar", 0.5, i + 1, boxes(n, classes), j, boxes(m, classes))
        other = one._replace(id=i[::-1] + 1, tracks=one.tracks.select(i[::-1]))
        other = other._replace(row=j[::-1], detections=one.detections.select(j[::-1]))
        costs = [np.asarray(cost(each)) for each in (one, other)]
        for each in costs:
            require(each.shape == (n, m), f"costs: expected shape {(n, m)}, got {each.shape}")
        same("costs in another order", costs[1][::-1, ::-1], costs[0], 1e-9)
    tracked(TrackerSettings(association=AssociationSettings(costs=(cost,))), classes=classes)


def check_class_model(model: ClassModel) -> None:
    """Chances (n, C) of boxes of its classes; those of a box depend on it alone."""
    KINDS[ClassModel].require("class model", model)
    some, C = boxes(7, model.classes), len(set(model.classes))
    alone = [model.likelihood(some.select(np.array([k]))) for k in range(7)]
    same("likelihood of each box alone", np.concatenate(alone), model.likelihood(some), 1e-9, (7, C))
    tracked(TrackerSettings(), {"default": Sensor(class_model=model)}, model.classes)


def check_provider(provider: FactorProvider) -> None:
    """Cars are tracked with the factors that it adds to the running graph of the estimator `isam2`."""
    tracked(TrackerSettings(estimator="isam2", providers=(provider,)))


class _Chain(NamedTuple):
    """Each node acts on the one before."""

    interaction: Interaction | AccelerationLaw

    def pairs(self, nodes: NodeTable) -> Pairs:
        rows = np.arange(len(nodes))
        return Pairs(rows[:-1], rows[1:], np.ones(len(rows[1:])))


def boxes(n: int, classes: tuple[str, ...] = ("car",)) -> Boxes:
    """Boxes (n) of these classes within 50 m."""
    rng = np.random.default_rng(n)
    position, size = rng.uniform(-50, 50, (n, 3)), rng.uniform(1, 4, (n, 3))
    return Boxes(np.resize(np.array(classes), n), position, size, rng.uniform(-3, 3, n), rng.normal(size=(n, 2)))


def tracked(
    settings: TrackerSettings, sensors: dict[str, Sensor] | None = None, classes: tuple[str, ...] = ("car",)
) -> None:
    """Track objects that move in a row; raises `AssertionError` where they are not all tracked, by finite states."""
    tracker, n = Tracker(settings, sensors), OBJECTS
    size, velocity = np.tile([4.0, 2.0, 1.6], (n, 1)), np.tile([5.0, 0.0], (n, 1))
    for k in range(MOMENTS):
        x = np.column_stack([12.0 * np.arange(n) + 0.5 * k, np.zeros(n), np.ones(n)])
        found = Boxes(np.resize(np.array(classes), n), x, size, np.zeros(n), velocity)
        tracks = tracker.step(Frame(0.1 * k, "lidar", Detections(found, np.full(n, 0.9)), np.eye(4), "ego"))
    require(len(tracks) == n, f"tracking: expected {n} tracks of {n} objects in plain view, got {len(tracks)}")


def same(what: str, found: Any, expected: Any, tolerance: float, shape: tuple[int, ...] | None = None) -> None:
    """Raise `AssertionError` unless arrays of a shape agree within a tolerance, relative to the largest value."""
    one, other = np.asarray(found, dtype=np.float64), np.asarray(expected, dtype=np.float64)
    shape = other.shape if shape is None else shape
    require(one.shape == other.shape == shape, f"{what}: expected shape {shape}, got {one.shape}")
    scale = max(1.0, float(np.abs(other[np.isfinite(other)]).max(initial=0.0)))
    close = np.allclose(one, other, rtol=0.0, atol=tolerance * scale)
    require(close, f"{what}: expected the same within {tolerance:g}, and no NaN")


def require(condition: bool, otherwise: str) -> None:
    """Raise `AssertionError` that says what is otherwise."""
    if not condition:
        raise AssertionError(otherwise)
