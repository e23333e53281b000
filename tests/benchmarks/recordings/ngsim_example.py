"""A crossing with a light, written by hand: two lanes side by side to the east, one of them goes on, and three cars."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

HEADER = "site,scenario,id,step,type,x,y,yaw,speed,accel,length,width"


def lanelet(number: int, y: float, x: tuple[float, float], **more: Any) -> dict[str, Any]:
    """A straight lanelet to the east, 4 m wide, about `y`."""
    borders = {side: [[x[0], y + off], [x[1], y + off]] for side, off in (("left", 2.0), ("right", -2.0))}
    return {"id": number, **borders, "successor": [], "stop_line": None, "lights": [], **more}


def crossing() -> dict[str, Any]:
    """Lanes 1 (goes on in 3) and 2 (ends at the line) before a line at x = 0; green 1 s, amber 0.5 s, red 2 s."""
    line = {"stop_line": "end of the lanelet", "lights": [7]}
    light = {"id": 7, "position": [[9.0, 9.0]], "direction": "all", "time_offset": 3}
    return {
        "lanelets": [
            lanelet(1, 4.0, (-50.0, 0.0), successor=[3], **line),
            lanelet(2, 0.0, (-50.0, 0.0), **line),
            lanelet(3, 4.0, (0.0, 50.0)),
        ],
        "lights": [{**light, "cycle": [["green", 10], ["yellow", 5], ["red", 20]]}],
    }


def rows(scenario: str = "A", steps: int = 12) -> list[str]:
    """Car 1 drives in the upper lane, car 2 waits at the line, truck 3 comes at step 5 and is 12 m long."""
    found = []
    for k in range(steps):
        found.append(f"X,{scenario},1,{k},car,{-40 + k},4,0,10,,4.5,1.8")
        found.append(f"X,{scenario},2,{k},car,-3,0,0,0,,4.5,1.8")
        if k >= 5:
            found.append(f"X,{scenario},3,{k},car,{-30 + 0.5 * k},0,0,5,0.1,12,2.5")
    return found


def write_ngsim(root: Path, lines: list[str], maps: Any = None, header: str = HEADER) -> Path:
    """Write windows.csv.gz and, if there are some, maps.json.gz."""
    (root / "windows.csv.gz").write_bytes(gzip.compress("\n".join([header, *lines, ""]).encode()))
    if maps is not None:
        (root / "maps.json.gz").write_bytes(gzip.compress(json.dumps(maps).encode()))
    return root
