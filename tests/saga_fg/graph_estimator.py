"""The running graph behind the calls of the conformance programs: add, predict, update, marginalise."""

import numpy as np

from saga_fg.estimators import IncrementalSmoother
from saga_fg.estimators.object_factors import DetectionFactors, Interactions, NewObjects
from saga_fg.graph import OBJECT, key_of


class GraphEstimator:
    """Objects in an `IncrementalSmoother`."""

    def __init__(self, lag):
        self.smoother = IncrementalSmoother(lag=lag)
        self.smoother.step(0.0)
        self.nodes = []

    def add(self, nodes, means, covariances):
        self.smoother.extend([NewObjects(nodes, means, covariances)])
        self.nodes += [int(node) for node in nodes]

    def predict(self, transition):
        self.smoother.step(self.smoother.time + transition.dt, [Interactions(transition)])

    def update(self, measurements):
        self.smoother.extend([DetectionFactors(measurements)])
        return np.nan

    def marginalise(self, nodes):
        """Remove nodes: no variable at the next epoch; the last one leaves with the lag."""
        self.nodes = [node for node in self.nodes if node not in np.asarray(nodes)]

    def keys(self, nodes):
        return [key_of(OBJECT, int(node), self.smoother.graph().epoch) for node in nodes]

    def joint_mean(self, nodes):
        return np.concatenate([self.smoother.state(key) for key in self.keys(nodes)])

    def joint_covariance(self, nodes):
        return self.smoother.joint_covariance(self.keys(nodes))

    def covariance(self, node):
        return self.smoother.covariance(self.keys([node])[0])
