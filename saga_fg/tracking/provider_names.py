"""Parts of users' own by name: MODULE:NAME of a class or function that makes one when called with its settings."""

from __future__ import annotations

from copy import deepcopy
from importlib import import_module
from typing import Any

from saga_fg.errors import InputError
from saga_fg.graph import FactorProvider


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
    module, colon, attribute = name.partition(":")
    if not colon or not module or not attribute.isidentifier():
        raise InputError(f"{setting}: expected MODULE:NAME, got {name!r}")
    try:
        return getattr(import_module(module), attribute)
    except ImportError as error:
        raise InputError(f"{setting}: {name}: expected a module that can be imported: {error}") from error
    except AttributeError as error:
        raise InputError(f"{setting}: {name}: the module has no {attribute}") from error
