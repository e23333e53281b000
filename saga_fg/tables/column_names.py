"""Columns by the names that tables of others give them, their units, and the options that say both.

A name is compared without case, and with `_` for spaces, dots and dashes. Its end may be a unit of what it holds:
`pos_x_m`, `timestamp_ns`, `yaw_deg`, `speed_x_kmh`. Where two columns could have one meaning, neither is taken.
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from difflib import get_close_matches
from functools import reduce
from operator import or_
from types import MappingProxyType
from typing import Any, Literal

from saga_fg.errors import InputError, require_type
from saga_fg.settings import Settings, setting, settings_group
from saga_fg.tables.plausibility import FRAME_COUNTS
from saga_fg.tables.units import KINDS, UNITS, checked_unit, kind_of, quantity, unit_of_speed
from saga_fg.types import FILL_IN, Finding, Mend

_BY_SIZE = {
    "times": "timestamp",
    "angle in degrees": "yaw",
    "ego_yaw in degrees": "ego_yaw",
    "lengths": "length",
    "places": "x",
}
"""By kind of finding: a column whose unit is told by the size of its numbers alone."""
_DEGREES = {"clockwise": "clockwise_deg", "compass_rad": "compass"}

_PLACE = (
    "pos_# position_# #_position #_pos p# t# c# center_# #_center centre_# #_centre translation_# location_# #_world "
    "world_# bbox_center_# box_center_#"
)
_SPEED = "v#_m vel_# velocity_# #_velocity #_vel v_# speed_#"
_QUATERNION = "quat_# quaternion_# q_# rotation_# orientation_#"
_EGO = "ego_pos_# ego_position_# ego_t# ego_translation_# ego_vehicle_#"
_ALIASES = {
    "timestamp": "time ts t stamp time_stamp datetime date_time utc_time epoch unix_time",
    **{axis: _PLACE.replace("#", axis) for axis in "xyz"},
    "length": "l len size_x size_l dim_x dimension_x dimensions_x box_length",
    "width": "w wid size_y size_w dim_y dimension_y dimensions_y box_width",
    "height": "h hgt ht size_z size_h dim_z dimension_z dimensions_z box_height",
    "yaw": "heading hdg theta yaw_angle heading_angle rot_z orientation",
    **{f"v{axis}": _SPEED.replace("#", axis) for axis in "xy"},
    "score": "confidence conf prob probability detection_score tracking_score existence",
    "label": "class category type class_name object_type object_class obj_type obj_class cls classification "
    "detection_name tracking_name category_name class_id class_label",
    "sensor": "sensor_name sensor_id",
    "scene": "scene_name scene_id scene_token log_id log_name recording recording_id scenario scenario_id segment_id "
    "drive_id sequence sequence_id sequence_name",
    **{f"ego_{axis}": _EGO.replace("#", axis) for axis in "xyz"},
    "ego_yaw": "ego_heading ego_theta ego_vehicle_yaw ego_vehicle_heading",
    **{f"q{axis}": _QUATERNION.replace("#", axis) for axis in "wxyz"},
    **{f"ego_q{axis}": f"ego_quat_{axis} ego_q_{axis} ego_rotation_{axis}" for axis in "wxyz"},
    "id": "track_id object_id obj_id tracking_id track_uuid instance_id instance_token uuid vehicle_id agent_id "
    "target_id track_token instance",
    "visible": "is_visible visibility",
    "coordinates": "coordinate_system",
}
ALIASES = MappingProxyType({ours: tuple(aliases.split()) for ours, aliases in _ALIASES.items()})
_SHORTEST_GUESS = 4  # letters of a name that may be a misspelt one
_OF_TRACKS = {"id", "coasting", "settled", "cov_xx", "cov_xy", "cov_yy", "cov_vxvx", "cov_vxvy", "cov_vyvy"}
_WITHOUT_ALIAS = {*_OF_TRACKS, "odometry_dt"}
_OURS = {alias: ours for ours, aliases in ALIASES.items() for alias in aliases}


@dataclass(frozen=True)
class Columns:
    """The columns of a file by their meaning.

    names   the file's name of each column of ours
    units   by our name, where the file's name ends in one
    unread  columns of the file that have no meaning here
    faults  what is wrong with the names, a text each
    open    what mends the faults: the file's name of columns, `FILL_IN` where it is not known
    """

    names: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    unread: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()
    open: Mend = field(default_factory=Mend)


COMMAND = "--"
"""Stands for options of the command, where another text names an argument of a program."""


def canonical(name: str) -> str | None:
    """Our name of a column by ours or an alias, without a unit; None for one that has no meaning."""
    plain = _plain(name)
    return plain if plain in ALIASES or plain in kind_of or plain in _WITHOUT_ALIAS else _OURS.get(plain)


def meaning(name: str) -> tuple[str, str | None] | None:
    """Our name of a column of a file, and the unit at its end; None for one that has no meaning."""
    ours = canonical(name)
    if ours is not None:
        return ours, None
    ours = canonical(_plain(name).rpartition("_")[0])
    unit = None if ours is None else _unit_at_end(ours, name)
    return None if ours is None or unit is None else (ours, unit)


def _unit_at_end(ours: str, name: str) -> str | None:
    """The unit at the end of a file's name of a column of ours, None for none."""
    start, _, end = _plain(name).rpartition("_")
    return UNITS.get(kind_of.get(ours, ""), {}).get(end) if start and canonical(name) is None else None


def understood(
    names: Collection[str],
    columns: Collection[str],
    required: Collection[str],
    how: TableImport,
    lenient: bool = False,
    within: str = COMMAND,
) -> Columns:
    """Find the columns of a file by their names; faults are all that are missing, misspelt, or could be either of two.

    names     of the file
    columns   of ours that have a meaning in it; required: those of them that it must have
    how       names columns, which need not be there if `lenient`, and may have a unit of times
    within    as of `option_text`, for what mends a fault
    """

    def naming(columns: Mapping[str, str]) -> str:
        return option_text({"columns": columns}, within)

    given = how.columns
    chosen: dict[str, str] = {}
    faults: list[str] = []
    mends: dict[str, str] = {}
    units: dict[str, str] = {}
    for ours, name in given.items():
        if name in names and ours in columns:
            chosen[ours] = name
        elif name and not lenient and name not in names:
            mends[ours] = FILL_IN
            faults.append(f"{naming({ours: name[:40]})}: there is no column {name[:40]!r}")
    taken = set(chosen.values())
    free = [name for name in names if name not in taken]
    for name in free:
        if name in columns and name not in given:
            chosen[name] = name
    possible: dict[str, list[str]] = {}
    for name in free:
        found = meaning(name)
        if found is not None and found[0] in columns and found[0] not in chosen and given.get(found[0], name) != "":
            possible.setdefault(found[0], []).append(name)
    for ours, candidates in possible.items():
        if len(candidates) == 1:
            chosen[ours] = candidates[0]
        else:
            mends[ours] = FILL_IN
            either = " or ".join(repr(name[:40]) for name in sorted(candidates))
            mend = naming({ours: candidates[0]})
            faults.append(f"{ours}: expected one column, {either} could be it; choose: {mend}")
    doubtful = {name for candidates in possible.values() for name in candidates}
    unread = sorted(set(names) - set(chosen.values()) - doubtful)
    for name in unread:
        if meaning(name) is None and len(name) >= _SHORTEST_GUESS:
            free_columns = set(columns) - chosen.keys() - given.keys() - (set() if "id" in chosen else _OF_TRACKS)
            nearest = get_close_matches(name, free_columns, n=1, cutoff=0.75)
            if nearest:
                mends[nearest[0]] = name
                mend = f"{naming({nearest[0]: name[:40]})}, or {naming({nearest[0]: ''})} if it is another"
                faults.append(f"unknown column {name[:40]!r}; did you mean {nearest[0]!r}? ({mend})")
    missing = [ours for ours in required if ours not in chosen and ours not in possible]
    if missing:
        there = ", ".join(name[:40] for name in sorted(names)[:12]) or "none"
        there += f", ... ({len(names)} in all)" if len(names) > 12 else ""
        wanted = " and ".join(f"a column {ours!r}" for ours in missing)
        counted = next((name for name in unread if _plain(name) in FRAME_COUNTS and "timestamp" in missing), "")
        mends |= dict.fromkeys(missing, FILL_IN) | ({"timestamp": counted} if counted else {})
        if counted and how.unit("timestamp", None) is None:
            units = {"time": "10Hz"}  # as many frames a second, to be changed
        named = {ours: "NAME" if mends[ours] == FILL_IN else mends[ours] for ours in missing}
        mend = f"; name it: {option_text({'columns': named} | ({'units': units} if units else {}), within)}"
        mend = mend if names else ""
        faults.insert(0, f"expected {wanted}, the columns there are {there}{mend}")
    ends = {ours: _unit_at_end(ours, name) for ours, name in chosen.items()}
    in_names = {ours: unit for ours, unit in ends.items() if unit is not None}
    return Columns(chosen, in_names, tuple(unread), tuple(faults), Mend(columns=mends, units=units))


def option_text(entries: Mapping[str, Any], within: str = COMMAND) -> str:
    """Entries of a `TableImport` as options of the command, as an argument of a program, or as lines of a file.

    within: the argument that is a `TableImport`, or the option that names such a file
    """
    if within == COMMAND:
        texts = {name: _of_option(value) for name, value in entries.items() if value}
        return " ".join(f"--{name.replace('_', '-')} {text}".rstrip() for name, text in texts.items())
    if within.startswith(COMMAND):
        lines = (f"{name}: {json.dumps(value, ensure_ascii=False)}" for name, value in entries.items())
        return f"{within} ({', '.join(lines)})"
    return f"{within}=TableImport({', '.join(f'{name}={value!r}' for name, value in entries.items())})"


def _of_option(value: Any) -> str:
    if value is True:
        return ""
    return shlex.quote(value if isinstance(value, str) else ",".join(f"{a}={b}" for a, b in value.items()))


def _plain(name: str) -> str:
    return re.sub(r"[^0-9a-z]+", "_", name.strip().lower()).strip("_")


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
        dict,
        "units of time (s, ms, us, ns, iso8601, 10Hz), length (m, cm, mm, km, ft), speed, score, "
        "angle (rad, deg, clockwise, clockwise_deg, compass, compass_rad), or of a column such as yaw",
    )
    coordinates: Literal["", "world", "ego", "sensor", "camera"] = setting(
        "",
        "coordinates of rows that say none: world, ego, sensor or camera (at the vehicle's origin, x to the right, y "
        "down, z ahead, yaw about y from x); empty: world",
    )
    sort: bool = setting(False, "true: sort the rows of each scene by time; the whole table is then held in memory")
    as_given: bool = setting(False, "true: read a table as these options say even where its contents contradict them")

    def __post_init__(self) -> None:
        super().__post_init__()
        for option in ("columns", "classes", "units"):
            require_type(option, getattr(self, option), Mapping)
        columns = {}
        for name, column in self.columns.items():
            ours = canonical(name)
            if ours is None:
                known = (*ALIASES, *kind_of, *sorted(_WITHOUT_ALIAS))
                nearest = get_close_matches(name, known, n=1, cutoff=0.6)
                hint = (
                    f"did you mean {nearest[0]!r}?" if nearest else f"expected one of {', '.join(dict.fromkeys(known))}"
                )
                raise InputError(f"columns.{name[:40]}: unknown column, {hint}")
            columns[ours] = column
        for name in self.units:
            if name not in KINDS and name not in kind_of:
                raise InputError(f"units.{name[:40]}: expected one of {', '.join(KINDS)}, or a column such as yaw")
        units = {name: checked_unit(quantity(name), unit) for name, unit in self.units.items()}
        vars(self).update(columns=columns, units=units)

    def unit(self, name: str, by_name: str | None) -> str | None:
        """The unit of a column of ours, where its name in the file says `by_name`; None: ours."""
        kind = kind_of.get(name, "")
        if name in self.units or kind in self.units:
            return self.units.get(name) or self.units[kind]
        if by_name is not None:
            return by_name
        return unit_of_speed(self.units["length"]) if kind == "speed" and "length" in self.units else None

    def naming(self, columns: Collection[str]) -> TableImport:
        """A copy that names none but these columns of ours."""
        return replace(self, columns={ours: theirs for ours, theirs in self.columns.items() if ours in columns})

    def over(self, other: TableImport) -> TableImport:
        """These ways of reading, over others."""
        return TableImport(
            {**other.columns, **self.columns},
            {**other.classes, **self.classes},
            {**other.units, **self.units},
            self.coordinates or other.coordinates,
            self.sort or other.sort,
            self.as_given or other.as_given,
        )

    def mended(self, mend: Mend, names: Mapping[str, str]) -> TableImport:
        """A copy with the entries that mend a suspicion; `names`: the file's name of each column of ours."""
        classes = {theirs: mend.classes.get(ours, ours) for theirs, ours in self.classes.items()}
        return replace(
            self,
            columns={**self.columns, **{ours: names.get(other, other) for ours, other in mend.columns.items()}},
            classes={**classes, **{name: ours for name, ours in mend.classes.items() if name not in classes}},
            units={**self.units, **self._in_degrees(mend.units, names)},
            coordinates=mend.coordinates or self.coordinates,
        )

    def _in_degrees(self, units: Mapping[str, str], names: Mapping[str, str]) -> Mapping[str, str]:
        """Units that mend, where angles are read as degrees already."""

        def mended(name: str, unit: str) -> str:
            column = "yaw" if name == "angle" else name
            by_name = _unit_at_end(column, names.get(column, ""))
            return _DEGREES.get(unit, unit) if self.unit(column, by_name) == "deg" else unit

        return {name: mended(name, unit) if quantity(name) == "angle" else unit for name, unit in units.items()}

    def option_for(self, mend: Mend, names: Mapping[str, str], within: str = COMMAND) -> str:
        """The options that mend a suspicion, in place of those of the same name; `within` as of `option_text`."""
        mended = self.mended(mend, names)
        entries = {each.name: getattr(mended, each.name) for each in fields(Mend) if getattr(mend, each.name)}
        return option_text(entries, within)

    def _possible(self, mend: Mend, names: Mapping[str, str]) -> Mend | None:
        """The mend of a finding without what these options say already; None if nothing is left.

        Speeds that are read as m/s already cannot be mended by that unit: their columns are left out instead.
        """
        by_name = _unit_at_end("vx", names.get("vx", ""))
        if mend.units.get("speed") == "m/s" and self.unit("vx", by_name) in (None, "m/s"):
            units = {name: unit for name, unit in mend.units.items() if name != "speed"}
            mend = replace(mend, units=units, columns={**mend.columns, "vx": "", "vy": ""})
        mended = self.mended(mend, {})
        return mend if any(getattr(mended, each.name) != getattr(self, each.name) for each in fields(Mend)) else None

    def _says(self, kind: str) -> bool:
        """True if a suspicion stops nothing: it rests on the size of numbers, and their unit is given here."""
        column = _BY_SIZE.get(kind, "")
        return self.as_given or bool({column, kind_of.get(column)} & self.units.keys())

    def judged(
        self, findings: Iterable[Finding], names: Mapping[str, str], within: str = COMMAND
    ) -> tuple[Finding, ...]:
        """The findings, each with the options that mend it, as of `option_for`, and whether the table contradicts how
        it is read."""
        judged = [one if one.mend is None else replace(one, mend=self._possible(one.mend, names)) for one in findings]
        judged = [replace(one, stops=one.contradicts and not self._says(one.kind)) for one in judged]
        together = reduce(or_, (one.mend for one in judged if one.stops and one.mend is not None), Mend())
        mends = [together if one.stops else one.mend for one in judged]
        options = ["" if mend is None else self.option_for(mend, names, within) for mend in mends]
        return tuple(
            replace(one, mend=mend, option=option) for one, mend, option in zip(judged, mends, options, strict=True)
        )

    def options(self) -> str:
        """The options of the command that say the same, with a space before each; empty if there are none."""
        return f" {option_text(self.values())}".rstrip()

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
