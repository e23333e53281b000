"""Variants of the tracking benchmark: the methods, and the graph-aware tracker with one component switched off.

A component is a named change of settings, written as dotted names and values over the shipped configuration; `*` stands
for every entry of a mapping. A value may be a function of the old value. One that is off as shipped is not compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, is_dataclass, replace
from typing import Any

from pipelines.config import Method, TrackConfig
from pipelines.learning.gap_runs import Contender
from saga_fg.errors import InputError
from saga_fg.model.edge_rules import EdgeRule, Following, Neighbours


@dataclass(frozen=True)
class Variant:
    """A method, and what is changed in its settings."""

    name: str
    method: Method = "saga"
    changes: Mapping[str, Any] = field(default_factory=dict)

    def contender(self, base: TrackConfig) -> Contender:
        """The method with the changes of a configuration."""
        return Contender(self.name, self.method, self.config(base))

    def config(self, base: TrackConfig) -> TrackConfig:
        """The configuration with the changes."""
        for name, value in self.changes.items():
            base = changed(base, name, value)
        return base


def _without(kind: type) -> Callable[[tuple[EdgeRule, ...]], tuple[EdgeRule, ...]]:
    return lambda edges: tuple(edge for edge in edges if not isinstance(edge, kind))


METHODS = (Variant("saga"), Variant("kf", "kf"), Variant("centerpoint", "centerpoint"))
GRAPH_MATCHING = Variant("graph matching", changes={"tracker.association.method": "graph"})
COMPONENTS = (
    Variant("without following", changes={"tracker.edges": _without(Following)}),
    Variant("without neighbours", changes={"tracker.edges": _without(Neighbours)}),
    Variant("without explained noise", changes={"tracker.explained_noise": 0.0}),
    Variant("without speeds of traffic", changes={"tracker.traffic.speed_prior.weight": 0.0}),
    Variant("without stationary objects", changes={"tracker.stationarity.prior": 0.0}),
    Variant("tracks of one detection rank as others", changes={"tracker.min_hits": 1}),
    Variant("without non-maximum suppression", changes={"tracker.classes.*.nms_distance": 0.0}),
    Variant("without suppression of weak detections", changes={"tracker.classes.*.weak_nms_distance": 0.0}),
    Variant("matching without overlap", changes={"tracker.classes.*.giou_weight": 0.0}),
    Variant("matching without clutter", changes={"tracker.association.clutter_area": math.inf}),
    Variant("matching without existence", changes={"tracker.association.existence_weight": 0.0}),
    Variant("matching without scores", changes={"tracker.association.score_weight": 0.0}),
    Variant("greedy matching", changes={"tracker.association.method": "greedy"}),
    GRAPH_MATCHING,
    Variant("tracks that never leave unseen", changes={"tracker.existence.lifetime": math.inf}),
    Variant("scores without hit ratio", changes={"tracker.existence.hit_ratio_weight": 0.0}),
    Variant("without tentative tracks", changes={"tracker.tentative_score_factor": 0.0}),
    Variant("without output while coasting", changes={"tracker.report_coasting": 0.0}),
    Variant("headings that drift freely", changes={"tracker.classes.*.yaw_drift": 3.0}),
)


def changed(settings: Any, name: str, value: Any) -> Any:
    """`settings` with the dotted `name` set to `value`. Raises `InputError` for a name that does not exist."""
    head, _, rest = name.partition(".")
    if isinstance(settings, Mapping):
        keys = list(settings) if head == "*" else [head]
        if not all(key in settings for key in keys):
            raise InputError(f"{name}: expected one of {', '.join(settings)}")
        return {**settings, **{key: _next(settings[key], rest, value) for key in keys}}
    if not is_dataclass(settings) or isinstance(settings, type) or head not in settings.__dataclass_fields__:
        raise InputError(f"{name}: expected the name of a setting")
    return replace(settings, **{head: _next(getattr(settings, head), rest, value)})


def _next(old: Any, rest: str, value: Any) -> Any:
    if rest:
        return changed(old, rest, value)
    return value(old) if callable(value) else value


def variants(base: TrackConfig, components: bool = True, matching: bool = False) -> tuple[Variant, ...]:
    """The methods and, if wanted, each component that the configuration has switched on, or graph matching alone."""
    chosen = COMPONENTS if components else (GRAPH_MATCHING,) if matching else ()
    return METHODS + tuple(variant for variant in chosen if variant.config(base) != base)
