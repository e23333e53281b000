"""LiDAR geometry: scans from files, de-skew, thinning, registration, ground, walls, poles, curbs and objects.

Points are arrays (N, 3) in m. Unless a function says otherwise they are in the sensor's frame: x ahead, y left, z up.
Open3D is imported when a PCD or PLY file is read.
"""

from data_tools.lidar.clusters import ClusterSettings, ObjectSize, detect_clusters
from data_tools.lidar.curbs import CurbSettings, Line, LineSettings, extract_curbs, straight_lines
from data_tools.lidar.deskew import azimuth_times, constant_velocity, deskewed
from data_tools.lidar.ground import Ground, GroundSettings, segment_ground
from data_tools.lidar.planes import Plane, PlaneSettings, extract_walls, fit_ground, fit_plane
from data_tools.lidar.poles import Pole, PoleSettings, extract_poles
from data_tools.lidar.registration import Registration, RegistrationError, RegistrationSettings, register
from data_tools.lidar.scan import Scan
from data_tools.lidar.scan_files import read_scan, write_ply
from data_tools.lidar.sharpness import scan_to_map_residual
from data_tools.lidar.surfels import SurfelMap, Surfels, surfels_of
from data_tools.lidar.voxels import voxel_downsample, voxel_keys

__all__ = [
    "ClusterSettings",
    "CurbSettings",
    "Ground",
    "GroundSettings",
    "Line",
    "LineSettings",
    "ObjectSize",
    "Plane",
    "PlaneSettings",
    "Pole",
    "PoleSettings",
    "Registration",
    "RegistrationError",
    "RegistrationSettings",
    "Scan",
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
    "read_scan",
    "register",
    "scan_to_map_residual",
    "segment_ground",
    "straight_lines",
    "surfels_of",
    "voxel_downsample",
    "voxel_keys",
    "write_ply",
]
