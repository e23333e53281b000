"""LiDAR geometry: scans from files, motion de-skew, thinning, local maps and registration.

Points are arrays (N, 3) in m. Unless a function says otherwise they are in the sensor's frame: x ahead, y left, z up.
Open3D is imported when a PCD or PLY file is read.
"""

from data_tools.lidar.deskew import azimuth_times, constant_velocity, deskewed
from data_tools.lidar.ply import write_ply
from data_tools.lidar.registration import Registration, RegistrationError, RegistrationSettings, register
from data_tools.lidar.scan import Scan
from data_tools.lidar.scan_files import read_scan
from data_tools.lidar.sharpness import scan_to_map_residual
from data_tools.lidar.surfels import SurfelMap, Surfels, surfels_of
from data_tools.lidar.voxels import voxel_downsample, voxel_keys

__all__ = [
    "Registration",
    "RegistrationError",
    "RegistrationSettings",
    "Scan",
    "SurfelMap",
    "Surfels",
    "azimuth_times",
    "constant_velocity",
    "deskewed",
    "read_scan",
    "register",
    "scan_to_map_residual",
    "surfels_of",
    "voxel_downsample",
    "voxel_keys",
    "write_ply",
]
