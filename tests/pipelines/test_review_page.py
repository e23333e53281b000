"""The page of a review in Chromium: with the server that it came from, and from disk."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from data_tools.datasets.corrections import read_corrections
from pipelines.review import CORRECTIONS, ReviewServer, ReviewSession, read_label_run
from tests.pipelines.command import done
from tests.pipelines.page_in_browser import found_at, tried_in_browser, with_script
from tests.pipelines.test_review import HEADER, rows

HELPERS = """
  const $of = id => document.getElementById(id), pause = ms => new Promise(go => setTimeout(go, ms));
  const settled = async () => { while (document.body.dataset.review === "waiting") await pause(20); };
  const press = async name => {
    document.dispatchEvent(new KeyboardEvent("keydown", {key: name, bubbles: true}));
    await pause(20); await settled();
  };
  const said = () => $of("said").value, followed = () => $of("panel").querySelector("h2")?.textContent ?? "";
  const at = async k => { $of("time").value = k; $of("time").oninput(); await pause(20); };
  const view = $of("view"); view.setPointerCapture = () => {};
  const pointer = (type, x, y) => {
    const box = view.getBoundingClientRect();
    view.dispatchEvent(new PointerEvent(type, {clientX: box.x + x, clientY: box.y + y, pointerId: 1, bubbles: true}));
  };
  const pull = async (from, to) => {
    pointer("pointerdown", ...from); pointer("pointermove", ...to); pointer("pointerup", ...to);
    await pause(20); await settled();
  };
  const centre = () => [view.clientWidth / 2, view.clientHeight / 2];  // where the followed box is
  const facts = () => Object.fromEntries(
    [...$of("panel").querySelectorAll("dt")].map(dt => [dt.textContent, dt.nextElementSibling.textContent]));
  const follow = async (id, k) => { location.hash = `#scene=a&t=${k / 4}&id=${id}`; await pause(50); await settled(); };
  const count = () => +view.dataset.tracks;
"""


@pytest.fixture(scope="module")
def labels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("review")
    (folder / "two.csv").write_text("\n".join([HEADER, *rows("a"), *rows("b")]) + "\n")
    done("smooth", "file", folder / "two.csv", "-o", folder / "labels")
    return folder / "labels"


class ScriptedSession(ReviewSession):
    """A review whose page runs a script."""

    script = ""

    def page(self, server: bool) -> str:
        return with_script(super().page(server), HELPERS + "await settled();" + self.script)


@contextmanager
def running(labels: Path, file: Path) -> Iterator[ReviewServer]:
    with ReviewServer(ScriptedSession(labels, read_label_run(labels), file, "anna")) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def seen(server: ReviewServer, script: str, folder: Path, hash_: str = "") -> Any:
    """The state that a window finds that is opened now."""
    vars(server.session)["script"] = script
    found = found_at(server.url + hash_, folder)
    assert found["faults"] == []
    return found


def ids_of(server: ReviewServer) -> dict[str, str]:
    """The names of the objects of scene a by where they are at its moment 4."""
    result = server.session.state("a")["scene"]["methods"]["labels"]
    names = {8: "driving", 20: "parked", 36: "passing"}
    return {
        names[min(names, key=lambda x: abs(100 * x - row[2]))]: result["ids"][row[0]] for row in result["moments"][4]
    }


def test_a_session_of_twenty_actions_a_reload_and_a_second_window(labels, tmp_path):
    file = tmp_path / CORRECTIONS
    with running(labels, file) as server:
        ids = ids_of(server)
        first = seen(
            server,
            f"""
  const ids = {json.dumps(ids)};
  found.listed = $of("rows").children.length;
  await press("j"); found.jumped = followed();
  await follow(ids.parked, 8); found.before = [count(), facts().class];
  await press("y"); found.exists = facts().exists;
  window.prompt = () => "bus";
  await press("l"); found.named = said();
  found.bus = facts().class;
  await press("u"); found.undone = facts().class;
  const [x, y] = centre();
  await pull([x, y], [x + 12, y + 9]); found.moved = said();
  await pull([x + 12, y], [x, y - 40]); found.still = said();
  for (const k of [10, 12, 14]) {{ await at(k); await press("y"); }}
  await follow(ids.driving, 4); await press("t"); found.turned = said();
  await press("u");
  await at(12); await press("c"); found.cut = said();
  await follow(ids.passing, 4); await press("x"); found.deleted = [count(), followed()];
  await press("u"); found.back = [count(), followed()];
  await at(6); pointer("pointermove", centre()[0] + 60, centre()[1] - 90); window.prompt = () => "cyclist";
  await press("b"); found.added = [said(), count()];
  await press("u"); await follow(ids.passing, 4);
""",
            tmp_path,
        )
        assert first["listed"] > 0
        assert first["jumped"].startswith("track ")
        assert first["before"] == [3, "car"]
        assert first["exists"] in ("1.00", None)
        assert first["named"].startswith("is a bus: ")
        assert (first["bus"], first["undone"]) == ("bus", "car")
        assert "boxes changed" in first["moved"]
        assert "boxes changed" in first["turned"]
        assert "new" in first["cut"]
        assert first["deleted"] == [2, ""]
        assert first["back"] == [3, f"track {ids['passing']}"]
        assert first["added"][0].startswith("box put there: ")
        assert "new" in first["added"][0]
        written = read_corrections(file)
        assert [one.what for one in written][:2] == ["exists", "box"]
        assert {one.who for one in written} == {"anna"}
        assert written[1].box["x"] == pytest.approx(20 + 12 / 25, abs=0.3)

        again = seen(
            server,
            f"""
  const ids = {json.dumps(ids)};
  found.told = said();
  await follow(ids.driving, 4); found.start = followed();
  await press("m"); found.asked = said();
  const {{scene: {{methods: {{labels: cut}}}}}} = await (await fetch("state?scene=a")).json();
  const rest = cut.ids.filter(id => !Object.values(ids).includes(id));
  await follow(rest[0], 16); await press("m"); found.merged = [rest.length, said()];
  await follow(ids.driving, 9); await press("m"); await press("Escape"); found.cancelled = said();
  const second = body => fetch("undo", {{
    method: "POST", headers: {{"Content-Type": "application/json"}}, body: JSON.stringify(body)}});
  const {{version}} = await (await fetch("state?scene=a")).json();
  await second({{version, scene: "a"}});
  await follow(ids.parked, 8); await press("y"); found.conflict = said();
  await press("y"); found.then = said();
  for (let k = 0; k < 6; k++) {{ await at(4 + k); await press("y"); }}
  for (let k = 0; k < 3; k++) await press("u");
""",
            tmp_path,
        )
        assert again["told"].startswith(f"{len(written)} corrections of this scene")
        assert again["start"] == f"track {ids['driving']}"
        assert "click the other part" in again["asked"]
        assert again["merged"][0] == 1
        assert again["merged"][1].startswith("merged: ")
        assert "changed" in again["merged"][1]
        assert again["cancelled"] == ""
        assert "another window" in again["conflict"]
        assert "another window" not in again["then"]
        assert len(read_corrections(file)) == len(written) + 4


def test_a_page_from_disk_collects_corrections_and_offers_them_as_a_file(labels, tmp_path):
    script = """
  await settled();
  let saved = null;
  URL.createObjectURL = blob => { saved = blob; return "#"; };
  const ids = scene => [...$of("rows").querySelectorAll("button")].map(each => each.textContent);
  found.listed = ids().length;
  await press("j"); await press("y"); found.said = said();
  const [x, y] = centre();
  await pull([x, y], [x + 40, y]);
  await press("x"); await press("u");
  const key = Object.keys(localStorage).find(each => each.startsWith("saga-fg review")) ?? Object.keys(MEMORY)[0];
  const mine = remembered(key), others = mine.map(each => ({...each, scene: "b"}));
  remember(key, others); await press("u"); found.others = remembered(key).length;  // another window took them back
  remember(key, mine);
  [...document.querySelectorAll("#review button")].find(each => each.textContent === "Save corrections").click();
  found.saved = await saved.text();
  found.again = said();
"""
    session = ReviewSession(labels, read_label_run(labels), tmp_path / "mine.jsonl", "anna")
    found = tried_in_browser(session.page(server=False), HELPERS + script, tmp_path)
    assert found["faults"] == []
    assert found["listed"] > 0
    assert found["said"].startswith("1 correction in this page")
    assert found["others"] == 2
    assert found["again"] == "2 corrections saved as mine.jsonl"
    (tmp_path / "mine.jsonl").write_text(found["saved"])
    table = labels.parent / "two.csv"
    run = done("smooth", "file", table, "--corrections", tmp_path / "mine.jsonl", "-o", tmp_path / "new")
    assert "not applied" not in run.stderr
    assert [one.what for one in read_corrections(tmp_path / "mine.jsonl")] == ["exists", "box"]
