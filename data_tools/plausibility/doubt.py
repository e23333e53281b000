"""One suspicion about data."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Doubt:
    """One suspicion.

    kind      names it; each is told once
    what      what is seen, and what it looks like
    expected  what should be given instead
    option    of a command that reads a table, that mends it; "" for none
    """

    kind: str
    what: str
    expected: str
    option: str = ""

    def text(self, options: bool) -> str:
        """One line: with the option where the command has `options` for tables."""
        return f"{self.what}; {f'add {self.option}' if options and self.option else self.expected}"
