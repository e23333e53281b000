"""Maps and camera images below and beside the tracks, where their files are there."""

from __future__ import annotations

import base64
import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.argoverse2.source import ArgoverseSource
from data_tools.datasets.kitti.source import KittiSource
from data_tools.datasets.nuscenes import NuScenes
from data_tools.datasets.nuscenes.source import NuScenesSource
from data_tools.datasets.source import clipped
from pipelines.report import Report, report_page
from pipelines.report.scenes import ReportScene, scene_data, thumbnails
from saga_fg import InputError, Scene
from tests.data_tools.kitti_example import write_sequence
from tests.data_tools.nuscenes_example import VERSION, tables, write_tables
from tests.pipelines.page_in_browser import tried_in_browser

PLACE = "boston-seaport"


def image(path: Path, colour: tuple[int, int, int]) -> None:
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (64, 36), colour).save(path)


def expansion() -> dict:
    """A street along x, with a traffic island, a crossing and a divider; another street is far away."""
    corners = {
        "street": [(0, 30), (300, 30), (300, 60), (0, 60)],
        "island": [(100, 44), (110, 44), (110, 46), (100, 46)],
        "far": [(5000, 0), (5010, 0), (5010, 10)],
        "zebra": [(95, 30), (98, 30), (98, 60)],
        "middle": [(80, 45), (120, 45)],
        "elsewhere": [(5000, 45), (5020, 45)],
    }
    nodes = [
        {"token": f"{name}{k}", "x": float(x), "y": float(y)}
        for name, ring in corners.items()
        for k, (x, y) in enumerate(ring)
    ]

    def tokens(name: str) -> list[str]:
        return [f"{name}{k}" for k in range(len(corners[name]))]

    def polygon(name: str, *holes: str) -> dict:
        rings = [{"node_tokens": tokens(hole)} for hole in holes]
        return {"token": name, "exterior_node_tokens": tokens(name), "holes": rings}

    return {
        "node": nodes,
        "line": [{"token": name, "node_tokens": tokens(name)} for name in ("middle", "elsewhere")],
        "polygon": [polygon("street", "island"), polygon("far"), polygon("zebra")],
        "drivable_area": [{"token": "d", "polygon_tokens": ["street", "far"]}],
        "walkway": [],
        "ped_crossing": [{"token": "p", "polygon_token": "zebra"}],
        "road_divider": [],
        "lane_divider": [{"token": "m", "line_token": "middle"}, {"token": "e", "line_token": "elsewhere"}],
    }


@pytest.fixture
def root(tmp_path: Path) -> Path:
    content = tables()
    content["log"] = [{"token": "l", "location": PLACE}]
    for row in content["scene"]:
        row["log_token"] = "l"
    for row in content["sample_data"]:
        if row["calibrated_sensor_token"] == "c-cam":
            row["filename"] = f"samples/CAM_FRONT/{row['sample_token']}.jpg"
        else:
            row["filename"] = "samples/LIDAR_TOP/none.pcd.bin"
    folder = write_tables(tmp_path / "nuscenes", content)
    (folder / "maps" / "expansion").mkdir(parents=True)
    (folder / "maps" / "expansion" / f"{PLACE}.json").write_text(json.dumps(expansion()))
    return folder


def source_of(root: Path) -> NuScenesSource:
    return NuScenesSource(dataroot=str(root), version=VERSION, scenes="scene-0103")


def scene_of(root: Path):
    return {"scene-0103": NuScenes(root, VERSION, {}, ("scene-0103",)).scene("scene-0103")}


def test_a_map_is_cut_to_the_surroundings_of_the_path(root: Path) -> None:
    scenes = scene_of(root)
    known = source_of(root).surroundings(scenes).maps()["scene-0103"]
    assert [(kind, len(rings)) for kind, rings in known.areas] == [("drivable", 2), ("crossing", 1)]
    reach = scenes["scene-0103"].world_T_ego[:, 0, 3].max() + 120
    assert known.areas[0][1][0][:, 0].max() == pytest.approx(reach)
    assert len(known.lines) == 1
    shutil.rmtree(root / "maps")
    assert source_of(root).surroundings(scenes).maps() == {}


def test_broken_maps_are_refused(root: Path) -> None:
    path = root / "maps" / "expansion" / f"{PLACE}.json"
    broken = expansion()
    broken["lane_divider"][0]["line_token"] = "none"
    path.write_text(json.dumps(broken))
    with pytest.raises(InputError, match=r"boston-seaport\.json: lane_divider: expected .*none"):
        source_of(root).surroundings(scene_of(root)).maps()
    del broken["node"][0]["x"]
    path.write_text(json.dumps(broken))
    with pytest.raises(InputError, match=r"node: expected .*x"):
        source_of(root).surroundings(scene_of(root)).maps()
    path.write_text("[]")
    with pytest.raises(InputError, match=r"node: expected a map expansion"):
        source_of(root).surroundings(scene_of(root)).maps()


def points(*places: tuple[float, float]) -> list[dict[str, float]]:
    return [{"x": x, "y": y, "z": 0.0} for x, y in places]


def test_maps_of_argoverse_are_found(tmp_path: Path) -> None:
    scene = Scene("log", np.arange(2.0), np.tile(np.eye(4), (2, 1, 1)), ("", ""), ())
    source = ArgoverseSource(dataroot=str(tmp_path))
    assert source.surroundings({"log": scene}).maps() == {}
    content = {
        "drivable_areas": {"1": {"area_boundary": points((-9, -9), (500, -9), (0, 9))}},
        "pedestrian_crossings": {"2": {"edge1": points((0, 0), (0, 4)), "edge2": points((3, 0), (3, 4))}},
        "lane_segments": {
            "3": {"left_lane_boundary": points((0, 2), (9, 2)), "right_lane_boundary": points((400, 0), (409, 0))}
        },
    }
    path = tmp_path / "log" / "map" / "log_map_archive_log____PAO_city_1.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(content))
    known = source.surroundings({"log": scene}).maps()["log"]
    (_, (area,)), (kind, (crossing,)) = known.areas
    assert area[:, 0].max() == 120
    assert (kind, crossing.tolist()) == ("crossing", [[0, 0], [0, 4], [3, 4], [3, 0]])  # no bow tie
    assert [line.tolist() for line in known.lines] == [[[0, 2], [9, 2]]]
    del content["lane_segments"]["3"]["left_lane_boundary"]
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"city_1\.json: expected a map of Argoverse 2: KeyError"):
        source.surroundings({"log": scene}).maps()


def test_a_ring_is_clipped_to_a_rectangle() -> None:
    low, high = np.zeros(2), np.ones(2)
    diamond = np.array([[0.5, -0.5], [1.5, 0.5], [0.5, 1.5], [-0.5, 0.5]])
    inside = clipped(diamond, low, high)
    assert ((inside >= -1e-12) & (inside <= 1 + 1e-12)).all()
    x, y = inside.T
    assert abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2 == pytest.approx(1.0)
    assert len(clipped(diamond + 9, low, high)) == 0
    square = np.array([[0.2, 0.2], [0.8, 0.2], [0.8, 0.8]])
    np.testing.assert_array_equal(clipped(square, low, high), square)


def test_images_of_nuscenes_are_found_by_moment(root: Path) -> None:
    scenes = scene_of(root)
    assert source_of(root).surroundings(scenes).images() == {}
    image(root / "samples" / "CAM_FRONT" / "a1.jpg", (200, 30, 30))
    images = source_of(root).surroundings(scenes).images()
    assert images == {"scene-0103": {"CAM_FRONT": [None, root / "samples" / "CAM_FRONT" / "a1.jpg", None]}}
    from PIL import Image

    (_, small, _) = thumbnails(images["scene-0103"], 16)["CAM_FRONT"]
    with Image.open(io.BytesIO(base64.b64decode(small))) as opened:
        assert opened.size == (16, 9)
    (root / "samples" / "CAM_FRONT" / "a1.jpg").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"a1\.jpg: expected an image"):
        thumbnails(images["scene-0103"], 16)


def test_images_of_kitti_are_found(tmp_path: Path) -> None:
    root = write_sequence(tmp_path / "kitti")
    source = KittiSource(dataroot=str(root))
    with source.open() as dataset:
        scenes = {"0007": dataset.scene("0007")}
    assert source.surroundings(scenes).images() == {}
    file = root / "training" / "image_02" / "0007" / "000001.png"
    image(file, (0, 0, 0))
    images = source.surroundings(scenes).images()["0007"]["left"]
    assert images[1] == file
    assert images[0] is None


TRY = """
  const view = document.getElementById("view"), time = document.getElementById("time");
  const count = (r, g, b) => {
    const data = view.getContext("2d").getImageData(0, 0, view.width, view.height).data;
    let n = 0;
    for (let i = 0; i < data.length; i += 4) if (data[i] === r && data[i + 1] === g && data[i + 2] === b) n++;
    return n;
  };
  const images = () => [...document.querySelectorAll("#cameras img")].map(each => each.alt);
  found.area = count(236, 239, 242);
  found.images = [images()];
  time.value = 1; time.oninput();
  found.images.push(images());
  document.getElementById("show-map").click();
  found.off = count(236, 239, 242);
"""


def test_the_page_draws_the_map_and_shows_the_images(root: Path, tmp_path: Path) -> None:
    image(root / "samples" / "CAM_FRONT" / "a1.jpg", (200, 30, 30))
    scenes, source = scene_of(root), source_of(root)
    from data_tools.metrics import SceneBoxes
    from saga_fg import Boxes

    none = SceneBoxes(np.empty(0, dtype=np.int64), np.empty(0, dtype="<U1"), Boxes.of([], []), np.empty(0))
    shown = ReportScene(
        scenes["scene-0103"],
        {"saga": none},
        {},
        map=source.surroundings(scenes).maps()["scene-0103"],
        cameras=thumbnails(source.surroundings(scenes).images()["scene-0103"], 32),
    )
    assert [kind for kind, *_ in scene_data(shown)["map"]["areas"]] == ["drivable", "crossing"]
    found = tried_in_browser(report_page(Report("map", [], [shown])), TRY, tmp_path)
    assert found["faults"] == []
    assert found["area"] > 10_000
    assert found["images"] == [[], ["CAM_FRONT"]]
    assert found["off"] == 0
