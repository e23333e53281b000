r"""Edge rates from a small message-passing network (Gilmer et al., Neural Message Passing, ICML 2017), one round.

With the features f_ij of edge j -> i (`saga_fg.model.edge_features`, scaled to order 1) and N(i) all candidates,

    h_ij    = tanh( W_edge f_ij + b_edge )                               message of an edge
    m_i     = tanh( W_node sum_{j in N(i)} h_ij / (1 + |N(i)|) )         mean message into a node
    rate_ij = max_rate * logistic( w_out . [ h_ij, m_i ] + b_out )

Whatever the weights are, 0 <= rate <= max_rate, so that no network can make the dynamics unstable. The forward pass is
written once for NumPy, with which it runs, and JAX, with which it is trained.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from saga_fg.errors import InputError
from saga_fg.model.edge_features import EdgeFeatures, features_of
from saga_fg.model.edge_information import EdgeInformation, information_setting, weighted_by_gain
from saga_fg.model.edge_rules import VEHICLES, Pairs, close_pairs, strongest
from saga_fg.model.interactions import CarFollowing, NodeTable, SharedCourse, SharedVelocity
from saga_fg.numerics.arrays import of_classes
from saga_fg.settings import (
    NonNegativeInt,
    Positive,
    Range,
    Settings,
    setting,
    settings_group,
)

FEATURES = 12
MAX_RATE = 5.0  # 1/s, of an edge: the highest that a network may be given

Matrix = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class EdgeNetwork(Settings):
    """The network as an edge rule, for the edges of one interaction; hidden size h.

    Raises `InputError` for weights whose sizes don't fit or that are not finite.
    """

    map_classes: ClassVar[tuple[str, ...]] = ()
    interaction: SharedVelocity | CarFollowing | SharedCourse = settings_group(
        SharedVelocity, "interaction function of the edges"
    )
    edge_weights: Matrix = setting((), "W_edge, h rows of one entry a feature; []: no edges")
    edge_bias: tuple[float, ...] = setting((), "b_edge, h entries")
    node_weights: Matrix = setting((), "W_node, h rows of h entries")
    output_weights: tuple[float, ...] = setting((), "w_out, 2 h entries")
    output_bias: float = setting(-3.0, "b_out")
    max_rate: Annotated[float, Range(0, MAX_RATE, above=True)] = setting(3.0, "highest rate of an edge, 1/s")
    max_distance: Positive = setting(40.0, "no edge beyond this distance, m")
    max_degree: NonNegativeInt = setting(4, "largest number of edges into one object, the strongest")
    ahead_only: bool = setting(False, "true: only objects ahead lead, along the heading of the follower")
    information_gain: EdgeInformation | None = information_setting()
    classes: tuple[str, ...] = setting(VEHICLES, "classes of objects that take part")

    def __post_init__(self) -> None:
        super().__post_init__()
        h = len(self.edge_bias)
        for name, given, shape in (
            ("edge_weights", self.edge_weights, (h, FEATURES)),
            ("node_weights", self.node_weights, (h, h)),
            ("output_weights", self.output_weights, (2 * h,)),
            ("edge_bias", self.edge_bias, (h,)),
            ("output_bias", self.output_bias, ()),
        ):
            rows = len(given) if isinstance(given, tuple) else 0
            lengths = {len(row) for row in given if isinstance(row, tuple)} if isinstance(given, tuple) else set()
            fits = not shape or (rows == shape[0] and (len(shape) == 1 or lengths <= {shape[1]}))
            if not fits or not np.isfinite(np.asarray(given, dtype=np.float64)).all():
                size = " x ".join(map(str, shape)) or "1"
                raise InputError(f"{name}: expected {size} finite numbers for {h} entries of edge_bias")

    def pairs(self, nodes: NodeTable) -> Pairs:
        able = of_classes(nodes.label, self.classes) if self.edge_bias else np.zeros(len(nodes), dtype=bool)
        target, source = close_pairs(nodes.position, able, self.max_distance)
        if len(target) == 0:
            return Pairs(target, source, np.empty(0))
        features = features_of(nodes, target, source)
        received = np.zeros((len(nodes), len(self.edge_bias)))
        weights = self.weights()
        message = messages(weights, features)
        np.add.at(received, target, message)
        received /= 1 + np.bincount(target, minlength=len(nodes))[:, None]
        rate = edge_rates(weights, message, received[target], self.max_rate)
        if self.ahead_only:
            rate = np.where(features.ahead > 0, rate, 0.0)
        rate = weighted_by_gain(rate, self.information_gain, nodes, target, source)
        return strongest(Pairs(target, source, rate), len(nodes), self.max_degree)

    def candidate_rates(self, weights: dict[str, Any], features: EdgeFeatures, able: Any, xp: Any = np) -> Any:
        """Rates (W, M) of the edges from M candidates into each of W nodes; able (W, M) whether one takes part."""
        present = xp.where(able & (features.distance <= self.max_distance), 1.0, 0.0)
        message = messages(weights, features, xp)
        received = (present[..., None] * message).sum(axis=1) / (1 + present.sum(axis=1))[:, None]
        rate = present * edge_rates(weights, message, received[:, None], self.max_rate, xp)
        return xp.where(features.ahead > 0, rate, 0.0) if self.ahead_only else rate

    def weights(self) -> dict[str, Any]:
        """The weights as arrays."""
        h = len(self.edge_bias)
        return {
            "edge_weights": np.asarray(self.edge_weights, dtype=np.float64).reshape(h, FEATURES),
            "edge_bias": np.asarray(self.edge_bias, dtype=np.float64),
            "node_weights": np.asarray(self.node_weights, dtype=np.float64).reshape(h, h),
            "output_weights": np.asarray(self.output_weights, dtype=np.float64),
            "output_bias": np.float64(self.output_bias),
        }


def messages(weights: dict[str, Any], f: EdgeFeatures, xp: Any = np) -> Any:
    """h (..., h) of edges with features (...)."""
    columns = (
        xp.clip(f.ahead / 20, -2, 2),
        xp.clip(f.lateral / 5, -3, 3),
        xp.exp(-f.distance / 5),
        xp.exp(-f.distance / 20),
        xp.exp(-((f.lateral + f.ahead * xp.tan(xp.clip(f.turn, -1.5, 1.5) / 2)) ** 2) / 3),
        xp.cos(f.turn),
        xp.sin(f.turn),
        xp.exp(-f.velocity_difference),
        xp.tanh(f.target_speed / 5),
        xp.tanh(f.source_speed / 5),
        f.target_moved,
        f.source_moved,
    )
    return xp.tanh(xp.stack(columns, axis=-1) @ weights["edge_weights"].T + weights["edge_bias"])


def edge_rates(weights: dict[str, Any], message: Any, received: Any, max_rate: float, xp: Any = np) -> Any:
    """Rates (...), 1/s, of edges with messages (..., h) into nodes with the mean message `received` (..., h)."""
    h = message.shape[-1]
    node = xp.tanh(received @ weights["node_weights"].T)
    logit = message @ weights["output_weights"][:h] + node @ weights["output_weights"][h:] + weights["output_bias"]
    return max_rate * 0.5 * (1 + xp.tanh(logit / 2))
