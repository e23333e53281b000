"""How settings are declared: frozen dataclasses whose fields carry their own comment.

    @dataclass(frozen=True)
    class GateSettings:
        probability: float = setting(0.99, "share of true detections the gate lets through")

The comment is what `saga-fg config` prints and what the configuration reference in the docs is made of.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field
from typing import Any


def setting(default: Any, comment: str) -> Any:
    """A dataclass field with a default value and a comment for people."""
    return field(default=default, metadata={"comment": comment})


def settings_group(factory: Callable[[], Any], comment: str) -> Any:
    """A dataclass field that holds further settings (a nested dataclass, a mapping, a tuple), made by `factory`."""
    return field(default_factory=factory, metadata={"comment": comment})
