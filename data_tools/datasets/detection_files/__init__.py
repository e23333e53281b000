"""Detections in and tracks out, as plain tables: CSV, newline-delimited JSON, NumPy arrays.

One row per detection. The same columns in every format; only the first three are required:

    timestamp             s, any epoch; must not decrease within a scene
    x, y                  centre, m
    z                     centre, m                                  default 0
    length, width, height m                                          default unknown
    yaw                   rad, from x towards y                      default unknown
    vx, vy                m/s over ground                            default unknown
    range_rate            m/s over ground along the horizontal line of sight from the sensor, positive when the object
                          moves away; needs ego_x, ego_y, ego_yaw    default unknown
    cov_xx, cov_xy, cov_yy
                          covariance of the position, m^2            default that of the sensor's model
    score                 any finite number, higher is surer         default 1
    label                 class name                                 default "object"
    sensor                name of the sensor                         default "sensor"
    scene                 name of the recording                      default the file's name
    coordinates           "world", "ego", "sensor" or "camera"       default "world"
    ego_x, ego_y, ego_yaw pose of the vehicle, m and rad             required unless coordinates is "world", or the
    ego_z                 m                                          vehicle measures itself; ego_z: default 0
    odometry_x, odometry_y, odometry_yaw, odometry_dt                default unknown
                          how the vehicle has moved over the last odometry_dt s, in its frame of then, m and rad
    gps_x, gps_y, gps_z   its place as measured, m                   default unknown
    qw, qx, qy, qz        rotation as a unit quaternion, instead of yaw
    ego_qw, ego_qx, ego_qy, ego_qz                                   instead of ego_yaw

Columns by other names (`pos_x`, `timestamp_ns`, `confidence`, ...), in other units or with other classes are understood
too, by `saga_fg.tables.column_names` or by what a `TableImport` says.

Rows with the same scene, timestamp and sensor are one frame. A row whose x and y are both left out says that the sensor
looked and saw nothing (in NumPy arrays, which cannot leave anything out: a boolean array `empty`).

CSV has a header line with the names of its columns, in any order; what is unknown is left empty:

    timestamp,sensor,label,x,y,length,width,yaw,score
    0.0,lidar,car,10.2,3.1,4.5,1.9,0.02,0.91
    0.0,lidar,pedestrian,4.0,-2.0,,,,0.40
    0.1,lidar,,,,,,,

Newline-delimited JSON (.ndjson, .jsonl) has an object with the same names on each line; what is unknown is left out:

    {"timestamp": 0.0, "sensor": "lidar", "label": "car", "x": 10.2, "y": 3.1, "yaw": 0.02, "score": 0.91}
    {"timestamp": 0.1, "sensor": "lidar"}

NumPy archives (.npz, without pickled objects) have an array for each column, all of one length:

    np.savez("detections.npz", timestamp=[0.0, 0.1], x=[10.2, 0.0], y=[3.1, 0.0], empty=[False, True])

Tables of true objects have the columns of tracks, and `visible`: 0 for objects that no sensor can see.

Parquet, Feather and Arrow files have the same columns (extra [parquet]).

Tracks are written with the same columns and, besides, id, cov_xx, cov_xy, cov_yy (covariance of the horizontal
position, m^2), cov_vxvx, cov_vxvy, cov_vyvy (of the velocity, (m/s)^2), coasting (s since the last detection)
and settled (0 where the solver found no minimum of a nonlinear graph, else 1).
"""

from data_tools.datasets.detection_files.dataset import TruthTable, read_detections, read_scenes_in_parts, read_truth
from data_tools.datasets.detection_files.tracks import (
    PREDICTION_COLUMNS,
    PredictionRows,
    TrackRows,
    prediction_writer,
    predictions_path,
    read_predictions,
    read_tracks,
    track_rows,
    write_label_table,
    write_review,
    write_rows,
    write_tracks,
)
from saga_fg.tables import LABEL_COLUMNS, TRACK_COLUMNS, TableImport

__all__ = [
    "LABEL_COLUMNS",
    "PREDICTION_COLUMNS",
    "TRACK_COLUMNS",
    "PredictionRows",
    "TableImport",
    "TrackRows",
    "TruthTable",
    "prediction_writer",
    "predictions_path",
    "read_detections",
    "read_predictions",
    "read_scenes_in_parts",
    "read_tracks",
    "read_truth",
    "track_rows",
    "write_label_table",
    "write_review",
    "write_rows",
    "write_tracks",
]
