"""The player of a report's page, and the surroundings it draws."""

import base64
import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_tools.datasets.argoverse2.source import ArgoverseSource
from data_tools.datasets.detection_files import PredictionRows
from data_tools.datasets.kitti.source import KittiSource
from data_tools.datasets.nuscenes import NuScenes
from data_tools.datasets.nuscenes.source import NuScenesSource
from data_tools.datasets.source import clipped
from data_tools.figures import Chart, Series, class_colours
from data_tools.metrics import SceneBoxes, best_thresholds, scene_metrics, score_sweep
from pipelines.report import Report, ReportScene, report_page
from pipelines.report.scenes import (
    ADDED,
    PLAIN,
    SWITCH,
    UNMATCHED,
    comparisons,
    scene_data,
    start_thresholds,
    thumbnails,
)
from saga_fg import Boxes, InputError, Scene
from saga_fg.model.edge_rules import Following, Pairs
from saga_fg.model.interactions import SharedVelocity
from saga_fg.numerics.geometry import yaw_transform
from saga_fg.types.dataset import Annotations
from tests.data_tools.kitti_example import write_sequence
from tests.data_tools.nuscenes_example import VERSION, tables, write_tables
from tests.pipelines.page_in_browser import tried_in_browser

MOMENTS = 10
KINDS = {  # class, y, score, moments, unseen for, s
    "car-1": ("car", 0.0, 0.9, range(10), 0.0),
    "car-2": ("car", 6.0, 0.8, range(10), 0.0),
    "walker-3": ("pedestrian", -6.0, 0.7, range(10), 0.0),
    "weak-4": ("car", 12.0, 0.2, range(10), 0.0),
    "brief-5": ("car", 18.0, 0.9, range(2), 0.0),
    "ghost-6": ("car", -12.0, 0.9, range(10), 0.0),
}


def scene(name: str, truth: bool = False) -> ReportScene:
    """Six kinds of tracks that drive beside the vehicle; a second tracker has the first two alone."""
    times = np.arange(MOMENTS) * 0.5
    poses = np.array([yaw_transform(5 * t, 0.0) for t in times])
    rows = [(k, id_, *kind) for k in range(MOMENTS) for id_, kind in KINDS.items() if k in kind[3]]

    def table(chosen):
        boxes = Boxes.of(
            [row[2] for row in chosen],
            [[2.5 * row[0] + 10, row[3], 0.0] for row in chosen],
            [[4.0, 2.0, 1.5]] * len(chosen),
            [0.0] * len(chosen),
        )
        ids = np.array([row[1] for row in chosen])
        return SceneBoxes(np.array([row[0] for row in chosen]), ids, boxes, np.array([row[4] for row in chosen]))

    unseen = np.array([0.5 if row[1] == "ghost-6" and row[0] >= 4 else 0.0 for row in rows])
    whole, few = table(rows), table([row for row in rows if row[1] in ("car-1", "car-2")])
    objects = []
    for k in range(MOMENTS):
        boxes = Boxes.of(["car", "car"], [[2.5 * k + 10, y, 0.0] for y in (0.0, 6.0)], [[4, 2, 1.5]] * 2, [0.0] * 2)
        objects.append(Annotations(np.array(["a", "b"]), boxes, np.ones(2, dtype=bool)))
    recorded = Scene(name, times, poses, ("",) * MOMENTS, (), objects if truth else None)
    return ReportScene(recorded, {"few": few, "whole": whole}, {"whole": unseen})


def page() -> str:
    return report_page(Report("player", [], [scene("first"), scene("second")]))


def crowded(names: list[str], first: int = 0) -> ReportScene:
    """A car for each name, all in view from a moment on; the first of them twice as long."""
    rows = [(k, n) for k in range(MOMENTS) for n in range(len(names)) if k >= (first if n else max(first - 2, 0))]
    boxes = Boxes.of([names[n] for _, n in rows], [[2.0 * k, 4.0 * n, 0] for k, n in rows], yaw=[0.0] * len(rows))
    ids = np.array([f"{n}" for _, n in rows])
    table = SceneBoxes(np.array([k for k, _ in rows]), ids, boxes, np.full(len(rows), 0.9))
    recorded = Scene("s", np.arange(MOMENTS) * 0.1, np.tile(np.eye(4), (MOMENTS, 1, 1)), ("",) * MOMENTS, ())
    return ReportScene(recorded, {"saga": table}, {})


HELPERS = """
  const $of = id => document.getElementById(id);
  const counts = () => $of("view").dataset.tracks;
  const key = (name, more) => document.dispatchEvent(new KeyboardEvent("keydown", {key: name, bubbles: true, ...more}));
  const followed = () => ($of("panel").querySelector("h2") || {}).textContent || "";
  const at = k => { $of("time").value = k; $of("time").oninput(); };
  const pixel = (ahead, aside, width) => {  // of a place seen from the vehicle
    const {zoom, aim} = $of("view").dataset, [a, b] = aim.split(",").map(Number);
    return [width / 2 + (ahead - a) * zoom, $of("view").clientHeight / 2 - (aside - b) * zoom];
  };
  const chip = name => [...$of("classes").children].find(each => each.textContent === name);
"""


def tried(script: str, folder: Path, hash_: str = ""):
    found = tried_in_browser(page(), HELPERS + script, folder, hash_)
    assert found["faults"] == []
    return found


def test_weak_brief_and_unseen_tracks_are_hidden_until_asked_for_and_classes_switched_off_or_shown_alone(tmp_path):
    found = tried(
        """
  at(5); found.first = counts();
  $of("show-ghosts").click(); found.ghosts = counts(); $of("show-ghosts").click();
  at(1); found.early = counts();
  $of("show-confirmed").click(); found.brief = counts(); $of("show-confirmed").click();
  const score = $of("score-0");
  found.score = score.value;
  score.value = 0; score.oninput(); found.weak = counts();
  score.value = .75; score.oninput(); found.strong = counts();
  score.value = .3; score.oninput(); at(5);
  found.chips = [...$of("classes").children].map(each => each.textContent);
  found.colours = [...$of("classes").children].map(each => getComputedStyle(each).backgroundColor);
  chip("car").click(); found.walkers = counts(); found.pressed = chip("car").getAttribute("aria-pressed");
  chip("car").click(); found.all = counts();
  chip("pedestrian").ondblclick(); found.alone = counts();
  chip("pedestrian").ondblclick(); found.again = counts();
""",
        tmp_path,
    )
    assert found["score"] == "0.3"
    assert found["first"] == "3"  # car-1, car-2, walker-3
    assert found["ghosts"] == "4"
    assert found["early"] == "4"  # ghost-6 is seen yet
    assert found["brief"] == "5"
    assert found["weak"] == "5"
    assert found["strong"] == "3"  # car-1, car-2, ghost-6
    assert found["chips"] == ["car", "pedestrian"]
    assert len(set(found["colours"])) == 2
    assert (found["walkers"], found["pressed"], found["all"]) == ("1", "false", "3")
    assert (found["alone"], found["again"]) == ("1", "3")


def test_the_page_starts_at_the_fullest_moment_with_its_tracks_drawn(tmp_path):
    page = report_page(Report("own data", [], [crowded(["car"] * 3, first=4)]))
    script = """
  found.counts = counts(); found.clock = $of("clock").value;
  const g = $of("view").getContext("2d"), data = g.getImageData(0, 0, g.canvas.width, g.canvas.height).data;
  found.drawn = data.filter((value, at) => at % 4 === 3 && value > 0).length;
"""
    found = tried_in_browser(page, HELPERS + script, tmp_path)
    assert found["faults"] == []
    assert (found["counts"], found["clock"]) == ("3", "0.4 s")
    assert found["drawn"] > 500


def test_a_class_has_one_colour_in_player_charts_and_figures(tmp_path):
    line = [0.0, 1.0]
    chart = Chart("c", "x", "y", [Series(name, line, line) for name in ("bollard", "pedestrian", "all")])
    page = report_page(Report("colours", [], [crowded(["pedestrian", "bollard"])], charts=[chart]))
    script = """
  for (const each of $of("classes").children) found[each.textContent] = [each.style.getPropertyValue("--colour")];
  for (const each of $of("charts").querySelectorAll("text[style]"))
    (found[each.textContent] ??= []).push(each.style.fill);
"""
    found = tried_in_browser(page, HELPERS + script, tmp_path)
    assert found["faults"] == []
    colours = class_colours(["bollard", "dog", "pedestrian"])  # two have none of their own
    assert len(set(colours.values())) == 3
    for name, colour in class_colours(["bollard", "pedestrian"]).items():
        assert found[name] == [colour, f"rgb({', '.join(map(str, bytes.fromhex(colour[1:])))})"]
    assert found["all"][0] not in (found["bollard"][1], found["pedestrian"][1])


def test_a_hidden_track_shows_where_each_of_its_modes_leads(tmp_path):
    """Of two cars the page has means, and of the hidden one two modes; the likelier one is drawn stronger."""
    known = scene("first")
    columns = [(k, id_, "", 1.0) for k in range(MOMENTS) for id_ in ("1", "6")]
    columns += [(k, "6", *mode) for k in range(4, MOMENTS) for mode in (("waits", 0.7), ("goes on", 0.3))]
    moment, ids, modes, share = (np.array(each) for each in zip(*columns, strict=True))
    ahead = np.array([{"waits": 20.0}.get(mode, 40.0) for mode in modes.tolist()])
    place = np.column_stack([2.5 * moment + ahead, [{"1": 0.0}.get(id_, -12.0) for id_ in ids.tolist()]])
    spread = np.tile(np.eye(2), (len(ids), 1, 1))
    found = PredictionRows(0.5 * moment, np.full(len(ids), 2.0), ids, place, spread, modes, share)
    page = report_page(Report("modes", [], [replace(known, predictions={"whole": found})]))
    script = """
  const view = $of("view"), g = view.getContext("2d");
  const placed = (x, y) => pixel(x - 2.5 * Number($of("time").value), y, view.clientWidth);
  const strength = (x, y) => {
    const data = g.getImageData(...placed(x, y).map(v => Math.round(v) - 3), 7, 7).data;
    return data.filter((v, i) => i % 4 === 3).reduce((sum, v) => sum + v, 0);
  };
  const over = (x, y) => {
    const [a, b] = placed(x, y), {left, top} = view.getBoundingClientRect();
    view.dispatchEvent(new PointerEvent("pointermove", {clientX: left + a, clientY: top + b}));
    return view.title;
  };
  $of("method").value = "whole"; $of("method").onchange?.(); $of("show-grid").click(); $of("show-ids").click();
  at(6); $of("show-fans").checked || $of("show-fans").click();
  found.hidden = over(35, -12);
  $of("show-ghosts").click();
  found.shown = [over(35, -12), over(55, -12), over(55, 0)];
  found.strength = [strength(35.7, -12), strength(55.7, -12)];
"""
    found = tried_in_browser(page, HELPERS + script, tmp_path)
    assert found["faults"] == []
    panel = 'found.panel = $of("panel").textContent;'
    followed = tried_in_browser(page, HELPERS + panel, tmp_path, "#t=3.0&id=ghost-6&method=whole")
    assert "goes on30 %, in 2 swaits70 %, in 2 s" in followed["panel"]
    assert found["hidden"] == ""
    assert found["shown"] == ["track 6 waits: 70 %, in 2 s", "track 6 goes on: 30 %, in 2 s", ""]
    assert found["strength"][0] > 1.3 * found["strength"][1] > 0


def test_a_link_leads_to_a_moment_and_a_track(tmp_path):
    script = "Object.assign(found, {scene: $of('scene').value, clock: $of('clock').value, followed: followed()});"
    script += " key('ArrowRight'); found.hash = location.hash; found.beside = counts().split(' ').length;"
    found = tried(script, tmp_path, "#scene=second&t=2.4&id=weak-4&method=whole&beside=few")
    assert (found["scene"], found["clock"], found["followed"]) == ("second", "2.5 s", "track weak-4")
    assert found["hash"] == "#scene=second&t=3.000&method=whole&beside=few&id=weak-4"
    assert found["beside"] == 2
    short = tried(script, tmp_path, "#id=5")  # the end of its id is enough, at its first moment
    assert (short["clock"], short["followed"]) == ("0.0 s", "track brief-5")


def test_two_results_side_by_side(tmp_path):
    found = tried(
        """
  at(5);
  found.alone = counts();
  $of("beside").value = "few"; $of("beside").onchange();
  found.two = counts(); found.sliders = $of("scores").querySelectorAll("input").length;
  const view = $of("view"); view.setPointerCapture = () => {};
  const click = (type, x, y) => {
    const box = view.getBoundingClientRect();
    view.dispatchEvent(new PointerEvent(type, {clientX: box.x + x, clientY: box.y + y, pointerId: 1, bubbles: true}));
  };
  const width = view.clientWidth / 2;
  for (const left of [0, width]) {
    const [x, y] = pixel(10, 0, width);  // a car is 10 m before the vehicle
    click("pointerdown", left + x, y);
    click("pointerup", left + x, y);
    (found.picked ??= []).push([followed(), new URLSearchParams(location.hash.slice(1)).get("id")]);
    key("0");
  }
""",
        tmp_path,
    )
    assert found["alone"] == "3"
    assert found["two"] == "2 3"
    assert found["sliders"] == 2
    assert found["picked"] == [["track car-1", "car-1"]] * 2


def test_the_view_fits_what_is_shown_and_the_scale_bar_is_as_long_as_it_says(tmp_path):
    found = tried(
        """
  const view = $of("view"), g = view.getContext("2d"), low = view.clientHeight - 14;
  const dark = x => g.getImageData(x, low, 1, 1).data[3] > 128;
  const end = Math.floor(14 + view.dataset.step * view.dataset.zoom);
  found.bar = [dark(15), dark(end - 2), dark(end + 4)];
  const inside = places => places.every(([ahead, aside]) => {
    const [x, y] = pixel(ahead, aside, view.clientWidth);
    return x > 0 && y > 0 && x < view.clientWidth && y < view.clientHeight;
  });
  at(5);
  found.cars = inside([[8, 0], [12, 6], [12, -6]]);
  found.all = +view.dataset.zoom;
  chip("pedestrian").ondblclick();
  found.walker = pixel(10, -6, view.clientWidth).map((v, axis) => v / [view.clientWidth, view.clientHeight][axis]);
  found.alone = +view.dataset.zoom;
  chip("pedestrian").ondblclick(); found.again = inside([[8, 0], [12, 6], [12, -6]]);
  key("+"); found.closer = +view.dataset.zoom; key("0"); found.home = +view.dataset.zoom;
  const step = +view.dataset.step, part = view.clientWidth / view.dataset.zoom / step;
  found.scale = [step, part];
""",
        tmp_path,
    )
    assert found["cars"]
    assert found["again"]
    assert found["alone"] >= found["all"]
    assert found["walker"] == pytest.approx([0.5, 0.5], abs=0.01)
    assert found["closer"] > found["home"] == pytest.approx(found["all"])
    step, squares = found["scale"]
    assert step / 10 ** np.floor(np.log10(step)) in (1, 2, 5)
    assert 2 <= squares <= 7
    assert found["bar"] == [True, True, False]


def judged() -> ReportScene:
    """Two cars; one track changes its name, one begins late, one is of nothing; a second result misses a car."""

    def table(rows):
        rows = sorted(rows)
        boxes = Boxes.of(["car"] * len(rows), [[2.5 * k, y, 0.0] for k, _, y in rows], [[4.0, 2.0, 1.5]] * len(rows))
        return SceneBoxes(
            np.array([row[0] for row in rows]), np.array([row[1] for row in rows]), boxes, np.full(len(rows), 0.9)
        )

    moments = range(MOMENTS)
    whole = [(k, "1" if k < 6 else "2", 0.0) for k in moments] + [(k, "3", 6.0) for k in moments if k >= 4]
    nothing = [(k, "4", 30.0) for k in (2, 3, 4, 7)]
    truth = table([(k, name, y) for k in moments for name, y in (("a", 0.0), ("b", 6.0))]).annotations(MOMENTS)
    poses = np.array([yaw_transform(2.5 * k, 0.0) for k in moments])
    recorded = Scene("s", np.arange(MOMENTS) * 0.5, poses, ("",) * MOMENTS, (), truth)
    few = [(k, "9", 0.0) for k in moments]
    return ReportScene(recorded, {"few": table(few), "whole": table(whole + nothing)}, {})


def test_faults_are_those_of_the_evaluation_each_for_as_long_as_it_lasts():
    report = judged()
    found = {
        (each["reference"], each["found"]): each["events"] for each in comparisons(report, {"few": 0.0, "whole": 0.0})
    }
    for name, table in report.tracks.items():
        metrics = scene_metrics(report.scene.ground_truth, table.by_frame(MOMENTS))
        events = found[None, name]
        lasted = {kind: sum(e[2] - e[1] + 1 for e in events if e[0] == kind) for kind in (SWITCH, UNMATCHED, ADDED)}
        expected = {SWITCH: metrics.switches, UNMATCHED: metrics.misses, ADDED: metrics.false_positives}
        assert lasted == expected
    whole = found[None, "whole"]
    assert [event for event in whole if event[0] == SWITCH] == [[SWITCH, 6, 6, 1500, 0, "a", "2", "1"]]
    assert [event for event in whole if event[0] == UNMATCHED] == [[UNMATCHED, 0, 3, 0, 600, "b", None, None]]
    assert [event[1:3] for event in whole if event[0] == ADDED] == [[2, 4], [7, 7]]
    between = found["few", "whole"]
    assert [event[5:] for event in between if event[0] == SWITCH] == [["9", "2", "1"]]
    assert sorted(event[6] for event in between if event[0] == ADDED) == ["3", "4", "4"]
    assert ("whole", "few") not in found


def test_boxes_below_the_score_that_is_shown_are_no_faults():
    report = judged()
    weak = replace(report.tracks["whole"], score=np.full(len(report.tracks["whole"]), 0.1))
    found = comparisons(replace(report, tracks={"whole": weak}), {"whole": 0.3})
    assert [event[:3] for event in found[0]["events"]] == [[UNMATCHED, 0, MOMENTS - 1]] * 2


def test_faults_and_differences_are_visited_one_after_the_other(tmp_path):
    page = report_page(Report("faults", [], [judged()]))
    script = """
  const clock = () => $of("clock").value, said = () => $of("visited").value;
  at(0);
  key("s"); found.switched = [clock(), followed(), said()];
  key("f"); found.false_ = [clock(), followed(), said()];
  key("f"); found.around = [clock(), said().slice(0, 16)];
  $of("last-false").click(); found.back = clock();
  key("m"); found.missed = [clock(), followed(), said()];
  key("Escape"); found.left = said();
  found.alone = [...$of("visits").querySelectorAll("span")].map(each => each.textContent);
  $of("beside").value = "few"; $of("beside").onchange();
  at(0); key("v"); found.first = [clock(), followed(), said()];
  key("V"); found.last = [clock(), said().slice(0, 17)];
  found.beside = [...$of("visits").querySelectorAll("span")].map(each => each.textContent);
"""
    found = tried_in_browser(page, HELPERS + script, tmp_path)
    assert found["faults"] == []
    assert found["switched"] == ["3.0 s", "track 2", "switch 1 of 1: object a, track 1 → 2"]
    assert found["false_"] == ["3.5 s", "track 4", "false box 2 of 2: track 4 without an object for a moment"]
    assert found["around"] == ["1.0 s", "false box 1 of 2"]
    assert found["back"] == "3.5 s"
    assert found["missed"] == ["0.0 s", "", "miss 1 of 1: object b without a track for 1.5 s"]
    assert found["left"] == ""
    assert found["alone"] == ["‹ 1 switch ›", "‹ 1 miss ›", "‹ 2 false boxes ›"]
    assert found["beside"] == [*found["alone"], "‹ 4 differences ›"]
    assert found["first"] == ["1.0 s", "track 4", "difference 1 of 4: 4 in whole alone for 1.0 s"]
    assert found["last"] == ["3.5 s", "difference 4 of 4"]


def test_relations_have_the_names_of_their_rules(tmp_path):
    class Admires:
        interaction = SharedVelocity()

        def pairs(self, nodes):
            tied = np.arange(min(len(nodes) - 1, 1))
            return Pairs(tied, tied + 1, np.full(len(tied), 0.4))

    report = crowded(["car", "car"])
    data = scene_data(replace(report, rules=(Following(), Admires())))["methods"]["saga"]
    assert data["relations"] == ["follows", "Admires", "yields to", "takes the right of way of"]
    assert [0, 1, 400, 1] in data["edges"][3]
    page = report_page(Report("relations", [], [replace(report, rules=(Admires(),))]))
    script = """
  const texts = [], fill = CanvasRenderingContext2D.prototype.fillText;
  CanvasRenderingContext2D.prototype.fillText = function (text, ...rest) {
    texts.push(text);
    fill.call(this, text, ...rest);
  };
  key("e"); found.texts = texts;
  at(3); key("n"); found.facts = $of("panel").textContent;
"""
    found = tried_in_browser(page, HELPERS + script, tmp_path)
    assert found["faults"] == []
    assert "Admires" in found["texts"]
    assert "Admires" in found["facts"]


def test_keys_and_their_help_also_after_a_click_on_a_control(tmp_path):
    found = tried(
        """
  const on = (id, name) => $of(id).dispatchEvent(new KeyboardEvent("keydown", {key: name, bubbles: true}));
  at(5); $of("show-ids").click(); on("show-ids", "ArrowRight"); found.box = $of("clock").value;
  on("play", "ArrowRight"); found.button = $of("clock").value;
  on("time", "ArrowRight"); found.slider = $of("clock").value;
  on("time", "n"); found.followed = followed();
  on("show-ids", " "); found.playing = $of("play").textContent;
  key("Escape"); at(5);
  key("n"); found.next = followed();
  key("n"); found.other = followed();
  key("p"); found.back = followed();
  key("Escape"); found.none = followed();
  key("]"); found.more = $of("score-0").value; key("["); found.less = $of("score-0").value;
  key("ArrowRight", {shiftKey: true}); found.last = $of("clock").value;
  key("g"); found.ghosts = $of("show-ghosts").checked;
  key("?"); found.help = $of("help").open; found.keys = $of("keys").children.length;
  key("ArrowLeft"); found.still = $of("clock").value;
""",
        tmp_path,
    )
    assert (found["box"], found["button"]) == ("3.0 s", "3.5 s")
    assert found["slider"] == "3.5 s"  # the slider moves itself
    assert found["playing"] == "Play"  # space is the check box's
    assert found["followed"] == found["next"] == "track car-1"  # the nearest
    assert found["other"] != found["back"] == found["next"]
    assert found["none"] == ""
    assert (found["more"], found["less"]) == ("0.35", "0.3")
    assert found["last"] == found["still"] == "4.5 s"
    assert found["ghosts"]
    assert found["help"]
    assert found["keys"] > 20


def test_the_first_threshold_is_that_of_the_best_mota_as_by_evaluate():
    assert start_thresholds([scene("a")]) == {"few": PLAIN, "whole": PLAIN}
    thresholds = start_thresholds([scene("a", truth=True)])
    assert thresholds["few"] == pytest.approx(0.8)
    assert thresholds["whole"] == pytest.approx(0.8)  # below come false boxes alone
    report = scene("a", truth=True)
    swept = best_thresholds(score_sweep([(report.scene, report.tracks["whole"])]))
    assert start_thresholds([report])["whole"] == pytest.approx(swept["car"], abs=0.01)
    report = crowded(["car"])
    table = report.tracks["saga"]
    weak = replace(table, score=np.full(len(table), 0.1))
    assert start_thresholds([replace(report, tracks={"saga": weak})]) == {"saga": 0.0}


def test_boxes_at_hidden_objects_do_not_count():
    boxes = Boxes.of(["car", "car"], [[0.0, 0, 0], [9.0, 0, 0]])
    truth = Annotations(np.array(["a", "b"]), boxes, np.array([True, False]))
    found = SceneBoxes(np.zeros(2, dtype=np.int64), np.array(["1", "2"]), boxes, np.array([0.9, 0.1]))
    short = Scene("s", np.zeros(1), np.eye(4)[None], ("",), (), [truth])
    assert start_thresholds([ReportScene(short, {"x": found}, {})]) == {"x": 0.9}


# Maps and camera images below and beside the tracks, where their files are there

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


def test_a_map_is_cut_to_the_surroundings_of_the_path(root):
    scenes = scene_of(root)
    known = source_of(root).surroundings(scenes).maps()["scene-0103"]
    assert [(kind, len(rings)) for kind, rings in known.areas] == [("drivable", 2), ("crossing", 1)]
    reach = scenes["scene-0103"].world_T_ego[:, 0, 3].max() + 120
    assert known.areas[0][1][0][:, 0].max() == pytest.approx(reach)
    assert len(known.lines) == 1
    shutil.rmtree(root / "maps")
    assert source_of(root).surroundings(scenes).maps() == {}


def test_broken_maps_are_refused(root):
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


def test_maps_of_argoverse_are_found(tmp_path):
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


def test_a_ring_is_clipped_to_a_rectangle():
    low, high = np.zeros(2), np.ones(2)
    diamond = np.array([[0.5, -0.5], [1.5, 0.5], [0.5, 1.5], [-0.5, 0.5]])
    inside = clipped(diamond, low, high)
    assert ((inside >= -1e-12) & (inside <= 1 + 1e-12)).all()
    x, y = inside.T
    assert abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2 == pytest.approx(1.0)
    assert len(clipped(diamond + 9, low, high)) == 0
    square = np.array([[0.2, 0.2], [0.8, 0.2], [0.8, 0.8]])
    np.testing.assert_array_equal(clipped(square, low, high), square)


def test_images_of_nuscenes_are_found_by_moment(root):
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


def test_images_of_kitti_are_found(tmp_path):
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


def test_the_page_draws_the_map_and_shows_the_images(root, tmp_path):
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
