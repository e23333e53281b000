"""The running graph: one factor graph of objects, the vehicle and landmarks, fed by factor providers."""

from saga_fg.graph.factor_groups import FactorEntry
from saga_fg.graph.providers import Additions, FactorProvider, GraphView, ask_all, predictors
from saga_fg.graph.scene_factor_graph import SceneFactorGraph
from saga_fg.graph.variables import (
    EGO_BIAS,
    EGO_ERROR,
    EGO_POSE,
    EGO_VELOCITY,
    LANDMARK,
    MAP_NODE,
    OBJECT,
    GraphError,
    GraphVariable,
    NewVariable,
    ProviderError,
    UndeterminedError,
    VariableKind,
    key_of,
)

__all__ = [
    "EGO_BIAS",
    "EGO_ERROR",
    "EGO_POSE",
    "EGO_VELOCITY",
    "LANDMARK",
    "MAP_NODE",
    "OBJECT",
    "Additions",
    "FactorEntry",
    "FactorProvider",
    "GraphError",
    "GraphVariable",
    "GraphView",
    "NewVariable",
    "ProviderError",
    "SceneFactorGraph",
    "UndeterminedError",
    "VariableKind",
    "ask_all",
    "key_of",
    "predictors",
]
