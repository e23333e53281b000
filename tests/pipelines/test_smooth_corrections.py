"""`saga-fg smooth --corrections`, with tracks of others and in parallel, and `saga_fg.smooth`."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import saga_fg
from data_tools.datasets.detection_files import read_tracks
from saga_fg import InputError
from tests.pipelines.command import done, refused

HEADER = "scene,timestamp,label,x,y,length,width,height,yaw,score"
SAME_BOX = ",4.5,1.8,1.5,0,0.9"


def rows(scene: str) -> list[str]:
    """A car that drives, and one that is parked."""
    rng = np.random.default_rng(2)
    places = ((0.25 * k, x, y) for k in range(24) for x, y in ((2.0 * k, 0.0), (20.0, 8.0)))
    return [
        f"{scene},{t},car,{x + rng.normal(0, 0.1):.3f},{y + rng.normal(0, 0.1):.3f}{SAME_BOX}" for t, x, y in places
    ]


CORRECTIONS: list[dict[str, Any]] = [
    {"what": "exists", "at": {"time": 1.0, "x": 20.0, "y": 8.0}, "value": False, "scene": "a", "who": "anna"},
    {"what": "box", "at": {"time": 3.0, "x": 24.0, "y": 0.0}, "box": {"x": 24.5, "y": 0.0, "yaw": 0.0}, "scene": "b"},
    {"what": "class", "at": {"time": 3.0, "x": 500.0, "y": 0.0}, "label": "bus", "scene": "b"},
    {"what": "class", "at": {"time": 3.0, "x": 24.0, "y": 0.0}, "label": "bus", "scene": "c"},
]


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    table, corrections = tmp_path / "two.csv", tmp_path / "mine.jsonl"
    table.write_text("\n".join([HEADER, *rows("a"), *rows("b")]) + "\n")
    corrections.write_text("".join(json.dumps(one) + "\n" for one in CORRECTIONS))
    return table, corrections


def test_the_command_applies_corrections_and_names_those_that_do_not_fit(files, tmp_path):
    table, corrections = files
    run = done("smooth", "file", table, "--corrections", corrections, "-o", tmp_path / "out")
    unfit = [line for line in run.stderr.splitlines() if line.startswith("not applied: ")]
    assert len(unfit) == 2
    assert f"{corrections}: line 3: class, object at 3 s, x 500.0, y 0.0: no object within 2 m" in unfit[0]
    assert "line 4" in unfit[1]
    assert "no scene c among the recordings" in unfit[1]
    assert "by its successive detections" in run.stdout
    assert "saga-fg learn noise" in run.stdout
    labels = read_tracks(tmp_path / "out" / "labels.csv", labels=True)
    assert (labels.scene == "a").sum() < (labels.scene == "b").sum()  # the parked car is gone from a
    assert set(labels.source[labels.scene == "b"].tolist()) >= {"corrected", "near", "observed"}
    with (tmp_path / "out" / "corrections.csv").open() as file:
        found = {(row["scene"], row["what"], row["who"]): row["problem"] for row in csv.DictReader(file)}
    assert found == {
        ("a", "exists", "anna"): "",
        ("b", "box", ""): "",
        ("b", "class", ""): "no object within 2 m",
    }
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["total"]["corrected"] == 1
    assert summary["scenes"]["a"]["objects"] == 1


def test_in_parallel_and_with_tracks_of_others_it_is_the_same(files, tmp_path):
    table, corrections = files
    done("track", "file", table, "-o", tmp_path / "theirs.csv")
    for name, source in (("detections", (table,)), ("tracks", ("--tracks", tmp_path / "theirs.csv"))):
        arguments = ["smooth", "file", *source, "--corrections", corrections]
        one = done(*arguments, "-o", tmp_path / name)
        many = done(*arguments, "--workers", "1", "-o", tmp_path / f"{name}-parallel")
        problems = [[line for line in run.stderr.splitlines() if "not applied" in line] for run in (one, many)]
        assert problems[0] == problems[1]
        assert len(problems[0]) == 2
        whole = read_tracks(tmp_path / name / "labels.csv", labels=True)
        parts = [read_tracks(path, labels=True) for path in sorted((tmp_path / f"{name}-parallel/labels").iterdir())]
        for part in parts:
            mine = whole.select(np.isin(whole.scene, part.scene))
            np.testing.assert_allclose(part.boxes.position, mine.boxes.position, atol=1e-6)
            assert part.source.tolist() == mine.source.tolist()


def test_a_broken_file_of_corrections_is_one_line_and_nothing_is_written(files, tmp_path):
    table, corrections = files
    whole = corrections.read_text()
    for content, expected in (
        (whole[:-20], "line 4: broken or truncated JSON"),
        (whole + '{"what": "exists"}\n', "line 5: at: expected time, x, y"),
    ):
        corrections.write_text(content)
        assert expected in refused("smooth", "file", table, "--corrections", corrections, "-o", tmp_path / "out")
        assert not (tmp_path / "out").exists()
    corrections.write_text("\ufeff\n")  # as a review leaves it whose corrections were all taken back
    assert (
        f"{corrections}: no corrections"
        in done("smooth", "file", table, "--corrections", corrections, "-o", tmp_path / "out").stderr
    )


def test_tables_in_python():
    pandas = pytest.importorskip("pandas")
    found = [line.split(",") for line in rows("a")]
    table = pandas.DataFrame(found, columns=HEADER.split(",")).drop(columns="scene")
    numbers = [name for name in table.columns if name != "label"]
    table[numbers] = table[numbers].astype(float)
    labels = saga_fg.smooth(table)
    assert len(labels.boxes()) == 48
    review = labels.review()
    assert list(review.columns)[:2] == ["gain", "why"]
    assert len(review) == 2
    gone = {name: value for name, value in CORRECTIONS[0].items() if name != "scene"}
    assert len(saga_fg.smooth(table, corrections=[gone]).boxes()) == 24
    both = pandas.concat([table.assign(scene=name) for name in "ab"])
    assert saga_fg.smooth(both, corrections=[CORRECTIONS[0]]).boxes().scene.value_counts().to_dict() == {
        "b": 48,
        "a": 24,
    }
    far = {"what": "exists", "at": {"time": 1.0, "x": 900.0, "y": 8.0}, "value": True}
    with pytest.warns(UserWarning, match=r"corrections: 1: exists, .*: no object within 2 m"):
        saga_fg.smooth(table, corrections=[far])
    with pytest.raises(InputError, match="corrections: 1: what: expected one of"):
        saga_fg.smooth(table, corrections=[{"what": "x"}])
    assert len(saga_fg.smooth(table.iloc[:0]).boxes()) == 0
