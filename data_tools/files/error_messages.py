"""Parts of error messages: the file and record concerned, and the nearest known name."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from difflib import get_close_matches

from saga_fg.errors import InputError


@contextmanager
def error_context(where: str) -> Iterator[None]:
    """Prefix every `InputError` of the block with `where`, unless it begins so."""
    try:
        yield
    except InputError as error:
        if str(error).startswith(f"{where}: "):
            raise
        raise InputError(f"{where}: {error}") from error


def unknown_name(what: str, name: str, known: tuple[str, ...]) -> str:
    """Message about a name that is not among the `known` ones: the nearest of them, and the list if it is short."""
    nearest = get_close_matches(name, known, n=1, cutoff=0.6)
    hint = f"; did you mean {nearest[0]!r}? Expected" if nearest else ", expected"
    shown = ", ".join(known[:12]) + (f", ... ({len(known)} in all)" if len(known) > 12 else "")
    return f"unknown {what} {name!r}{hint} one of: {shown or 'none here'}"
