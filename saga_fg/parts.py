"""Parts of a user's own: the kinds that there are, and how a part is found by its name.

A part is given as an object in Python, and by its name in a configuration or on the command line: MODULE:NAME, or the
name of an entry point of any installed package,

    [project.entry-points."saga_fg.motions"]
    drag = "my_package.drag:Drag"

Looking a name up imports its module, which runs the code there. A class is made without arguments, or with the settings
that stand beside its name; so is a function, unless it is a part itself, as an association cost may be.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from types import MappingProxyType
from typing import Any, TypeVar

from saga_fg.errors import InputError, unknown_name

T = TypeVar("T")
KINDS: dict[type, PartKind] = {}
"""The kinds by the protocol, or the base class, of their parts."""
NOTHING: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class PartKind:
    """A kind of part: its name, the group of its entry points, and the protocols or base classes a part may have."""

    name: str
    group: str
    roles: tuple[type, ...] = ()
    several: bool = False  # of a setting: a tuple of such parts

    def require(self, where: str, part: object) -> None:
        """Raise `InputError` unless a part has all members of one of the roles, or derives from it."""
        lacking = [_lacking(role, part) for role in self.roles]
        if all(lacking):
            expected = f"expected {'an' if self.name[0] in 'aeiou' else 'a'} {self.name} {min(lacking, key=len)}"
            made = f"the class {part.__name__}, make it: {part.__name__}()" if isinstance(part, type) else ""
            raise InputError(f"{where}: {expected}, got {made or type(part).__name__}")


def part_kind(name: str, group: str) -> Callable[[T], T]:
    """Register the decorated protocol or base class as that of a kind of part."""

    def register(role: T) -> T:
        assert isinstance(role, type)
        KINDS[role] = PartKind(name, group, (role,))
        return role

    return register


def kind_among(types: Iterable[Any]) -> PartKind | None:
    """The kind of part whose roles are among the types of a union, None for none."""
    found = [KINDS[each] for each in types if isinstance(each, type) and each in KINDS]
    return replace(found[0], roles=tuple(role for kind in found for role in kind.roles)) if found else None


@cache
def offered(group: str) -> dict[str, tuple[EntryPoint, ...]]:
    """The entry points of a group in installed packages, by name."""
    found: dict[str, tuple[EntryPoint, ...]] = {}
    for entry in sorted(entry_points(group=group), key=lambda entry: (entry.name, entry.value)):
        found[entry.name] = (*found.get(entry.name, ()), entry)
    return found


def names_of(group: str, own: Mapping[str, Any] = NOTHING) -> tuple[str, ...]:
    """The names that can be found: those of this package first."""
    return tuple(dict.fromkeys((*own, *offered(group))))


def require_name(what: str, name: object, group: str, own: Mapping[str, Any] = NOTHING) -> str:
    """Return a name that may be found: MODULE:NAME, which is not looked up, or a known one; else `InputError`.

    what  kind of part, or the setting that names it; own: parts of this package by name
    """
    if not isinstance(name, str):
        raise InputError(f"{what}: expected a name, got {name!r:.40}")
    module, colon, attribute = name.partition(":")
    if colon and (not module.strip(".") or module[0] == "." or not attribute.isidentifier()):
        raise InputError(f"{what}: expected MODULE:NAME, got {name!r:.60}")
    known = names_of(group, own)
    if not colon and not known:
        raise InputError(f"{what}: expected MODULE:NAME, got {name!r:.60}")
    if not colon and name not in known:
        raise InputError(f"{unknown_name(what, name, known)}, or MODULE:NAME")
    return name


def find(what: str, name: object, group: str, own: Mapping[str, Any] = NOTHING) -> Any:
    """Look up what a name stands for; the arguments are those of `require_name`, own parts may be MODULE:NAME.

    Raises `InputError` for an unknown name, one that several packages offer, and what cannot be imported.
    """
    name = require_name(what, name, group, own)
    where = f"{what}: {name}"
    location = name
    if ":" not in name:
        entries = offered(group).get(name, ())
        packages = [entry.dist.name if entry.dist is not None else entry.value for entry in entries]
        packages += ["saga-fg"] * (name in own)
        if len(packages) > 1:
            raise InputError(f"{where}: expected one package to offer it, {' and '.join(packages)} do")
        location = entries[0].value if entries else own[name]
        where += f" of the package {packages[0]}" if entries else ""
    if not isinstance(location, str):
        return location
    module, _, attribute = location.partition(":")
    try:
        found = import_module(module)
    except (Exception, SystemExit) as error:  # of a user's module: anything
        raise InputError(f"{where}: {module} cannot be imported: {in_one_line(error)}") from error
    try:
        return getattr(found, attribute)
    except AttributeError as error:
        raise InputError(f"{where}: the module {module} has no {attribute}") from error


def new_part(what: str, given: Any, role: type) -> Any:
    """Make the part that a name or a class stands for, without arguments; a part that is made already is copied.

    Raises `InputError` for what cannot be made, and what is no part of the kind whose role it should have.
    """
    kind = KINDS[role]
    if not isinstance(given, str | type):
        kind.require(what, given)
        return deepcopy(given)
    return (
        as_part(what, given, kind)
        if isinstance(given, type)
        else as_part(f"{what}: {given}", find(what, given, kind.group), kind)
    )


def as_part(where: str, found: Any, kind: PartKind) -> Any:
    """Return what a name stands for where it is a part, else what it makes; `InputError` for no part of the kind."""
    if isinstance(found, type) or all(_lacking(role, found) for role in kind.roles):
        found = made(where, found)
    kind.require(where, found)
    return found


def made(where: str, maker: Any, **settings: Any) -> Any:
    """Call what makes a part; raises `InputError` where that fails."""
    with of_own_code(where, f"cannot be made {'with these settings' if settings else 'without arguments'}: "):
        return maker(**settings)


@contextmanager
def of_own_code(where: str, what: str = "") -> Iterator[None]:
    """Raise `InputError` that names a user's own part for whatever its code raises in the block."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    except Exception as error:  # of a user's module: anything
        raise InputError(f"{where}: {what}{in_one_line(error)}") from error


def part_name(part: Any) -> str:
    """MODULE:NAME of a part's class, or of a function."""
    named = part if hasattr(part, "__qualname__") else type(part)
    return f"{named.__module__}:{named.__qualname__}"


def in_one_line(error: BaseException) -> str:
    """The type and the message of an error."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def _lacking(role: type, part: object) -> str:
    """Return what a part lacks of a role, "" if it has all: `derived from ...` or `with its members; it lacks ...`."""
    if not getattr(role, "_is_protocol", False):
        return "" if isinstance(part, role) else f"derived from {role.__module__}.{role.__qualname__}"
    members = {name: each for name, each in vars(role).items() if name == "__call__" or not name.startswith("_")}
    if "__call__" in members:
        return "" if callable(part) else "that can be called"
    if isinstance(part, type):
        return f"with {', '.join(members)}"
    lacking = [name for name, member in members.items() if not _has(part, name, callable(member))]
    return f"with {', '.join(members)}; it lacks {', '.join(lacking)}" if lacking else ""


def _has(part: object, name: str, method: bool) -> bool:
    found = inspect.getattr_static(part, name, None)
    return found is not None and (not method or callable(getattr(part, name, None)))
