from .landmarks import (
    Ground,
    Plane,
    Pole,
    extract_poles,
    extract_walls,
    fit_plane,
    segment_ground,
)
from .places import Submap, upright
from .registration import (
    Observability,
    Registration,
    RegistrationError,
    SurfelMap,
    Surfels,
    observability,
    register,
    surfels_of,
)
from .scan import Scan, azimuth_times, constant_velocity, deskewed, voxel_downsample, voxel_keys
from .scan_files import read_scan, write_cloud

__all__ = [
    "Ground",
    "Observability",
    "Plane",
    "Pole",
    "Registration",
    "RegistrationError",
    "Scan",
    "Submap",
    "SurfelMap",
    "Surfels",
    "azimuth_times",
    "constant_velocity",
    "deskewed",
    "extract_poles",
    "extract_walls",
    "fit_plane",
    "observability",
    "read_scan",
    "register",
    "segment_ground",
    "surfels_of",
    "upright",
    "voxel_downsample",
    "voxel_keys",
    "write_cloud",
]
