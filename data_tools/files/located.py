"""Error messages that say where: file and record in front of what was expected."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from difflib import get_close_matches

from saga_fg.errors import InputError


@contextmanager
def located(where: str) -> Iterator[None]:
    """Put `where` in front of any `InputError` of the block."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def unknown(what: str, name: str, known: tuple[str, ...]) -> str:
    """One line on a name that is not among the `known` ones: the nearest of them, and the list if it is short."""
    nearest = get_close_matches(name, known, n=1, cutoff=0.6)
    hint = f"; did you mean {nearest[0]!r}? Expected" if nearest else ", expected"
    shown = ", ".join(known[:12]) + (f", ... ({len(known)} in all)" if len(known) > 12 else "")
    return f"unknown {what} {name!r}{hint} one of: {shown or 'none here'}"
