"""Keys of an estimator's graph by node."""

from saga_fg.graph import OBJECT
from saga_fg.graph.variables import node_kind


def keys_of(graph, epoch):
    """The keys of the nodes at an epoch."""
    return {node: variable.key for node, variable in graph.of(OBJECT, epoch).items()}


def newest_key(graph, node):
    """The key of a node's last variable, which a pole has had since it appeared."""
    return max(key for key, variable in graph.variables.items() if (variable.kind, variable.id) == node_kind(node))
