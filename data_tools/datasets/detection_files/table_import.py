"""Options for reading foreign tables: names of columns and classes, units, coordinates, order of rows."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from difflib import get_close_matches
from typing import Any, Literal

from data_tools.datasets.detection_files.column_names import ALIASES, canonical
from data_tools.datasets.detection_files.units import checked_unit, kind_of, unit_of_speed
from data_tools.plausibility import FILL_IN, Mend
from saga_fg.errors import InputError
from saga_fg.settings import Settings, setting, settings_group

KINDS = ("time", "length", "speed", "angle", "score")


@dataclass(frozen=True)
class TableImport(Settings):
    """Options for reading a table. Those left out follow from the names of the columns; units are s, m, m/s and rad.

    Raises `InputError` for a column that has no meaning and a unit that does not exist.
    """

    columns: Mapping[str, str] = settings_group(
        dict, "the file's name of a column, by ours; an empty text: leave it out"
    )
    classes: Mapping[str, str] = settings_group(
        dict, "our name of a class, by the file's; an empty text: leave the objects of the class out"
    )
    units: Mapping[str, str] = settings_group(
        dict, "units of time (s, ms, us, ns, iso8601, 10Hz), length (m, cm, mm, km, ft), speed, angle (rad, deg), score"
    )
    coordinates: Literal["", "world", "ego", "sensor"] = setting(
        "", "coordinates of rows that say none: world, ego or sensor; empty: world"
    )
    sort: bool = setting(False, "true: sort the rows of each scene by time; the whole table is then held in memory")

    def __post_init__(self) -> None:
        super().__post_init__()
        columns = {}
        for name, column in self.columns.items():
            ours = canonical(name)
            if ours is None:
                known = (*ALIASES, *kind_of)
                nearest = get_close_matches(name, known, n=1, cutoff=0.6)
                hint = (
                    f"did you mean {nearest[0]!r}?" if nearest else f"expected one of {', '.join(dict.fromkeys(known))}"
                )
                raise InputError(f"columns.{name[:40]}: unknown column, {hint}")
            columns[ours] = column
        for kind in self.units:
            if kind not in KINDS:
                raise InputError(f"units.{kind[:40]}: expected one of {', '.join(KINDS)}")
        units = {kind: checked_unit(kind, unit) for kind, unit in self.units.items()}
        vars(self).update(columns=columns, units=units)

    def unit(self, name: str, by_name: str | None) -> str | None:
        """The unit of a column of ours, where its name in the file says `by_name`; None: ours."""
        kind = kind_of.get(name, "")
        if kind in self.units:
            return self.units[kind]
        if by_name is not None:
            return by_name
        return unit_of_speed(self.units["length"]) if kind == "speed" and "length" in self.units else None

    def over(self, other: TableImport) -> TableImport:
        """These ways of reading, over others."""
        return TableImport(
            {**other.columns, **self.columns},
            {**other.classes, **self.classes},
            {**other.units, **self.units},
            self.coordinates or other.coordinates,
            self.sort or other.sort,
        )

    def mended(self, mend: Mend, names: Mapping[str, str]) -> TableImport:
        """A copy with the entries that mend a suspicion; `names`: the file's name of each column of ours."""
        classes = {theirs: mend.classes.get(ours, ours) for theirs, ours in self.classes.items()}
        return replace(
            self,
            columns={**self.columns, **{ours: names.get(other, other) for ours, other in mend.columns.items()}},
            classes={**classes, **{name: ours for name, ours in mend.classes.items() if name not in classes}},
            units={**self.units, **mend.units},
            coordinates=mend.coordinates or self.coordinates,
        )

    def option_for(self, mend: Mend | None, names: Mapping[str, str]) -> str:
        """The options that mend a suspicion, in place of those of the same name; "" for none."""
        if mend is None:
            return ""
        mended = self.mended(mend, names)
        changed = {field.name: getattr(mended, field.name) for field in fields(Mend) if getattr(mend, field.name)}
        return TableImport(**changed).options().strip()

    def options(self) -> str:
        """The options of the command that say the same, with a space before each; empty if there are none."""
        text = ""
        for name in ("columns", "classes", "units"):
            pairs = ",".join(f"{ours}={theirs}" for ours, theirs in getattr(self, name).items())
            text += f" --{name} {shlex.quote(pairs)}" if pairs else ""
        return text + (f" --coordinates {self.coordinates}" if self.coordinates else "") + " --sort" * self.sort

    def values(self) -> dict[str, Any]:
        """The values that differ from the default, for a record."""
        return {name: value for name, value in asdict(self).items() if value}


def pairs(option: str, text: str | None) -> dict[str, str]:
    """The entries of an option `a=b,c=d`. Raises `InputError` for an invalid entry, and one that occurs twice."""
    found: dict[str, str] = {}
    for entry in (text or "").split(","):
        name, equals, value = (part.strip() for part in entry.partition("="))
        if not entry.strip():
            continue
        if not equals or not name:
            raise InputError(f"{option}: expected NAME=VALUE with commas between them, got {entry.strip()[:40]!r}")
        if name in found:
            raise InputError(f"{option}: expected {name[:40]!r} once")
        if value == FILL_IN:
            raise InputError(f"{option}: {name[:40]}={FILL_IN}: expected a name in place of the dots")
        found[name] = value
    return found
