"""A new dataset in one file, the example of the documentation: installed as a package, it has all verbs."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from data_tools.datasets import source
from data_tools.datasets.source import ChosenScenes, DatasetSource
from saga_fg.errors import InputError
from saga_fg.parts import offered
from tests.pipelines.command import done, refused, saga_fg

PAGE = Path(__file__).parents[2] / "docs" / "guides" / "parts.md"


def install(folder: Path, package: str, **datasets: str) -> None:
    """Metadata of an installed package that offers datasets."""
    metadata = folder / f"{package}-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    entries = "".join(f"{name} = {location}\n" for name, location in datasets.items())
    (metadata / "entry_points.txt").write_text(f"[{source.GROUP}]\n{entries}")


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder that Python imports from, in which packages can be installed."""
    folder = tmp_path / "packages"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    offered.cache_clear()
    yield folder
    offered.cache_clear()


@pytest.fixture
def square(packages: Path, tmp_path: Path) -> Iterator[Path]:
    """The dataset of the documentation, installed; recordings of it, made as there."""
    text = PAGE.read_text(encoding="utf-8")
    (source,) = re.findall(r"^cat > square.py <<'END'\n(.*?)^END$", text, flags=re.M | re.S)
    own = [line for line in source.splitlines() if line.strip() and not re.match('from |import |"""', line)]
    assert len(own) <= 15
    (packages / "square.py").write_text(source)
    install(packages, "city-square", square="square:Square")
    (recordings,) = re.findall(r"^```python\n(import json\n.*?)^```$", text, flags=re.M | re.S)
    run = subprocess.run([sys.executable, "-c", recordings], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    yield tmp_path / "recordings"
    sys.modules.pop("square", None)


def test_it_is_listed_has_its_options_and_can_be_viewed(square, tmp_path):
    assert re.search(r"^  square +Pedestrians on a square, seen from above\.$", saga_fg("track", "-h").stdout, re.M)
    text = saga_fg("track", "square", "--help").stdout
    assert "  --folder <str>" in text
    assert "    saga-fg track square --folder FOLDER --output tracks.csv\n" in text
    pytest.importorskip("mcap", reason="files for Foxglove come with the extra mcap")
    assert saga_fg("track", "square", "--folder", square, "-o", tmp_path / "tracks.csv").exit_code == 0
    done("view", "square", tmp_path / "tracks.csv", "--folder", square, "--save", tmp_path / "a.mcap")
    assert (tmp_path / "a.mcap").stat().st_size > 1000


def test_it_has_all_verbs(square, tmp_path):
    options, tracks, labels = ("--folder", square), tmp_path / "tracks.csv", tmp_path / "labels"
    for arguments in (
        ("track", "square", *options, "-o", tracks, "--explain"),
        ("evaluate", "square", tracks, *options, "--json", tmp_path / "figures.json"),
        ("evaluate", "square", *options, "--method", "kf"),
        ("report", "square", tracks, *options, "-o", tmp_path / "report.html"),
        ("smooth", "square", *options, "-o", labels),
        ("evaluate", "labels", "square", labels, *options),
        ("learn", "noise", "square", *options, "-o", tmp_path / "noise.yaml"),
        ("track", "square", *options, "-o", tmp_path / "again.csv", "--config", tmp_path / "noise.yaml"),
    ):
        done(*arguments)
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["scenes"] == ["day0", "day1"]
    assert figures["tracking"]["overall"]["mota"] > 0.95
    done("learn", "interactions", "square", *options, "-o", tmp_path / "interactions.yaml", "--passes", "1")


def rows(output: Path) -> str:
    """The tables of all parts as one."""
    tables = [path.read_text().splitlines(True) for path in sorted(output.iterdir())]
    return "".join([tables[0][0], *(row for table in tables for row in table[1:])])


def test_it_runs_in_parallel_and_again_only_what_has_changed(square, tmp_path):
    for verb, serial, parts in (("track", "tracks.csv", "tracks"), ("smooth", "labels/labels.csv", "labels")):
        run = (verb, "square", "--folder", square, "-o")
        assert saga_fg(*run, tmp_path / Path(serial).parts[0]).exit_code == 0
        done(*run, tmp_path / f"{verb}-run", "--workers", "1")
        assert rows(tmp_path / f"{verb}-run" / parts) == (tmp_path / serial).read_text()
    again = saga_fg("track", "square", "--folder", square, "-o", tmp_path / "track-run", "--workers", "1")
    assert "2 scenes: 0 done, 2 unchanged, 0 failed" in again.stdout


def test_one_without_recordings_says_what_it_lacks(packages):
    (packages / "bare.py").write_text(
        "from data_tools.datasets.source import DatasetSource as D\n\n\nclass Bare(D):\n    name = 'bare'\n"
    )
    said = refused("track", "bare:Bare", "-o", "x.csv")
    assert "dataset: Bare: expected scenes and scene(name), or open" in said


def test_by_module_and_class_it_need_not_be_installed(square, tmp_path):
    done("track", "square:Square", "--folder", square, "-o", tmp_path / "tracks.csv")
    for name, message in (
        ("square:Round", "the module square has no Round"),
        ("none_such:A", "No module named 'none_such'"),
    ):
        assert message in refused("track", name, "--folder", square)


def test_a_broken_package_is_named_and_hinders_no_other(packages, square, tmp_path):
    install(packages, "bad-cameras", cameras="no_such_module:Cameras", odd="json:JSONDecoder")
    listed = saga_fg("track", "--help").stdout
    assert re.search(r"^  cameras +Cannot be loaded: dataset: cameras of the package", listed, re.M)
    expected = {"cameras": "no_such_module cannot be imported: ModuleNotFoundError", "odd": "DatasetSource"}
    for name, message in expected.items():
        said = refused("track", name, "--folder", "x", "-o", "y")
        assert said.startswith(f"error: dataset: {name}")
        assert message in said
    assert saga_fg("track", "square", "--folder", square, "-o", tmp_path / "tracks.csv").exit_code == 0


def test_a_name_belongs_to_one_package(packages):
    install(packages, "one", lidar="a:A", kitti="a:A")
    install(packages, "two", lidar="b:B")
    with pytest.raises(InputError, match="dataset: lidar: expected one package to offer it, one and two do"):
        source.dataset_source("lidar")
    with pytest.raises(InputError, match="dataset: kitti: expected one package to offer it, one and saga-fg do"):
        source.dataset_source("kitti")
    with pytest.raises(InputError, match="unknown dataset 'kity'; did you mean 'kitti'"):
        source.dataset_source("kity")


def test_help_lists_what_can_be_evaluated_and_those_that_come_along_are_sources():
    listed = re.findall(r"^  (\w+) ", saga_fg("evaluate", "--help").stdout, re.M)
    assert {"nuscenes", "file", "mcap", "simulated", "labels"} <= set(listed)
    for name in source.BUILT_IN:
        found = source.dataset_source(name)
        assert issubclass(found, DatasetSource)
        assert found.name == name


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("evaluate", "file", "tracks.csv"), "error: evaluate file: expected ground truth, there is none"),
        (("track", "nothing"), "error: unknown dataset 'nothing'"),
        (("track", "own.csv"), "error: own.csv: expected a dataset before the file: saga-fg track file own.csv ..."),
        (("view", "a bag"), "error: a bag: expected a dataset before the file: saga-fg view mcap 'a bag' ..."),
        (("smooth", "folder"), "error: folder: expected the name of a dataset before a folder: saga-fg smooth --help"),
        (("evaluate", "simulated", "tracks.csv", "--method", "kf"), "error: --method kf: goes without a result"),
    ],
)
def test_what_cannot_be_done_is_one_line(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("own.csv").write_text("timestamp,x,y\n")
    for folder in ("a bag", "folder"):
        Path(folder).mkdir()
    Path("a bag/metadata.yaml").touch()
    said = refused(*arguments)
    assert said.startswith(message)
    assert len(said.splitlines()) == 1


def test_chosen_scenes_have_all_objects_where_the_dataset_has_them():
    seen = SimpleNamespace(scenes=("a", "b"), scene=lambda name: f"{name}, seen")
    known = SimpleNamespace(**vars(seen), true_scene=lambda name: f"{name}, all")
    assert [ChosenScenes(each, "b").true_scene("b") for each in (seen, known)] == ["b, seen", "b, all"]
