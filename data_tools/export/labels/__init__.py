"""Labels as files that trainers read."""

from data_tools.export.labels.box_table import LABEL_COLUMNS, LabelRows, read_label_table, write_label_table
from data_tools.export.labels.kitti import write_kitti_labels
from data_tools.export.labels.nuscenes import merge_label_parts, write_label_part, write_nuscenes_labels

__all__ = [
    "LABEL_COLUMNS",
    "LabelRows",
    "merge_label_parts",
    "read_label_table",
    "write_kitti_labels",
    "write_label_part",
    "write_label_table",
    "write_nuscenes_labels",
]
