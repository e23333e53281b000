from .clusters import ClusterSettings, ObjectSize, detect_clusters
from .curbs import Line, extract_curbs, straight_lines
from .degeneracy import Observability, observability
from .deskew import azimuth_times, constant_velocity, deskewed
from .ground import Ground, segment_ground
from .planes import Plane, extract_walls, fit_ground, fit_plane
from .poles import Pole, extract_poles
from .registration import Registration, RegistrationError, RegistrationSettings, register
from .scan import Scan
from .scan_files import read_scan, write_cloud
from .sharpness import scan_to_map_residual
from .submap import Submap, upright
from .surfels import SurfelMap, Surfels, surfels_of
from .voxels import voxel_downsample, voxel_keys

__all__ = [
    "ClusterSettings",
    "Ground",
    "Line",
    "ObjectSize",
    "Observability",
    "Plane",
    "Pole",
    "Registration",
    "RegistrationError",
    "RegistrationSettings",
    "Scan",
    "Submap",
    "SurfelMap",
    "Surfels",
    "azimuth_times",
    "constant_velocity",
    "deskewed",
    "detect_clusters",
    "extract_curbs",
    "extract_poles",
    "extract_walls",
    "fit_ground",
    "fit_plane",
    "observability",
    "read_scan",
    "register",
    "scan_to_map_residual",
    "segment_ground",
    "straight_lines",
    "surfels_of",
    "upright",
    "voxel_downsample",
    "voxel_keys",
    "write_cloud",
]
