"""A drive of scans in the files of other libraries: Open3D, laspy, rosbags, mcap-ros2-support and NumPy.

`write_scans` writes the same points, float32, as a folder of each format, or as messages of ROS 2 with what a vehicle
has besides: transforms, inertial samples, fixes and the odometry of its wheels.
"""

import numpy as np

from data_tools.lidar.scan import load_open3d
from tests.data_tools import mcap_example as example

FOLDERS = ("bin", "pcd", "ply", "las", "npy", "npz")
CLOUD, LASER = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/LaserScan"
IMU, FIX = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
BEGIN = 1_700_000_000.0  # s
DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def write_scans(folder, kind, scans, times, timed=True):
    """A folder of scans with their times, ns, as names; times of points where the format has them."""
    folder.mkdir(parents=True)
    for scan, time in zip(scans, times, strict=True):
        write_scan(folder / f"{round(time * 1e9)}.{kind}", scan, timed and scan.time is not None)
    return folder


def write_scan(path, scan, timed):
    points, intensity = scan.points.astype(np.float32), np.nan_to_num(scan.intensity).astype(np.float32)
    match path.suffix:
        case ".bin":
            np.column_stack([points, intensity]).tofile(path)
        case ".npy":
            np.save(path, np.column_stack([points, intensity]))
        case ".npz":
            np.savez(path, points=points, intensity=intensity, **({"time": scan.time} if timed else {}))
        case ".las":
            import laspy

            header = laspy.LasHeader(point_format=1, version="1.2")
            header.scales = [1e-5] * 3
            cloud = laspy.LasData(header)
            cloud.x, cloud.y, cloud.z = points.astype(np.float64).T
            cloud.gps_time = scan.time if timed else np.zeros(len(points))
            cloud.write(str(path))
        case _:
            open3d = load_open3d()
            cloud = open3d.t.geometry.PointCloud(open3d.core.Tensor(points))
            cloud.point["intensity"] = open3d.core.Tensor(intensity[:, None])
            if timed:
                cloud.point["time"] = open3d.core.Tensor(scan.time[:, None])
            assert open3d.t.io.write_point_cloud(str(path), cloud)


def stamped(time, frame):
    seconds, nanoseconds = divmod(round(time * 1e9), 10**9)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame}


def cloud_message(scan, time, frame="lidar", timed=True, big_endian=False, absolute=False):
    """A PointCloud2 with a gap in each record and rings; times of points relative to the header, or of its clock."""
    order = ">" if big_endian else "<"
    fields = [("x", "f4", 0), ("y", "f4", 4), ("z", "f4", 8), ("intensity", "f4", 16), ("ring", "u2", 20)]
    fields += [("timestamp" if absolute else "time", "f8", 24)] if timed and scan.time is not None else []
    names, kinds, offsets = zip(*fields, strict=True)
    record = np.dtype({"names": names, "formats": [order + kind for kind in kinds], "offsets": offsets, "itemsize": 32})
    rows = np.zeros(len(scan), dtype=record)
    for axis, values in zip("xyz", scan.points.T, strict=True):
        rows[axis] = values
    rows["intensity"] = np.nan_to_num(scan.intensity)
    if names[-1] not in ("ring",):
        rows[names[-1]] = scan.time + (time if absolute else 0.0)
    return {
        "header": stamped(time, frame),
        "height": 1,
        "width": len(scan),
        "fields": [
            {"name": name, "offset": offset, "datatype": DATATYPES[kind], "count": 1} for name, kind, offset in fields
        ],
        "is_bigendian": big_endian,
        "point_step": 32,
        "row_step": 32 * len(scan),
        "data": rows.tobytes(),
        "is_dense": True,
    }


def imu_message(time, acceleration, rate, frame="base_link"):
    return {
        "header": stamped(time, frame),
        "orientation": example.turn(0.0),
        "orientation_covariance": [0.0] * 9,
        "angular_velocity": example.vector(*rate),
        "angular_velocity_covariance": [0.0] * 9,
        "linear_acceleration": example.vector(*acceleration),
        "linear_acceleration_covariance": [0.0] * 9,
    }


def fix_message(time, latitude, longitude, altitude, frame="base_link"):
    return {
        "header": stamped(time, frame),
        "status": {"status": 0, "service": 1},
        "latitude": latitude,
        "longitude": longitude,
        "altitude": altitude,
        "position_covariance": [0.0] * 9,
        "position_covariance_type": 0,
    }


def odometry_message(time, pose, speed, frame="odom", child="base_link"):
    return {
        "header": stamped(time, frame),
        "child_frame_id": child,
        "pose": {"pose": placed(pose), "covariance": [0.0] * 36},
        "twist": {
            "twist": {"linear": example.vector(speed, 0, 0), "angular": example.vector(0, 0, 0)},
            "covariance": [0.0] * 36,
        },
    }


def placed(pose):
    yaw = float(np.arctan2(pose[1, 0], pose[0, 0]))
    return {"position": example.vector(*pose[:3, 3]), "orientation": example.turn(yaw)}


def static_transform(parent, child, pose):
    place = placed(pose)
    edge = {"translation": place["position"], "rotation": place["orientation"]}
    return {"transforms": [{"header": stamped(BEGIN, parent), "child_frame_id": child, "transform": edge}]}


def laser_message(time, ranges, begin, step, frame="laser"):
    return {
        "header": stamped(time, frame),
        "angle_min": begin,
        "angle_max": begin + step * (len(ranges) - 1),
        "angle_increment": step,
        "time_increment": 0.0,
        "scan_time": 0.1,
        "range_min": 0.05,
        "range_max": 30.0,
        "ranges": np.nan_to_num(ranges, nan=np.inf).tolist(),
        "intensities": [],
    }


def scan_messages(scans, times, mount=None, log_offset=0.02, **options):
    """Messages of scans, and the place of the LiDAR on base_link if given; logged a little later than taken."""
    found = []
    if mount is not None:
        found.append(("/tf_static", example.TF, static_transform("base_link", "lidar", mount), round(times[0] * 1e9)))
    for scan, time in zip(scans, times, strict=True):
        found.append(("/points", CLOUD, cloud_message(scan, time, **options), round((time + log_offset) * 1e9)))
    return found
