// Corrections of labels: the list of what is worth a look, edits of the followed box, and where they are kept: at the
// server that the page came from, which solves the scene again, or in the page until they are saved as a file.
const TURN = 22, GRAB = 10, LISTED = 200;  // pixels to the handle before a box, and around what is grabbed; rows
const SIGMA = .1;  // m, deviation of a box that a person puts somewhere
const WHY = {false: "there may be no such object", missing: "held back, but may exist", class: "may be of another class",
  identity: "may be two objects, joined here", heading: "may face the other way", box: "boxes may be off"};
let editing = null;

LAYERS.push({name: "corrections", on: true, there: () => editing, draw: view => editing.draw(view)});

LAYERS.splice(2, 0, {name: "points", text: "LiDAR points", on: true, there: scene => editing?.scanned(scene), draw: view => editing.drawPoints(view)});

function makeReview(settings, stage) {
  const store = settings.server ? serverStore() : pageStore(`saga-fg review ${settings.folder}`);
  const memory = `seen ${settings.folder}`, seen = new Set(remembered(memory));  // keys of rows that were looked at
  let rows = settings.rows.sort((a, b) => b.gain - a.gain), told = [], trail = [], current = "", merging = null, grabbed = null, draft = null, changed = null;
  let cloud = {key: "", points: []};  // of the LiDAR
  let waiting = 0, chain = Promise.resolve();  // actions are answered one after the other
  const key = row => `${row.scene} ${row.id}`;
  const world = (scene, row) => [scene.origin[0] + row[X] / 100, scene.origin[1] + row[Y] / 100].map(v => +v.toFixed(3));
  const said = element("output", {id: "said"}), list = element("ol", {id: "rows"});
  const undo = button("Undo", "u", () => send(() => store.undo(stage.scene().name), "undone"));
  const save = button("Save corrections", "", saveFile);
  save.hidden = settings.server;
  document.querySelector(".stage").prepend(element("section", {id: "review"},
    element("h2", {}, "Worth a look"), element("div", {className: "bar"}, button("Next", "j", () => next()), undo, save), said, list));
  document.body.classList.add("reviewing");

  function say(text, fault = false) { said.value = text; said.className = fault ? "fault" : ""; }

  function send(ask, action = "") {  // without an action what comes is no change to be marked
    const scene = stage.scene();
    waiting++;
    document.body.dataset.review = "waiting";
    if (settings.server) say(action ? `${action}; solving again ...` : `solving ${scene.name} ...`);
    chain = chain.then(ask).then(answer => take(answer, scene, action)).catch(fail).catch(fail).then(() => {
      draft = null;
      if (!--waiting) document.body.dataset.review = "ready";
      stage.draw();
    });
    return chain;
  }

  function take(answer, scene, action) {
    if (scene === stage.scene()) told = answer.corrections;
    undo.disabled = !told.length;
    if (!answer.scene) return say(`${counted(store.count())} in this page; save them for saga-fg smooth --corrections`);
    const before = scene.methods.labels;
    stage.refresh(scene, answer.scene);
    rows = [...rows.filter(row => row.scene !== scene.name), ...answer.rows].sort((a, b) => b.gain - a.gain);
    changed = action ? {scene, ...differences(before, scene.methods.labels)} : null;
    const unfit = told.filter(each => each.problem).map(each => `line ${each.number}: ${each.problem}`);
    say([action ? `${action}: ${changed.text}` : `${counted(told.length)} of this scene`, ...unfit].join("; "));
    showRows();
  }

  async function fail(error) {
    const scene = stage.scene();
    if (error.status === 409) take(await store.state(scene.name), scene, "");
    say(error.status ? error.message : `not kept: no answer from the server (${error.message})`, true);
  }

  function act(record) {
    const who = settings.who ? {who: settings.who} : {};
    const whole = {...record, scene: stage.scene().name, ...who, when: new Date().toISOString()};
    const word = {exists: record.value ? "exists" : "does not exist", class: `is a ${record.label}`, same: record.value ? "merged" : "cut"};
    return send(() => store.correct(whole), word[record.what] ?? "box put there");
  }

  function place(row, k = stage.k()) {
    const scene = stage.scene(), [x, y] = world(scene, row);
    return {time: scene.start + scene.times[k], x, y, label: scene.labels[row[LABEL]]};
  }

  function withBox(use) {  // the followed box, or a hint
    const row = stage.focus();
    return row ? use(row) : say("follow an object that is there now: click it, or press j", true);
  }

  function putBox(row, change) {  // goes on from a box that was put there before
    const at = place(row), near = box => Math.hypot(box.x - at.x, box.y - at.y) < 1;
    const before = told.map(each => each.record).filter(one => one.what === "box" && Math.abs(one.at.time - at.time) < 1e-3 && near(one.box)).pop();
    const doubt = Math.max(SIGMA, Math.sqrt((row[XX] + row[YY]) / 2) / 100), moved = "x" in change || before;
    const box = {x: at.x, y: at.y, ...before?.box, ...change};
    act({what: "box", at, box, deviation: {position: moved ? SIGMA : +doubt.toFixed(3)}});
  }

  function turnTo(row, yaw) { putBox(row, {yaw: +Math.atan2(Math.sin(yaw), Math.cos(yaw)).toFixed(4)}); }

  function cut(row) {  // between the moment before and this one
    const k = stage.k(), before = k > 0 && stage.scene().methods.labels.moments[k - 1].find(each => each[ID] === row[ID]);
    if (!before) return say("cut: the object begins here, there is nothing before", true);
    act({what: "same", at: place(before, k - 1), and: place(row), value: false});
  }

  function merge(row) {
    if (click(row)) return;
    merging = place(row);
    say("click the other part of the object, at any moment, or follow it and press m; Esc: not");
  }

  function add() {  // an object that nothing detected
    const {x, y} = stage.pointer(), scene = stage.scene(), label = prompt("class of a new object under the pointer")?.trim();
    if (!label) return;
    const box = {x: +(scene.origin[0] + x).toFixed(3), y: +(scene.origin[1] + y).toFixed(3)};
    act({what: "box", at: {time: scene.start + scene.times[stage.k()], ...box, label}, box, label});
  }

  function click(row) {  // true where a click means more than to follow
    if (!merging || !row) return false;
    const at = merging;
    merging = null;
    act({what: "same", at, and: place(row), value: true});
    return true;
  }

  function cancel() {
    if (merging) say("");
    merging = grabbed = draft = null;
  }

  function look(row) {
    current = key(row);
    seen.add(current);
    remember(memory, [...seen]);
    stage.look(row.scene, +row.timestamp, String(row.id));
    showRows();
  }

  function next() {
    const row = rows.find(each => !seen.has(key(each)));
    if (!row) return say("all objects of the list were looked at");
    if (current) trail.push(current);
    look(row);
  }

  function back() {
    const before = trail.pop(), row = rows.find(each => key(each) === before);
    if (row) look(row);
  }

  function showRows() {
    list.replaceChildren(...rows.slice(0, LISTED).map(row => {
      const name = `${row.label} ${row.id}`, title = `${row.scene}: ${WHY[row.why] ?? row.why}`;
      const item = element("button", {type: "button", title, onclick: () => look(row)},
        element("b", {}, (+row.gain).toFixed(1)), element("span", {}, name), element("i", {}, row.why));
      item.classList.toggle("seen", seen.has(key(row)));
      item.setAttribute("aria-current", String(key(row) === current));
      return element("li", {}, item);
    }));
  }

  function describe(panel, id) {  // what the list says of the followed object
    const row = rows.find(each => each.scene === stage.scene().name && String(each.id) === id);
    if (!row) return;
    const facts = {exists: row.p_exists, "of its class": row.p_class, "one object": row.p_identity, "heading right": row.p_heading};
    const list = element("dl", {}, ...Object.entries(facts).flatMap(([name, p]) =>
      [element("dt", {}, name), element("dd", {}, p == null ? "-" : (+p).toFixed(2))]));
    panel.append(element("p", {}, WHY[row.why] ?? row.why), list);
  }

  function grab({x, y}, thin) {  // true where the pointer holds the followed box, or its handle
    const row = merging ? null : stage.focus();
    if (!row) return false;
    const [cx, cy] = middle(row), c = Math.cos(row[YAW] / 1000), s = Math.sin(row[YAW] / 1000);
    const along = (x - cx) * c + (y - cy) * s, across = (y - cy) * c - (x - cx) * s;
    const inside = (value, side) => Math.abs(value) < Math.max(side / 200, GRAB * thin);
    const turn = Math.hypot(along - row[LENGTH] / 200 - TURN * thin, across) < GRAB * thin;
    if (!turn && !(inside(along, row[LENGTH]) && inside(across, row[WIDTH]))) return false;
    grabbed = {turn, row, x, y};
    return true;
  }

  function drag({x, y}) {
    const {turn, row} = grabbed, [cx, cy] = middle(row);
    draft = [...row];
    if (turn) draft[YAW] = 1000 * Math.atan2(y - cy, x - cx);
    else { draft[X] += 100 * (x - grabbed.x); draft[Y] += 100 * (y - grabbed.y); }
    stage.draw();
  }

  function drop() {
    const {turn, row} = grabbed, [x, y] = draft ? world(stage.scene(), draft) : [];
    grabbed = null;
    if (!draft) return;
    if (turn) turnTo(row, draft[YAW] / 1000);
    else putBox(row, {x, y});
  }

  function draw(view) {
    const {g, scene, k, thin, focus} = view;
    g.lineWidth = 1.5 * thin; g.strokeStyle = SOFT;
    g.setLineDash([3 * thin, 3 * thin]);
    for (const row of changed?.scene === scene ? changed.before[k] : []) { box(g, row, X); g.stroke(); }
    g.setLineDash([]);
    for (const {record, problem} of told) drawCorrection(view, record, problem);
    if (!focus) return;
    const row = draft ?? focus, [x, y] = middle(row), reach = row[LENGTH] / 200 + TURN * thin;
    g.strokeStyle = g.fillStyle = "#c2185b"; g.lineWidth = 2 * thin;
    if (draft) { box(g, draft, X); g.stroke(); }
    g.beginPath(); g.arc(x + reach * Math.cos(row[YAW] / 1000), y + reach * Math.sin(row[YAW] / 1000), 5 * thin, 0, 7); g.fill();
  }

  function drawPoints({g, scene, k, thin, focus}) {  // around the followed box, once they are there
    const wanted = focus && `${scene.name} ${k} ${focus[ID]}`;
    if (wanted && cloud.key !== wanted) {
      const mine = cloud = {key: wanted, points: []};
      store.points(scene.name, k, world(scene, focus)).then(points => { mine.points = points; stage.draw(); }, () => {});
    }
    g.fillStyle = SOFT; g.globalAlpha = .6;
    if (focus) for (const [x, y] of cloud.points) g.fillRect(x / 100 - thin, y / 100 - thin, 2 * thin, 2 * thin);
  }

  function saveFile() {
    const text = store.all().map(record => JSON.stringify(record) + "\n").join("");
    const link = element("a", {href: URL.createObjectURL(new Blob([text], {type: "application/jsonl"})), download: settings.file});
    link.click();
    say(`${counted(store.count())} saved as ${settings.file}`);
  }

  const keys = {
    j: ["j", "the next object of the list", next],
    k: ["k", "the one before", back],
    y: ["y", "it exists", () => withBox(row => act({what: "exists", at: place(row), value: true}))],
    x: ["x", "it does not exist", () => withBox(row => act({what: "exists", at: place(row), value: false}))],
    t: ["t", "turn it half round; drag the box or the point before it for less", () => withBox(row => turnTo(row, row[YAW] / 1000 + Math.PI))],
    c: ["c", "cut: another object from this moment on", () => withBox(cut)],
    m: ["m", "merge with the object clicked next", () => withBox(merge)],
    l: ["l", "it is of a class that you name", () => withBox(row => { const label = prompt("class")?.trim(); if (label) act({what: "class", at: place(row), label}); })],
    b: ["b", "a box for an object that nothing detected, under the pointer", add],
    u: ["u", "undo the last correction of the scene", () => undo.click()],
  };
  settings.classes.slice(0, 9).forEach((label, n) => {
    keys[n + 1] = [`${n + 1}`, `it is a ${label}`, () => withBox(row => act({what: "class", at: place(row), label}))];
  });
  const enter = () => { told = []; changed = merging = null; send(() => store.state(stage.scene().name)); };
  if (settings.server) window.addEventListener("focus", async () => { if (!waiting && await store.outdated(stage.scene().name)) enter(); });
  showRows();
  const scanned = scene => settings.scanned.includes(scene.name);
  editing = {keys, enter, click, cancel, grab, drag, drop, draw, drawPoints, scanned, describe};
  return editing;
}

function serverStore() {  // the file of corrections, behind the address of this page
  let version = "";
  async function ask(path, body) {
    const json = {method: "POST", headers: {"Content-Type": "application/json"}, body: JSON.stringify({version, ...body})};
    const response = await fetch(path, body && json), answer = await response.json();
    if (!response.ok) throw Object.assign(new Error(answer.error), {status: response.status});
    version = answer.version ?? version;
    return answer;
  }
  const state = scene => ask(`state?scene=${encodeURIComponent(scene)}`);
  async function outdated(scene) {
    const before = version;
    return await state(scene).then(() => version !== before, () => false);
  }
  const points = (scene, moment, [x, y]) => ask(`points?${new URLSearchParams({scene, moment, x, y})}`);
  return {state, outdated, points, correct: correction => ask("correct", {correction}), undo: scene => ask("undo", {scene})};
}

function pageStore(name) {  // in the browser, until they are saved
  const read = () => remembered(name), write = all => remember(name, all);
  const answer = scene => ({corrections: read().map((record, at) => ({number: at + 1, record, problem: ""})).filter(each => each.record.scene === scene)});
  return {
    all: read, count: () => read().length,
    state: async scene => answer(scene),
    correct: async record => { write([...read(), record]); return answer(record.scene); },
    undo: async scene => {  // another window may have taken it back
      const all = read(), last = all.findLastIndex(one => one.scene === scene);
      if (last >= 0) write(all.toSpliced(last, 1));
      return answer(scene);
    },
  };
}

const MEMORY = {};  // where the browser keeps nothing for a page from disk
function remembered(name) { try { return JSON.parse(localStorage.getItem(name)) ?? []; } catch { return MEMORY[name] ?? []; } }
function remember(name, value) { try { localStorage.setItem(name, JSON.stringify(value)); } catch { MEMORY[name] = value; } }

function differences(old, now) {  // of two results of a scene: old boxes, by moment, that moved or went; and in words
  let moved = 0, most = 0, gone = 0, before = 0, after = 0;
  const boxes = old.moments.map((rows, k) => {
    const later = new Map(now.moments[k].map(row => [now.ids[row[ID]], row]));
    before += rows.length; after += later.size;
    return rows.filter(row => {
      const other = later.get(old.ids[row[ID]]);
      if (!other) { gone++; return true; }
      const far = Math.hypot(other[X] - row[X], other[Y] - row[Y]) / 100, turned = Math.abs(Math.sin((other[YAW] - row[YAW]) / 2000));
      const differs = far > .05 || turned > .02 || other[LENGTH] !== row[LENGTH] || other[WIDTH] !== row[WIDTH];
      if (differs) { moved++; most = Math.max(most, far); }
      return differs;
    });
  });
  const parts = [[moved, `${moved} boxes changed, moved by ${most.toFixed(2)} m at most`], [gone, `${gone} gone`], [after - before + gone, `${after - before + gone} new`]];
  return {before: boxes, text: parts.filter(([count]) => count).map(([, text]) => text).join(", ") || "no box changed"};
}

function drawCorrection({g, scene, k, thin, result}, record, problem) {  // a sign where a correction of this moment is
  const here = place => Math.abs(place.time - scene.start - scene.times[k]) < .05;
  const at = ({x, y}) => [x - scene.origin[0], y - scene.origin[1]], [x, y] = at(record.at), r = 7 * thin;
  if (!here(record.at) && !(record.and && here(record.and))) return;
  g.strokeStyle = g.fillStyle = problem ? SOFT : "#c2185b"; g.lineWidth = 2 * thin;
  g.beginPath();
  if (record.what === "box") {
    const near = row => Math.hypot(row[X] / 100 - x, row[Y] / 100 - y), rows = [...result.moments[k]].sort((a, b) => near(a) - near(b));
    const [length, width, yaw] = rows.length ? [rows[0][LENGTH] / 100, rows[0][WIDTH] / 100, rows[0][YAW] / 1000] : [1, 1, 0];
    outline(g, ...at(record.box), record.box.length ?? length, record.box.width ?? width, record.box.yaw ?? yaw);
  } else if (record.what === "same") {
    g.moveTo(x, y); g.lineTo(...at(record.and));
    g.setLineDash(record.value === false ? [2 * thin, 4 * thin] : []);
  } else if (record.what === "exists" && record.value === false) {
    g.moveTo(x - r, y - r); g.lineTo(x + r, y + r); g.moveTo(x - r, y + r); g.lineTo(x + r, y - r);
  } else g.arc(x, y, r, 0, 7);
  g.stroke(); g.setLineDash([]);
}

const counted = number => `${number} correction${number === 1 ? "" : "s"}`;

function element(tag, values, ...children) {
  const made = Object.assign(document.createElement(tag), values);
  made.append(...children);
  return made;
}

function button(text, key, onclick) { return element("button", {type: "button", title: key && `key ${key}`, onclick}, text); }
