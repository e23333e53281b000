"""Interactions learned from recordings, as a value that is written to a file and given to a tracker.

Learned dynamics must be stable: construction checks them by `saga_fg.model.stability`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from saga_fg.errors import InputError
from saga_fg.model.edge_rules import Following, Neighbours
from saga_fg.model.stability import require_stable
from saga_fg.settings import Range, Settings, setting, settings_group

FORMAT = "saga-fg interactions"
VERSION = 1
HIGHEST_RATE = 20.0  # 1/s, of an edge: beyond, an interaction is a rigid bond


@dataclass(frozen=True)
class LearnedInteractions(Settings):
    """Edge rules, and how much of the process noise they explain.

    Raises `InputError` for another format or version, and for rules that would make the dynamics, or a step, unstable.
    """

    format: Literal["saga-fg interactions"] = setting("saga-fg interactions", "format of this file")
    version: int = setting(VERSION, "version of the format")
    learned_from: str = setting("", "data it was learned from")
    edges: tuple[Following | Neighbours, ...] = settings_group(tuple, "edge rules of the scene graph")
    explained_noise: Annotated[float, Range(0, 10)] = setting(
        0.0, "process noise is scaled by exp(-explained_noise K) at the total rate K of interactions, s; usual 0 to 2"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.version != VERSION:
            raise InputError(f"version: expected {VERSION}, the one this program writes, got {self.version}")
        for k, rule in enumerate(self.edges):
            if rule.rate > HIGHEST_RATE:
                raise InputError(f"edges[{k}].rate: expected at most {HIGHEST_RATE:g} 1/s, got {rule.rate:g}")
        require_stable(self.edges)
