"""Error messages with the names of a graph's variables in place of keys."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from factors import FactorError, SingularSystemError
from factors.validation import format_key
from saga_fg.errors import InputError
from saga_fg.graph.errors import GraphError, UndeterminedError
from saga_fg.graph.factor_groups import HeldGroup
from saga_fg.graph.keys import described
from saga_fg.graph.variables import GraphVariable
from saga_fg.numerics.arrays import IntArray

Variables = Mapping[int, GraphVariable]


def solver_error(variables: Variables, groups: Mapping[int, HeldGroup], error: Exception) -> GraphError:
    """Return a solver's error in the names of the graph: an `UndeterminedError` where the system is singular."""
    if not isinstance(error, SingularSystemError) or not error.keys:
        return GraphError(with_names(variables, str(error), variables))
    names = [str(variables[key]) if key in variables else described(key) for key in error.keys[:8]]
    more = f" and {len(error.keys) - 8} more" if len(error.keys) > 8 else ""
    first = error.keys[0]
    its = f" (factors on {names[0]}: {_factors_on(groups.values(), first)})" if first in variables else ""
    return UndeterminedError(
        f"{', '.join(names)}{more}: not determined by the factors{its}; "
        "expected a prior, or measurements of all components",
        error.keys,
    )


def factor_error(variables: Variables, held: HeldGroup, rows: IntArray, error: Exception) -> GraphError:
    """Return the error of factors, with their provider, kind and variables."""
    keys = dict.fromkeys(key for row in rows.tolist() for key in held.factors.rows[row])
    named = [str(variables[key]) for key in list(keys)[:6]] + ["..."] * (len(keys) > 6)
    expected = isinstance(error, FactorError | InputError)
    text = " ".join(str(error).split()) if expected else " ".join(repr(error).split())
    where = f"{held.factors.name} on {', '.join(named)}: "
    return GraphError(f"provider {held.provider}: {where}{with_names(variables, text, keys).removeprefix(where)[:500]}")


def with_names(variables: Variables, text: str, keys: Iterable[int]) -> str:
    """Replace keys in a text by the names of their variables."""
    for key in keys:
        if format_key(key) in text:
            text = text.replace(format_key(key), str(variables[key]))
    return text


def _factors_on(groups: Iterable[HeldGroup], key: int) -> str:
    """Describe the factors on a variable."""
    counts: dict[str, int] = {}
    for held in groups:
        mine = sum(key in held.factors.rows[row] for row in held.rows.tolist())
        if mine:
            counts[held.factors.name] = counts.get(held.factors.name, 0) + mine
    return ", ".join(f"{count} {name}" for name, count in counts.items()) or "none"
