"""Columns by the names that files of others give them: aliases, units at the end of a name, and misspelt names.

A name is compared without case, and with `_` for spaces, dots and dashes. Its end may be a unit of what it holds:
`pos_x_m`, `timestamp_ns`, `yaw_deg`, `speed_x_kmh`. Where two columns could have one meaning, neither is taken.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from types import MappingProxyType

from data_tools.datasets.detection_files.units import UNITS, kind_of
from data_tools.plausibility import FILL_IN

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
    "drive_id",
    **{f"ego_{axis}": _EGO.replace("#", axis) for axis in "xyz"},
    "ego_yaw": "ego_heading ego_theta ego_vehicle_yaw ego_vehicle_heading",
    **{f"q{axis}": _QUATERNION.replace("#", axis) for axis in "wxyz"},
    **{f"ego_q{axis}": f"ego_quat_{axis} ego_q_{axis} ego_rotation_{axis}" for axis in "wxyz"},
    "id": "track_id object_id obj_id tracking_id track_uuid instance_id instance_token uuid vehicle_id agent_id "
    "target_id track_token instance",
    "visible": "is_visible visibility",
}
ALIASES = MappingProxyType({ours: tuple(aliases.split()) for ours, aliases in _ALIASES.items()})
_SHORTEST_GUESS = 4  # letters of a name that may be a misspelt one
_OF_TRACKS = {"id", "coasting", "settled", "cov_xx", "cov_xy", "cov_yy", "cov_vxvx", "cov_vxvy", "cov_vyvy"}
_OURS = {alias: ours for ours, aliases in ALIASES.items() for alias in aliases}


@dataclass(frozen=True)
class Columns:
    """The columns of a file by their meaning.

    names   the file's name of each column of ours
    units   by our name, where the file's name ends in one
    unread  columns of the file that have no meaning here
    faults  what is wrong with the names, a text each
    open    by our name, the file's name that mends a fault, `FILL_IN` where it is not known
    """

    names: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    unread: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()
    open: Mapping[str, str] = field(default_factory=dict)


def canonical(name: str) -> str | None:
    """Our name of a column by ours or an alias, without a unit; None for one that has no meaning."""
    plain = _plain(name)
    return plain if plain in ALIASES or plain in kind_of else _OURS.get(plain)


def meaning(name: str) -> tuple[str, str | None] | None:
    """Our name of a column of a file, and the unit at its end; None for one that has no meaning."""
    ours = canonical(name)
    if ours is not None:
        return ours, None
    start, _, end = _plain(name).rpartition("_")
    ours = canonical(start) if start else None
    unit = None if ours is None else UNITS.get(kind_of.get(ours, ""), {}).get(end)
    return None if ours is None or unit is None else (ours, unit)


def understood(
    names: Collection[str],
    columns: Collection[str],
    required: Collection[str],
    given: Mapping[str, str],
    lenient: bool = False,
) -> Columns:
    """Find the columns of a file by their names; faults are all that are missing, misspelt, or could be either of two.

    names     of the file
    columns   of ours that have a meaning in it; required: those of them that it must have
    given     by our name, the file's name, "" for none; lenient: they need not be there
    """
    chosen: dict[str, str] = {}
    faults: list[str] = []
    mends: dict[str, str] = {}
    for ours, name in given.items():
        if name in names and ours in columns:
            chosen[ours] = name
        elif name and ours in columns and not lenient:
            mends[ours] = FILL_IN
            faults.append(f"--columns {ours}={name[:40]}: there is no column {name[:40]!r}")
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
            faults.append(
                f"{ours}: expected one column, {either} could be it; choose: --columns {ours}={candidates[0]}"
            )
    doubtful = {name for candidates in possible.values() for name in candidates}
    unread = sorted(set(names) - set(chosen.values()) - doubtful)
    for name in unread:
        if meaning(name) is None and len(name) >= _SHORTEST_GUESS:
            free_columns = set(columns) - chosen.keys() - given.keys() - (set() if "id" in chosen else _OF_TRACKS)
            nearest = get_close_matches(name, free_columns, n=1, cutoff=0.75)
            if nearest:
                mends[nearest[0]] = name
                mend = f"--columns {nearest[0]}={name[:40]}, or {nearest[0]}= if it is another"
                faults.append(f"unknown column {name[:40]!r}; did you mean {nearest[0]!r}? ({mend})")
    missing = [ours for ours in required if ours not in chosen and ours not in possible]
    if missing:
        mends |= dict.fromkeys(missing, FILL_IN)
        there = ", ".join(name[:40] for name in sorted(names)[:12]) or "none"
        there += f", ... ({len(names)} in all)" if len(names) > 12 else ""
        wanted = " and ".join(f"a column {ours!r}" for ours in missing)
        mend = f"; name it: --columns {','.join(f'{ours}=NAME' for ours in missing)}" if names else ""
        faults.insert(0, f"expected {wanted}, the columns there are {there}{mend}")
    ends = {ours: meaning(name) for ours, name in chosen.items()}
    units = {
        ours: found[1]
        for ours, found in ends.items()
        if found is not None and found[1] and kind_of.get(found[0]) == kind_of.get(ours)
    }
    return Columns(chosen, units, tuple(unread), tuple(faults), mends)


def _plain(name: str) -> str:
    return re.sub(r"[^0-9a-z]+", "_", name.strip().lower()).strip("_")
