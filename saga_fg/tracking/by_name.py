"""The estimator of a tracker, by its name or by what makes it: a class or a function.

A name is one of the toolkit's own, an entry point of the group `saga_fg.estimators`, or MODULE:NAME (`saga_fg.parts`).
What makes it is called with those of the tracker's settings that its parameters name (`lag`, `tolerance`,
`max_component`, ...), and with the factor `providers`, if it names them.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from saga_fg.errors import InputError
from saga_fg.estimators import Estimator, GraphFilter, JointKalmanFilter
from saga_fg.graph import FactorProvider
from saga_fg.parts import find, made, part_kind, require_name

POSES = ("extend", "covariance_with")  # methods that an estimated pose of the vehicle needs
GROUP = "saga_fg.estimators"


@part_kind("estimator", GROUP)
class EstimatorMaker(Protocol):
    """A class or function that makes an estimator of those settings of the tracker that its parameters name."""

    def __call__(self, **settings: Any) -> Estimator: ...


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


def require_estimator(given: object) -> None:
    """Raise `InputError` unless it is a class, a function or a name that may be found, which is not looked up."""
    if not callable(given):
        require_name("estimator", given, GROUP, OWN_ESTIMATORS)


def new_estimator(
    given: str | EstimatorMaker,
    settings: Mapping[str, Any],
    providers: Sequence[FactorProvider] = (),
    poses: bool = False,
) -> Estimator:
    """Make an estimator; with `poses`, one that takes an estimated ego pose.

    Raises `InputError` for one that cannot be made, lacks a method, or takes no providers where there are some.
    """
    made_by, where = _maker(given), f"estimator: {estimator_name(given)}"
    parameters = _parameters(made_by, where)
    values = dict(settings) | {"providers": tuple(providers)}
    unknown = [one.name for one in parameters if one.name not in values and one.default is inspect.Parameter.empty]
    if unknown:
        raise InputError(f"{where}: expected parameters that are settings of the tracker, got {', '.join(unknown)}")
    if providers and all(one.name != "providers" for one in parameters):
        raise InputError(f"{where}: expected no factor providers, it has no parameter `providers`")
    if lacking := sorted(getattr(made_by, "__abstractmethods__", ())):
        raise InputError(f"{where}: lacks {', '.join(lacking)} of saga_fg.estimators.Estimator")
    estimator = made(where, made_by, **{one.name: values[one.name] for one in parameters if one.name in values})
    if not isinstance(estimator, Estimator):
        raise InputError(f"{where}: expected a class derived from saga_fg.estimators.Estimator, got {estimator!r:.60}")
    if poses and any(getattr(type(estimator), name) is getattr(Estimator, name) for name in POSES):
        raise InputError(f"ego.estimated: expected the estimator isam2 or fixed-lag, got {estimator_name(given)}")
    return estimator


def estimator_name(given: str | EstimatorMaker) -> str:
    """The name of an estimator, for people."""
    return given if isinstance(given, str) else str(getattr(given, "__qualname__", type(given).__qualname__))


def estimator_parameters(given: str | EstimatorMaker) -> frozenset[str]:
    """The names of the settings that an estimator has."""
    return frozenset(one.name for one in _parameters(_maker(given), f"estimator: {estimator_name(given)}"))


def _maker(given: str | EstimatorMaker) -> Callable[..., Any]:
    """The class or function that makes the estimator."""
    found = find("estimator", given, GROUP, OWN_ESTIMATORS) if isinstance(given, str) else given
    if not callable(found):
        raise InputError(f"estimator: {given}: expected a class or a function, got {type(found).__name__}")
    maker: Callable[..., Any] = found
    return maker


def _parameters(made_by: Callable[..., Any], where: str) -> list[inspect.Parameter]:
    """The parameters that can be given by name."""
    try:
        every = inspect.signature(made_by).parameters.values()
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: expected a class or a function whose parameters have names") from error
    collecting = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return [one for one in every if one.kind not in collecting]
