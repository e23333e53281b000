"""How settings are declared: frozen dataclasses whose fields carry their own comment.

    @dataclass(frozen=True)
    class GateSettings:
        probability: float = setting(0.99, "share of true detections the gate lets through")

The comment is what `saga-fg config` prints and what the configuration reference in the docs is made of. Numbers out of
their range end in an `InputError` at construction, by the `require_...` functions in `__post_init__`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import field
from typing import Any

from saga_fg.errors import InputError


def setting(default: Any, comment: str) -> Any:
    """A dataclass field with a default value and a comment for people."""
    return field(default=default, metadata={"comment": comment})


def required_setting(comment: str) -> Any:
    """A dataclass field without a default, with a comment for people."""
    return field(metadata={"comment": comment})


def settings_group(factory: Callable[[], Any], comment: str) -> Any:
    """A dataclass field that holds further settings (a nested dataclass, a mapping, a tuple), made by `factory`."""
    return field(default_factory=factory, metadata={"comment": comment})


def require_positive(settings: Any, *names: str, infinite: bool = False) -> None:
    """Raises `InputError` unless these settings are numbers > 0, finite ones unless `infinite` is allowed."""
    for name in names:
        value = getattr(settings, name)
        if not (value > 0 and (infinite or math.isfinite(value))):
            raise InputError(f"{name}: expected a {'' if infinite else 'finite '}number > 0, got {value!r}")


def require_between(settings: Any, low: float, high: float, *names: str) -> None:
    """Raises `InputError` unless these settings are finite numbers from `low` to `high` (may be infinite)."""
    for name in names:
        value = getattr(settings, name)
        if not (low <= value <= high and math.isfinite(value)):
            expected = f"a finite number >= {low:g}" if high == math.inf else f"a number from {low:g} to {high:g}"
            raise InputError(f"{name}: expected {expected}, got {value!r}")


def require_one_of(settings: Any, name: str, choices: tuple[str, ...]) -> None:
    """Raises `InputError` unless the setting is one of `choices`."""
    value = getattr(settings, name)
    if value not in choices:
        raise InputError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")
