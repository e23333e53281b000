"""Objects seen from the vehicle: factors between its pose and their states (`factors.relative`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factors import relative_detection_factors
from saga_fg.errors import InputError
from saga_fg.graph.keys import EGO_POSE, OBJECT
from saga_fg.graph.providers import Additions, GraphView
from saga_fg.numerics.arrays import FloatArray, IntArray
from saga_fg.providers.start import NO_POSE


@dataclass(frozen=True, eq=False)
class RelativeDetections:
    """Measurements of objects with known ids at this epoch.

    nodes (k,) ids; z (k, 3) in the vehicle's frame, m; R (k, 2, 2) in its axes, m^2; dim of the objects' states;
    position: where in them the place is
    """

    nodes: IntArray
    z: FloatArray
    R: FloatArray
    dim: int = 4
    position: tuple[int, int] = (0, 1)
    name: str = "detections"

    def factors(self, view: GraphView) -> Additions:
        if len(self.nodes) == 0:
            return Additions()
        pose = view.now(EGO_POSE).get(0)
        if pose is None:
            raise InputError(NO_POSE)
        rows = np.array([[pose.key, view.key(OBJECT, node)] for node in self.nodes.tolist()], dtype=np.uint64)
        z = self.z[:, : 2 if pose.dim == 3 else 3]
        return Additions(factors=[relative_detection_factors(rows, z, self.R, self.dim, self.position)])
