"""Parts by name: providers, estimators and others of users' own, made by a class or function MODULE:NAME.

A name is looked up by importing its module, which runs the code there.

An estimator is named by a word as well: one of the toolkit's own, or an entry point of the group `saga_fg.estimators`
of any installed package, whose object is a class or function too. That is called with those of the tracker's settings
that its parameters name (`lag`, `tolerance`, `max_component`, ...), and with the factor `providers`, if it names them.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from saga_fg.errors import InputError
from saga_fg.estimators import Estimator, GraphFilter, JointKalmanFilter
from saga_fg.estimators.estimator import missing
from saga_fg.graph import FactorProvider

GROUP = "saga_fg.estimators"
"""Group of entry points of packages that bring estimators."""


def _isam2(providers: Sequence[FactorProvider] = ()) -> GraphFilter:
    """The running graph of the last interval."""
    return GraphFilter(providers)


def _fixed_lag(providers: Sequence[FactorProvider] = (), lag: float = 0.0) -> GraphFilter:
    """The running graph of the last `lag` s."""
    return GraphFilter(providers, lag)


OWN_ESTIMATORS: Mapping[str, Callable[..., Estimator]] = {
    "kalman": JointKalmanFilter,
    "isam2": _isam2,
    "fixed-lag": _fixed_lag,
}


def require_estimator_name(name: str) -> None:
    """Raise `InputError` unless a name is a known one, or MODULE:NAME; that is not looked up."""
    if not isinstance(name, str):
        raise InputError(f"estimator: expected a name, got {name!r:.40}")
    if ":" in name:
        _parts_of_name(name, "estimator")
    elif name not in OWN_ESTIMATORS and name not in (others := [point.name for point in _entry_points()]):
        known = ", ".join(dict.fromkeys([*OWN_ESTIMATORS, *others]))
        raise InputError(f"estimator: expected one of {known}, or MODULE:NAME, got {name[:40]!r}")


def new_estimator(
    name: str, settings: Mapping[str, Any], providers: Sequence[FactorProvider] = (), poses: bool = False
) -> Estimator:
    """Make the estimator of a name, by its rule above; with `poses`, one that takes an estimated ego pose.

    Raises `InputError` for one that cannot be made, lacks a method, or takes no providers where there are some.
    """
    made_by, where = _estimator(name), f"estimator: {name}"
    parameters = _parameters(made_by, where)
    given = dict(settings) | {"providers": tuple(providers)}
    unknown = [one.name for one in parameters if one.name not in given and one.default is inspect.Parameter.empty]
    if unknown:
        raise InputError(f"{where}: expected parameters that are settings of the tracker, got {', '.join(unknown)}")
    if providers and all(one.name != "providers" for one in parameters):
        raise InputError(f"{where}: expected no factor providers, it has no parameter `providers`")
    try:
        estimator: Estimator = made_by(**{one.name: given[one.name] for one in parameters if one.name in given})
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    except Exception as error:
        raise InputError(f"{where}: cannot be made: {type(error).__name__}: {error}") from error
    if not isinstance(estimator, Estimator):
        raise InputError(f"{where}: expected a class derived from saga_fg.estimators.Estimator, got {estimator!r:.60}")
    if lacking := missing(estimator):
        raise InputError(f"{where}: lacks {', '.join(lacking)} of saga_fg.estimators.Estimator")
    if poses and missing(estimator, poses=True):
        raise InputError(f"ego.estimated: expected the estimator isam2 or fixed-lag, got {name}")
    return estimator


def estimator_parameters(name: str) -> frozenset[str]:
    """The names of the settings that an estimator has."""
    return frozenset(one.name for one in _parameters(_estimator(name), f"estimator: {name}"))


def new_provider(entry: str | FactorProvider) -> FactorProvider:
    """Make the factor provider of a name such as "my_module:WallDistance"; see `made_by_name`."""
    provider: FactorProvider = made_by_name("providers", entry, "a factor provider, which has a method factors")
    return provider


def made_by_name(setting: str, entry: Any, expected: str) -> Any:
    """Make the part that a name in a setting stands for, without arguments; copy one that is made already.

    `expected` ends in the name of the method it must have. Raises `InputError` for a part without it.
    """
    made = deepcopy(entry)
    if isinstance(entry, str):
        try:
            made = named(entry, setting)()
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"{setting}: {entry}: expected a class to be made without arguments: {error}") from error
    if isinstance(made, str) or not callable(getattr(made, expected.split()[-1], None)):
        raise InputError(f"{setting}: {entry}: expected {expected}")
    return made


def named(name: str, setting: str = "providers") -> Any:
    """Look up a name such as "my_module:WallDistance" in a setting.

    Imports the module, which runs its code. Raises `InputError` for a name that leads to nothing.
    """
    module, attribute = _parts_of_name(name, setting)
    try:
        found = import_module(module)
    except Exception as error:  # of a user's module: anything
        raise InputError(f"{setting}: {name}: expected a module that can be imported: {error}") from error
    try:
        return getattr(found, attribute)
    except AttributeError as error:
        raise InputError(f"{setting}: {name}: the module has no {attribute}") from error


def _parts_of_name(name: str, setting: str) -> tuple[str, str]:
    module, colon, attribute = name.partition(":")
    if not colon or not module.strip(".") or module[0] == "." or not attribute.isidentifier():
        raise InputError(f"{setting}: expected MODULE:NAME, got {name!r}")
    return module, attribute


def _entry_points() -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=GROUP))


def _estimator(name: str) -> Callable[..., Any]:
    """The class or function that makes the estimator of a name."""
    require_estimator_name(name)
    if name in OWN_ESTIMATORS:
        return OWN_ESTIMATORS[name]
    if ":" in name:
        made_by = named(name, "estimator")
    else:
        point = next(point for point in _entry_points() if point.name == name)
        try:
            made_by = point.load()
        except Exception as error:  # of a user's module: anything
            raise InputError(f"estimator: {name}: {point.value} cannot be imported: {error}") from error
    if not callable(made_by):
        raise InputError(f"estimator: {name}: expected a class or a function, got {type(made_by).__name__}")
    found: Callable[..., Any] = made_by
    return found


def _parameters(made_by: Callable[..., Any], where: str) -> list[inspect.Parameter]:
    """The parameters that can be given by name."""
    try:
        every = inspect.signature(made_by).parameters.values()
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: expected a class or a function whose parameters have names") from error
    collecting = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return [one for one in every if one.kind not in collecting]
