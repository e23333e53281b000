"""One short drive as a table in each format."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

CSV = """\
timestamp,sensor,label,x,y,length,width,yaw,score
0.0,lidar,car,10.2,3.1,4.5,1.9,0.02,0.91
0.0,lidar,pedestrian,4.0,-2.0,,,,0.40
0.1,lidar,,,,,,,
0.1,camera,car,10.5,3.0,,,,0.5
"""


NDJSON = """\
{"timestamp":0, "sensor":"lidar", "label":"car", "x":10.2, "y":3.1, "length":4.5, "width":1.9, "yaw":0.02, "score":0.91}
{"timestamp": 0.0, "sensor": "lidar", "label": "pedestrian", "x": 4, "y": -2, "length": null, "score": 0.40}

{"timestamp": 0.1, "sensor": "lidar"}
{"timestamp": 0.1, "sensor": "camera", "label": "car", "x": 10.5, "y": 3.0, "score": 0.5}
"""


NAN = float("nan")
NPZ: dict[str, Any] = {
    "timestamp": [0.0, 0.0, 0.1, 0.1],
    "sensor": ["lidar", "lidar", "lidar", "camera"],
    "label": ["car", "pedestrian", "", "car"],
    "x": [10.2, 4.0, NAN, 10.5],
    "y": [3.1, -2.0, NAN, 3.0],
    "length": [4.5, NAN, NAN, NAN],
    "width": [1.9, NAN, NAN, NAN],
    "yaw": [0.02, NAN, NAN, NAN],
    "score": [0.91, 0.40, NAN, 0.5],
    "empty": [False, False, True, False],
}


def write(tmp_path: Path, suffix: str, content: Any = None) -> Path:
    path = tmp_path / f"drive{suffix}"
    if suffix == ".npz":
        np.savez(path, **(NPZ if content is None else content))
    else:
        path.write_text({".csv": CSV}.get(suffix, NDJSON) if content is None else content)
    return path
