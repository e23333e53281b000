"""HOTA on KITTI judges what the benchmark judges: cases by hand, and trackeval's own reading of the same files."""

from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.kitti.labels import read_kitti_labels
from data_tools.metrics import KittiTrackingSequence, kitti_hota_metrics

trackeval = pytest.importorskip("trackeval")

CAR, ELSEWHERE = (100.0, 100.0, 180.0, 150.0), (400.0, 100.0, 480.0, 150.0)
TYPES = ("Car", "Car", "Van", "Pedestrian", "Person")


def line(
    frame: int, id_: int, type_: str, bbox: tuple[float, ...], seen: tuple[int, int] = (0, 0), x: float = 0.0
) -> str:
    corners = " ".join(f"{value:.2f}" for value in bbox)
    return f"{frame} {id_} {type_} {seen[0]} {seen[1]} 0 {corners} 1.5 1.8 4.2 {x:.2f} 1.6 20 0"


def sequence(folder: Path, truth: list[str], found: list[str]) -> KittiTrackingSequence:
    objects = []
    for name, lines in (("truth", truth), ("found", [f"{each} 0.9" for each in found])):
        (folder / name).write_text("\n".join(lines) + "\n")
        objects.append(read_kitti_labels(folder / name))
    return KittiTrackingSequence(*objects)


def test_in_space_the_same_objects_are_evaluated(tmp_path):
    truth = [line(0, 1, "Car", CAR), line(0, 2, "Van", ELSEWHERE, x=10.0)]
    found = [line(0, 7, "Car", CAR, x=1.0), line(0, 9, "Car", ELSEWHERE, x=14.0)]
    both = sequence(tmp_path, truth, found)
    for similarity in ("bev_iou", "iou_3d"):
        result = kitti_hota_metrics([both], "car", similarity)
        assert result.fp + result.fn == 0
        assert result.motp == pytest.approx(3.2 / 5.2)


def traffic(seed: int) -> tuple[list[str], list[str]]:
    """Boxes that drift through the image, with all that is not judged, and what a poor tracker makes of them."""
    rng = np.random.default_rng(seed)
    truth, found = [], []
    places, speeds = rng.uniform((0, 100), (1100, 250), (12, 2)), rng.normal(0, 6, (12, 2))
    sizes, types = rng.uniform((20, 15), (120, 70), (12, 2)), rng.choice(TYPES, 12)
    for k in range(25):
        for n in range(12):
            corner = places[n] + k * speeds[n]
            box = (*corner, *(corner + sizes[n]))
            if rng.random() < 0.9:
                truth.append(line(k, n, types[n], box, (int(rng.random() < 0.1), int(rng.integers(0, 4)))))
            if rng.random() < 0.8:
                moved = np.array(box) + rng.normal(0, 4, 4)
                type_ = "Car" if types[n] in ("Car", "Van") else "Pedestrian"
                found.append(line(k, 100 + n + 20 * (rng.random() < 0.05), type_, tuple(moved)))
        area = rng.uniform((0, 80), (900, 150))
        truth.append(line(k, -1, "DontCare", (*area, area[0] + 250, area[1] + 100)))
        clutter = rng.uniform((0, 80), (1100, 250))
        found.append(line(k, 500 + k, "Car", (*clutter, *(clutter + rng.uniform(15, 90, 2)))))
    return truth, found


def test_figures_are_those_of_trackeval_itself(tmp_path):
    sequences, true_folder, found_folder = [], tmp_path / "gt" / "label_02", tmp_path / "trackers" / "t" / "data"
    for folder in (true_folder, found_folder):
        folder.mkdir(parents=True)
    (tmp_path / "gt" / "evaluate_tracking.seqmap.training").write_text("0000 empty 0 25\n0001 empty 0 25\n")
    for seed in range(2):
        truth, found = traffic(seed)
        sequences.append(sequence(tmp_path, truth, found))
        (tmp_path / "truth").rename(true_folder / f"{seed:04d}.txt")
        (tmp_path / "found").rename(found_folder / f"{seed:04d}.txt")
    config = {
        "GT_FOLDER": str(tmp_path / "gt"),
        "TRACKERS_FOLDER": str(tmp_path / "trackers"),
        "OUTPUT_FOLDER": str(tmp_path),
        "TRACKERS_TO_EVAL": ["t"],
        "SPLIT_TO_EVAL": "training",
        "CLASSES_TO_EVAL": ["car", "pedestrian"],
        "PRINT_CONFIG": False,
    }
    dataset, metric = trackeval.datasets.Kitti2DBox(config), trackeval.metrics.HOTA()
    for label in ("car", "pedestrian"):
        each = {}
        for name in ("0000", "0001"):
            data = dataset.get_preprocessed_seq_data(dataset.get_raw_seq_data("t", name), label)
            each[name] = metric.eval_sequence(data)
        expected, mine = metric.combine_sequences(each), kitti_hota_metrics(sequences, label)
        assert 0.1 < mine.hota < 0.95
        np.testing.assert_allclose(mine.hota_at, expected["HOTA"], rtol=1e-12)
        for name, value in (("DetA", mine.deta), ("AssA", mine.assa), ("LocA", mine.loca)):
            assert value == pytest.approx(np.mean(expected[name]), rel=1e-12)
