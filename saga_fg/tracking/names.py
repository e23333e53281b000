"""Names of estimators and of association methods in settings and options."""

from typing import Literal

EstimatorName = Literal["kalman", "isam2", "fixed-lag"]
AssociationName = Literal["hungarian", "greedy", "graph"]
