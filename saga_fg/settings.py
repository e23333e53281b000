"""Declaration of settings: frozen dataclasses whose fields carry their own comment and range.

    @dataclass(frozen=True)
    class GateSettings(Settings):
        probability: Fraction = setting(0.99, "share of true detections the gate lets through")

The comment is what `saga-fg config` prints and what the configuration reference in the docs is made of, the range
what construction checks: a number outside, or a word that is no choice of a `Literal`, ends in an `InputError`.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from numbers import Real
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from saga_fg.errors import InputError, require_type
from saga_fg.parts import PartKind, kind_among


@dataclass(frozen=True)
class Range:
    """The numbers from `low` to `high`; without `low` if `above`, without `high` if `below`.

    Infinity is one of them if `infinite`. For a tuple it is that of every entry; entries do not fall if `ascending`.
    """

    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    below: bool = False
    infinite: bool = False
    ascending: bool = False

    def __contains__(self, value: float) -> bool:
        inside = self.low < value if self.above else self.low <= value
        inside = inside and (value < self.high if self.below else value <= self.high)
        return inside and (self.infinite or math.isfinite(value))

    @property
    def bounds(self) -> str:
        """Bounds as text, like the end of "a number > 0"; empty if there are none."""
        if self.high < math.inf:
            return f"{'above' if self.above else 'from'} {self.low:g} to {'below ' * self.below}{self.high:g}"
        return "" if self.low == -math.inf else f"{'>' if self.above else '>='} {self.low:g}"

    def __str__(self) -> str:
        """Expectation as text, like "finite number > 0"."""
        finite = "" if self.infinite or self.high < math.inf else "finite "
        return f"{finite}number {self.bounds}".rstrip()


Finite = Annotated[float, Range()]
Positive = Annotated[float, Range(0, above=True)]
PositiveOrInf = Annotated[float, Range(0, above=True, infinite=True)]
NonNegativeOrInf = Annotated[float, Range(0, infinite=True)]
NonNegative = Annotated[float, Range(0)]
Fraction = Annotated[float, Range(0, 1)]
FractionBelowOne = Annotated[float, Range(0, 1, below=True)]
PositiveInt = Annotated[int, Range(0, above=True)]
NonNegativeInt = Annotated[int, Range(0)]


class Settings:
    """Base of settings dataclasses: construction raises `InputError` for values of other types, ranges and choices.

    A part of a user's own (`saga_fg.parts`) must be of its kind; a name in its place is looked up where it is used.
    """

    def __post_init__(self) -> None:
        cls: Any = type(self)
        for name, allowed in _allowed(cls):
            given = getattr(self, name)
            if isinstance(allowed, type):
                entries = given.items() if isinstance(given, Mapping) else [("", given)]
                for key, entry in entries:
                    require_type(f"{name}.{key}".rstrip("."), entry, allowed)
                continue
            if isinstance(allowed, PartKind):
                _require_parts(name, given, allowed)
                continue
            for where, value in _values(name, given):
                if isinstance(allowed, Range) and not (isinstance(value, Real) and float(value) in allowed):
                    raise InputError(f"{where}: expected a {allowed}, got {value!r}")
                if isinstance(allowed, tuple) and value not in allowed:
                    raise InputError(f"{where}: expected one of {', '.join(filter(None, allowed))}, got {value!r}")
            if isinstance(allowed, Range) and allowed.ascending and list(given) != sorted(given):
                raise InputError(f"{name}: expected ascending numbers, got {given!r}")


@cache
def _allowed(cls: type) -> list[tuple[str, Range | tuple[str, ...] | type | PartKind]]:
    """The range, the choices, the kind of part or the settings class of each field that has one."""
    hints = get_type_hints(cls, include_extras=True).items()
    found = [(name, range_of(hint) or _part_kind(hint) or _settings_class(hint)) for name, hint in hints]
    return [(name, allowed) for name, allowed in found if allowed is not None]


def _require_parts(name: str, given: Any, kind: PartKind) -> None:
    """Raise `InputError` unless a setting is a part of the kind, or a tuple of such; names are not looked up."""
    if kind.several:
        require_type(name, given, tuple, list)
    for k, entry in enumerate(given if kind.several else [given]):
        if entry is not None and not isinstance(entry, str):
            kind.require(f"{name}[{k}]" if kind.several else name, entry)


def _part_kind(hint: Any) -> PartKind | None:
    """The kind of part that a type hint, or that of the entries of a tuple, allows beside others; None for none."""
    several, within = get_origin(hint) is tuple, get_args(hint)
    kind = kind_among(get_args(within[0]) if several and within else within)
    return None if kind is None else replace(kind, several=several)


def _settings_class(hint: Any) -> type | None:
    """The settings class of a type hint or of the entries of its mapping; None where there is none, or a choice."""
    if get_origin(hint) is Mapping:
        hint = get_args(hint)[1]
    return hint if isinstance(hint, type) and issubclass(hint, Settings) else None


def range_of(hint: Any) -> Range | tuple[str, ...] | None:
    """The range, or the choices, of a type hint: its own, or that of its entries; None: it has none."""
    if get_origin(hint) is Annotated:
        return next((one for one in hint.__metadata__ if isinstance(one, Range)), None)
    if get_origin(hint) is Literal:
        return get_args(hint)
    return next((one for one in map(range_of, get_args(hint)) if one is not None), None)


def _values(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """A setting's value, or those of its entries, each with its dotted name; none for None."""
    if isinstance(value, Mapping):
        for key, entry in value.items():
            yield from _values(f"{name}.{key}", entry)
    elif isinstance(value, tuple | list):
        for entry in value:
            yield from _values(name, entry)
    elif value is not None:
        yield name, value


def setting(default: Any, comment: str) -> Any:
    """A dataclass field with a default value and a comment for people."""
    return field(default=default, metadata={"comment": comment})


def required_setting(comment: str) -> Any:
    """A dataclass field without a default, with a comment for people."""
    return field(metadata={"comment": comment})


def settings_group(factory: Callable[[], Any], comment: str) -> Any:
    """A dataclass field that holds further settings (a nested dataclass, a mapping, a tuple), made by `factory`."""
    return field(default_factory=factory, metadata={"comment": comment})
