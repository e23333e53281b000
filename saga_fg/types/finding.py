"""Suspicions about data and settings, and what mends them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from saga_fg.errors import InputError

FILL_IN = "..."
"""Stands for a name that only the owner of the data knows."""


@dataclass(frozen=True)
class Mend:
    """Entries of a `TableImport` that mend a suspicion.

    columns      by our name: the column, by our name for it as it is read now, that it should be read from
    classes      by the name as it is read now; `FILL_IN` where it is not known
    units        by kind
    coordinates  of rows that say none, "" to leave them
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    classes: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    coordinates: Literal["", "world", "ego", "camera"] = ""

    def __or__(self, other: Mend) -> Mend:
        """Both."""
        return Mend(
            {**self.columns, **other.columns},
            {**self.classes, **other.classes},
            {**self.units, **other.units},
            self.coordinates or other.coordinates,
        )


@dataclass(frozen=True)
class Finding:
    """One suspicion.

    kind      names it; each is told once
    what      what is seen, and what it looks like
    expected  what should be given instead
    mend      what mends it where a table is read; None for none
    option    that of the command, or argument in a program, which mends it, "" for none
    stops     whether the data contradict how they are read; its option mends all that do
    """

    kind: str
    what: str
    expected: str
    mend: Mend | None = None
    option: str = ""
    stops: bool = False

    @property
    def contradicts(self) -> bool:
        """True if another unit, frame or column explains the data, not merely other names."""
        return self.mend is not None and bool(self.mend.units or self.mend.columns or self.mend.coordinates)

    def __str__(self) -> str:
        if not self.option:
            return f"{self.what}; {self.expected}"
        return f"{self.what}; {'fill in and add' if FILL_IN in self.option else 'add'} {self.option}"


def refuse_contradictions(findings: Iterable[Finding], otherwise: str = "--as-given") -> None:
    """Raise one `InputError` for all that contradicts how the data are read, with what mends it."""
    stops = [finding for finding in findings if finding.stops]
    if stops:
        what = "; ".join(dict.fromkeys(finding.what for finding in stops))
        raise InputError(f"{replace(stops[0], what=what)}; {otherwise} reads it as it is")
