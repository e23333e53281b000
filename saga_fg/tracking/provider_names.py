"""Parts of users' own by name: MODULE:NAME of something that makes one when it is called without arguments."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from saga_fg.errors import InputError
from saga_fg.graph import FactorProvider


def new_provider(name: str) -> FactorProvider:
    """Make the factor provider of a name such as "my_module:WallDistance"; see `made_by_name`."""
    provider: FactorProvider = made_by_name("providers", name, "a factor provider, which has a method factors")
    return provider


def made_by_name(setting: str, name: str, expected: str) -> Any:
    """Make what a name in a setting stands for; `expected` ends in the method that it must have.

    Imports the module, which runs its code. Raises `InputError` for a name that leads to nothing of the kind.
    """
    module, colon, attribute = name.partition(":")
    if not colon or not module or not attribute.isidentifier():
        raise InputError(f"{setting}: expected MODULE:NAME, got {name!r}")
    try:
        make = getattr(import_module(module), attribute)
    except ImportError as error:
        raise InputError(f"{setting}: {name}: expected a module that can be imported: {error}") from error
    except AttributeError as error:
        raise InputError(f"{setting}: {name}: the module has no {attribute}") from error
    try:
        made = make()
    except Exception as error:
        raise InputError(f"{setting}: {name}: expected a class to be made without arguments: {error}") from error
    if not callable(getattr(made, expected.split()[-1], None)):
        raise InputError(f"{setting}: {name}: expected {expected}")
    return made
