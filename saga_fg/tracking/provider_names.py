"""Factor providers by name: MODULE:NAME of something that makes one when it is called with its settings."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from saga_fg.errors import InputError
from saga_fg.graph import FactorProvider


def named(name: str) -> Any:
    """What a name such as "my_module:WallDistance" is of.

    Imports the module, which runs its code. Raises `InputError` for a name that leads to nothing.
    """
    module, colon, attribute = name.partition(":")
    if not colon or not module or not attribute.isidentifier():
        raise InputError(f"providers: expected MODULE:NAME, got {name!r}")
    try:
        return getattr(import_module(module), attribute)
    except ImportError as error:
        raise InputError(f"providers: {name}: expected a module that can be imported: {error}") from error
    except AttributeError as error:
        raise InputError(f"providers: {name}: the module has no {attribute}") from error


def new_provider(entry: str | FactorProvider) -> FactorProvider:
    """Make the provider of a name, without arguments; one that is there already is it itself.

    Raises `InputError` for what is none.
    """
    provider = entry
    if isinstance(entry, str):
        try:
            provider = named(entry)()
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"providers: {entry}: expected a class to be made without arguments: {error}") from error
    if isinstance(provider, str) or not callable(getattr(provider, "factors", None)):
        raise InputError(f"providers: {entry}: expected a factor provider, which has a method factors(view)")
    return provider
