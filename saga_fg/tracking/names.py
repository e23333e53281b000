"""What settings and options choose among by name."""

from typing import Literal

EstimatorName = Literal["kalman", "isam2", "fixed-lag"]
AssociationName = Literal["hungarian", "greedy", "graph"]
