"""Small scenes of more than cars, for tests: a queue before a light, cones, a lane, a truck with its trailer."""

from dataclasses import replace

import numpy as np

from saga_fg import ConstantVelocity, NodeType, RandomWalk
from saga_fg.conformance.programs import Add, Marginalise, Predict, Update
from saga_fg.estimators import Measurements
from saga_fg.model.discretisation import discretise
from saga_fg.model.edge_rules import Attached, Following
from saga_fg.model.graph_building import build_graph
from saga_fg.model.interactions import NodeTable
from saga_fg.model.map_rules import ConeLine, GreenLight, InLane, RedLight

CAR = NodeType("vehicle", ConstantVelocity(acceleration_noise=0.5))
STANDING = NodeType("standing", RandomWalk())
STILL = ("traffic_light", "stop_line", "lane", "traffic_cone", "barrier")


def table(rows, closed=None, outline=None, width=None):
    """A `NodeTable` of rows (label, x, y, speed, heading, length)."""
    label, x, y, speed, heading, length = zip(*rows, strict=True)
    heading, speed = np.array(heading, dtype=float), np.array(speed, dtype=float)
    return NodeTable(
        np.arange(len(rows)),
        np.array(label),
        tuple(STANDING if name in STILL else CAR for name in label),
        np.array([x, y], dtype=float).T,
        np.stack([speed * np.cos(heading), speed * np.sin(heading)], axis=-1),
        heading,
        np.array(length, dtype=float),
        np.full(len(rows), 0.2),
        speed > 1,
        closed,
        outline or {},
        width or {},
    )


def queue(closed=1.0):
    """Three cars in one lane and one beside them, 30 m and more before a stop line at x = 0 across two lanes."""
    rows = [("car", -30, 0, 10, 0, 4), ("car", -45, 0, 10, 0, 4), ("car", -60, 0, 10, 0, 4), ("car", -40, 3.5, 9, 0, 4)]
    rows.append(("stop_line", 0, 1.75, 0, 0, 0))
    ends = np.array([[0.0, 5.25], [0.0, -1.75]])
    return table(rows, np.array([0, 0, 0, 0, closed]), {4: ends})


def taper():
    """A car at x = 0 whose lane cones close from the right, at y from -2 up to 2, and one in the lane beside."""
    rows = [("car", 0, 0, 10, 0, 4), ("car", -12, 3.5, 10, 0, 4)]
    rows += [("traffic_cone", 10 + 5 * k, -2 + k, 0, 0, 0.4) for k in range(5)]
    return table(rows)


def bent_lane(turn=0.0, shift=(0.0, 0.0)):
    """A car in a lane that bends to the left at a radius of 50 m, turned and moved as a whole."""
    angle = np.linspace(0, 1.2, 25)
    points = 50 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=-1)
    rows = [("car", 10.0, 1.3, 8.0, 0.2, 4), ("lane", *points[12], 0, 0, 0)]
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    moved = []
    for label, x, y, speed, heading, length in rows:
        place = R @ (x, y) + shift
        moved.append((label, *place, speed, heading + turn, length))
    return table(moved, np.zeros(2), {1: points @ R.T + shift}, {1: 3.5})


RULES = (RedLight(), GreenLight(), InLane(), ConeLine(), Attached(), Following(cones=True))


def crossing(closed):
    """All at once: a truck with a trailer and a car come to a line in a lane, cones close the lane of another car."""
    rows = [("truck", -30, 0.2, 9, 0, 7), ("trailer", -38.5, 0.1, 9, 0, 8), ("car", -55, -0.2, 8, 0, 4)]
    rows += [("car", -40, -3.5, 9, 0.02, 4), ("stop_line", 0, 0, 0, 0, 0), ("lane", -20, 0, 0, 0, 0)]
    rows += [("traffic_cone", -30 + 4 * k, -5.5 + k, 0, 0, 0.4) for k in range(4)]
    weight = np.where(np.arange(len(rows)) == 4, closed, 0.0)
    outline = {4: np.array([[0.0, 1.75], [0.0, -1.75]]), 5: np.array([[-100.0, 0.0], [-40.0, 0.0], [40.0, 0.3]])}
    return replace(table(rows, weight, outline, {5: 3.5}), open=np.where(np.arange(len(rows)) == 4, 1 - closed, 0.0))


def road_program(rng, moments=6):
    """Calls of an estimator in `crossing`: new nodes, changing edges, some measurements, a cone that leaves."""
    nodes = crossing(0.5)
    moving, standing = (np.flatnonzero([kind is which for kind in nodes.types]) for which in (CAR, STANDING))
    means = np.concatenate([nodes.position, nodes.velocity], axis=1)
    program = [
        Add(nodes.id[moving], means[moving], np.tile(np.diag([0.3, 0.3, 2.0, 1.0]), (len(moving), 1, 1))),
        Add(nodes.id[standing], nodes.position[standing], np.tile(0.04 * np.eye(2), (len(standing), 1, 1))),
    ]
    present, kinds = np.arange(len(nodes)), set()
    for moment in range(moments):
        now = crossing(rng.random())
        moved = replace(
            now,
            position=now.position + rng.normal(0, 0.3, now.position.shape),
            velocity=now.velocity + rng.normal(0, 0.3, now.velocity.shape) * (now.velocity[:, :1] > 0),
        )
        graph = build_graph(moved, RULES)
        kinds |= {edges.interaction for edges in graph.edges}
        program.append(Predict(discretise(graph.only(present), float(rng.choice([0.05, 0.1, 0.4])))))
        for rows, dim in ((moving, 4), (np.intersect1d(standing, present), 2)):
            seen = rows[rng.random(len(rows)) < 0.6]
            if len(seen):
                z = nodes.position[seen] + rng.normal(0, 0.3, (len(seen), 2))
                program.append(Update(Measurements(seen, z, np.eye(2, dim), 0.09 * np.eye(2))))
        if moment == moments // 2:
            program.append(Marginalise(present[-1:]))
            present = present[:-1]
    assert kinds >= {"Stopping", "Starting", "KeepLane", "PassCones", "RigidCoupling"}
    return program
