"""Factor providers by name: MODULE:NAME of something that makes one when it is called without arguments."""

from __future__ import annotations

from importlib import import_module

from saga_fg.errors import InputError
from saga_fg.graph import FactorProvider


def new_provider(name: str) -> FactorProvider:
    """Make the provider of a name such as "my_module:WallDistance".

    Imports the module, which runs its code. Raises `InputError` for a name that leads to none.
    """
    module, colon, attribute = name.partition(":")
    if not colon or not module or not attribute.isidentifier():
        raise InputError(f"providers: expected MODULE:NAME, got {name!r}")
    try:
        make = getattr(import_module(module), attribute)
    except ImportError as error:
        raise InputError(f"providers: {name}: expected a module that can be imported: {error}") from error
    except AttributeError as error:
        raise InputError(f"providers: {name}: the module has no {attribute}") from error
    try:
        provider: FactorProvider = make()
    except Exception as error:
        raise InputError(f"providers: {name}: expected a class to be made without arguments: {error}") from error
    if not callable(getattr(provider, "factors", None)):
        raise InputError(f"providers: {name}: expected a factor provider, which has a method factors(view)")
    return provider
