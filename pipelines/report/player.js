const $ = id => document.getElementById(id);
const FARTHEST = 1, NEAREST = 80, FITTED = 25, CLOSE = 20;  // zoom, pixels per m: least, most, most that fits, for one box
const MARGIN = 12, OUTLIERS = .02;  // m around what is shown, and the share of boxes to either side that need not fit

async function unpack(text) {
  const bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return JSON.parse(await new Response(stream).text());
}

function player({scenes, start, thresholds, ghosts, beside, review}) {
  const canvas = $("view"), g = canvas.getContext("2d");
  const shown = Object.fromEntries(LAYERS.map(layer => [layer.name, layer.on]));
  const filters = makeFilters(scenes, thresholds, ghosts, () => draw(), () => fit(shownAt(k).length ? [k] : undefined));
  let scene = scenes[0], k = 0, picked = null, timer = null, zoom = CLOSE, offset = [0, 0], aim = [0, 0], views = [], lost = null, pointer = {x: 0, y: 0};
  // picked: {method, id} of the track that is followed; aim: m ahead and to the left of the vehicle, in the middle of the view; views: of the last drawing, from left to right; lost: name of one that was followed, and deleted; pointer: where it is, m

  const last = () => scene.times.length - 1;
  const names = () => $("beside").value ? [$("beside").value, $("method").value] : [$("method").value];
  const rowOf = track => track && scene.methods[track.method].moments[k].find(row => row[ID] === track.id);

  function chooseScene(index) {
    scene = scenes[index];
    const before = [$("method").value, $("scene").dataset.chosen ? $("beside").value : beside], there = Object.keys(scene.methods);
    $("scene").selectedIndex = index; $("scene").dataset.chosen = "yes";
    $("method").replaceChildren(...there.map(name => new Option(name, name)));
    $("method").value = there.includes(before[0]) ? before[0] : there[there.length - 1];
    $("beside").replaceChildren(new Option("alone", ""), ...there.map(name => new Option(`beside ${name}`, name)));
    $("beside").value = there.includes(before[1]) ? before[1] : "";
    $("method").hidden = $("beside").hidden = there.length < 2;
    $("time").max = last();
    for (const layer of LAYERS) $(`show-${layer.name}`).parentElement.hidden = !(layer.there ? layer.there(scene) : true);
    filters.showClasses(scene);
    picked = null;
    k = 0;
    chooseMethods();
    show(fullest());
    editor?.enter();
  }

  function fullest() {  // the first of the moments with the most tracks that are shown
    const counts = scene.times.map((_, at) => shownAt(at).length);
    return counts.reduce((best, count, at) => count > counts[best] ? at : best, 0);
  }

  function chooseMethods() {
    if (picked && !names().includes(picked.method)) picked = null;
    filters.showScores(names());
    showHorizons(names().map(name => scene.methods[name]), draw);
    visits.choose(scene, names());
    fit();
  }

  function frame(at) {  // place and direction of the vehicle; of one that stands, north is up
    const [x, y, yaw] = scene.ego[moves(scene) ? at : 0];
    return [x / 100, y / 100, moves(scene) ? yaw / 1000 : 0];
  }

  function shownAt(at) { return names().flatMap(name => filters.rows(scene, name, at, null)); }

  function fit(moments = [...scene.times.keys()]) {  // the tracks that are shown at these moments, seen from the vehicle
    const points = moments.flatMap(at => {
      const [x, y, yaw] = frame(at), c = Math.cos(yaw), s = Math.sin(yaw);
      return shownAt(at).map(middle).map(([px, py]) => [(px - x) * c + (py - y) * s, (py - y) * c - (px - x) * s]);
    });
    const spans = [0, 1].map(axis => {
      const values = points.map(point => point[axis]).sort((a, b) => a - b), cut = Math.floor(OUTLIERS * values.length);
      return values.length ? [values[cut], values[values.length - 1 - cut]] : [-MARGIN, MARGIN];
    });
    const sides = spans.map(([low, high]) => high - low + MARGIN);
    aim = spans.map(([low, high]) => (low + high) / 2);
    offset = [0, 0];
    zoom = Math.max(FARTHEST, Math.min(FITTED, canvas.clientWidth / names().length / sides[0], canvas.clientHeight / sides[1]));
    draw();
  }

  function show(moment) {
    k = Math.max(0, Math.min(last(), moment));
    $("time").value = k;
    $("clock").value = `${scene.times.length ? scene.times[k].toFixed(1) : "-"} s`;
    showImages(scene, k);
    draw();
  }

  function centre() {
    const [x, y, yaw] = frame(k), row = rowOf(picked), c = Math.cos(yaw), s = Math.sin(yaw);
    const place = row ? middle(row) : visits.place() ?? [x + aim[0] * c - aim[1] * s, y + aim[0] * s + aim[1] * c];
    return [...place, yaw];
  }

  function place(pane, panes) {  // world to pixels: driving direction to the right, left of the vehicle up
    const ratio = window.devicePixelRatio || 1, [x, y, yaw] = centre(), width = canvas.clientWidth / panes;
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.beginPath(); g.rect(pane * width, 0, width, canvas.clientHeight); g.clip();
    g.translate((pane + .5) * width + offset[0], canvas.clientHeight / 2 + offset[1]);
    g.scale(zoom, -zoom);
    g.rotate(-yaw); g.translate(-x, -y);
  }

  function draw() {
    if (!scene.times.length) return;
    const ratio = window.devicePixelRatio || 1, methods = names();
    canvas.width = canvas.clientWidth * ratio; canvas.height = canvas.clientHeight * ratio;
    const step = niceStep(canvas.clientWidth / methods.length / zoom, 7);
    views = methods.map((name, pane) => {
      const followed = picked?.method === name ? picked.id : null;
      const tracks = filters.rows(scene, name, k, followed);
      const view = {g, thin: 1 / zoom, step, scene, k, name, result: scene.methods[name], tracks, names: [], fans: [],
        focus: tracks.find(row => row[ID] === followed) ?? null,
        colour: row => filters.colour(scene, row), shownClass: label => filters.shownClass(scene, label)};
      g.save();
      place(pane, methods.length);
      for (const layer of LAYERS) {
        if (layer.there && !layer.there(scene)) continue;
        view.on = shown[layer.name];
        if (!view.on && !(layer.focused && view.focus)) continue;
        g.save(); layer.draw(view); g.restore();
      }
      visits.draw(view);
      view.inverse = g.getTransform().inverse();
      g.restore();
      return view;
    });
    drawBorders(methods, ratio, step);
    Object.assign(canvas.dataset, {tracks: views.map(view => view.tracks.length).join(" "), zoom, step, aim});
    describe();
  }

  function drawBorders(methods, ratio, step) {  // names of several methods, and a scale bar as long as a square of the grid
    const width = canvas.clientWidth / methods.length, low = canvas.clientHeight - 14, end = 14 + step * zoom;
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.font = "bold 13px system-ui, sans-serif"; g.fillStyle = SOFT; g.strokeStyle = "#c3ccd4"; g.lineWidth = 1;
    methods.forEach((name, pane) => {
      if (methods.length > 1) g.fillText(name, pane * width + 12, 20);
      if (pane) { g.beginPath(); g.moveTo(pane * width, 0); g.lineTo(pane * width, canvas.clientHeight); g.stroke(); }
    });
    g.strokeStyle = SOFT; g.lineWidth = 2; g.beginPath();
    for (const [x, y] of [[14, low - 5], [14, low], [end, low], [end, low - 5]]) g.lineTo(x, y);
    g.stroke(); g.fillText(`${step} m`, 20, low - 7);
  }

  function describe() {
    if (!picked) { $("panel").replaceChildren(); return; }
    const result = scene.methods[picked.method], row = result.moments.flat().find(each => each[ID] === picked.id);
    describeTrack($("panel"), scene, result, k, picked.id, filters.colour(scene, row));
    editor?.describe($("panel"), result.ids[picked.id]);
  }

  function follow(track) {
    picked = track;
    lost = null;
    offset = [0, 0];
    visits.leave();
    draw();
    remember();
  }

  function visit(event) {  // a fault or a difference, with the track that it concerns
    const at = event.method ? scene.methods[event.method].ids.indexOf(event.id) : -1;
    picked = at < 0 ? null : {method: event.method, id: at};
    offset = [0, 0];
    zoom = Math.max(zoom, FITTED / 2);
    show(event.k);
    remember();
  }

  function under(event) {  // the view and the point in the world under the pointer
    const ratio = window.devicePixelRatio || 1, pane = Math.min(views.length - 1, Math.floor(event.offsetX / canvas.clientWidth * views.length));
    const view = views[Math.max(0, pane)];
    return [view, view.inverse.transformPoint(new DOMPoint(event.offsetX * ratio, event.offsetY * ratio))];
  }

  function pick(event) {
    const [view, p] = under(event);
    const reach = row => Math.max(row[LENGTH] / 200, 12 / zoom);
    const near = view.tracks.map(row => [Math.hypot(row[X] / 100 - p.x, row[Y] / 100 - p.y) - reach(row), row[ID]]).filter(d => d[0] < 0);
    const track = near.length ? {method: view.name, id: near.sort((a, b) => a[0] - b[0])[0][1]} : null;
    if (!editor?.click(rowOf(track))) follow(track);
  }

  function next(step) {  // the tracks in view one after the other, the nearest to the vehicle first
    const [ex, ey] = scene.ego[k], view = views.find(each => each.name === picked?.method) ?? views[views.length - 1];
    const order = [...view.tracks].sort((a, b) => Math.hypot(a[X] - ex, a[Y] - ey) - Math.hypot(b[X] - ex, b[Y] - ey)).map(row => row[ID]);
    if (!order.length) return;
    const at = picked ? order.indexOf(picked.id) : step > 0 ? -1 : 0;
    follow({method: view.name, id: order[(at + step + order.length) % order.length]});
  }

  function play() {
    if (timer) { clearTimeout(timer); timer = null; $("play").textContent = "Play"; remember(); return; }
    $("play").textContent = "Pause";
    const step = () => {
      show(k >= last() ? 0 : k + 1);
      const gap = k < last() ? scene.times[k + 1] - scene.times[k] : 1;
      timer = setTimeout(step, 1000 * Math.max(.04, Math.min(gap, 1)) / (gap > .3 ? 2 : 1));
    };
    timer = setTimeout(step, 0);
  }

  function moment() {  // the address of what is shown
    const parts = {scene: scene.name, t: scene.times[k]?.toFixed(3), method: $("method").value, beside: $("beside").value};
    if (picked) parts.id = scene.methods[picked.method].ids[picked.id];
    return "#" + new URLSearchParams(Object.entries(parts).filter(part => part[1]));
  }

  function remember() {
    try { history.replaceState(null, "", moment()); } catch { return; }  // a frame of another page may not
  }

  function open(hash) {  // #scene=...&t=seconds&id=track&method=...&beside=..., each may be left out
    const asked = new URLSearchParams(hash.slice(1)), at = scenes.findIndex(each => each.name === asked.get("scene"));
    if (at >= 0 && scenes[at] !== scene) chooseScene(at);
    for (const select of ["method", "beside"])
      if (asked.has(select) && scene.methods[asked.get(select)]) $(select).value = asked.get(select);
    chooseMethods();
    const t = parseFloat(asked.get("t"));
    if (Number.isFinite(t)) show(nearest(t));
    const named = id => id === asked.get("id") || shortName(id) === asked.get("id");
    const owner = [...names()].reverse().find(name => scene.methods[name].ids.some(named));
    if (!owner) return;
    picked = {method: owner, id: scene.methods[owner].ids.findIndex(named)};
    if (!Number.isFinite(t) && !rowOf(picked)) show(scene.methods[owner].moments.findIndex(rows => rows.some(row => row[ID] === picked.id)));
    offset = [0, 0];
    draw();
  }

  function nearest(t) {  // moment
    return scene.times.reduce((best, time, i) => Math.abs(time - t) < Math.abs(scene.times[best] - t) ? i : best, 0);
  }

  const stage = {  // for corrections
    scene: () => scene, k: () => k, focus: () => rowOf(picked), pointer: () => pointer, draw,
    look(name, time, id) {
      const at = scenes.findIndex(each => each.name === name);
      if (scenes[at] !== scene) chooseScene(at);
      show(nearest(time - scene.start));
      zoom = Math.max(zoom, CLOSE);
      const number = scene.methods.labels.ids.indexOf(id);
      follow(number < 0 ? null : {method: "labels", id: number});
    },
    refresh(of, data) {
      const followed = picked && of === scene ? of.methods[picked.method].ids[picked.id] : lost;
      Object.assign(of, data);
      if (of !== scene) return;
      const id = scene.methods.labels.ids.indexOf(followed);
      picked = id < 0 ? null : {method: "labels", id};
      lost = id < 0 ? followed : null;
      filters.showClasses(scene);
      draw();
    },
  };
  const visits = makeVisits(visit, () => k);
  const editor = review && makeReview(review, stage);

  function resize(factor) { zoom = Math.max(FARTHEST, Math.min(NEAREST, zoom * factor)); draw(); }

  function toggle(name) { const box = $(`show-${name}`); box.checked = !box.checked; box.onchange(); }

  const step = by => { show(k + by); remember(); };
  const KEYS = {
    " ": ["space", "play and pause", play],
    ArrowRight: ["→", "next moment", e => step(e.shiftKey ? 10 : 1)],
    ArrowLeft: ["←", "moment before; with shift: ten", e => step(e.shiftKey ? -10 : -1)],
    n: ["n", "follow the next track, the nearest to the vehicle first", () => next(1)],
    p: ["p", "follow the one before", () => next(-1)],
    Escape: ["Esc", "follow none", () => { editor?.cancel(); follow(null); }],
    "+": ["+", "closer; the wheel, too", () => resize(1.25)],
    "-": ["-", "farther", () => resize(.8)],
    0: ["0", "all that is shown", () => { follow(null); fit(); }],
    "]": ["]", "fewer tracks: a higher least score", () => filters.shift(.05)],
    "[": ["[", "more tracks", () => filters.shift(-.05)],
    g: ["g", "ghosts: tracks that nobody sees now", () => toggle("ghosts")],
    d: ["d", "detections", () => toggle("detections")],
    e: ["e", "relations: edges of the graph", () => toggle("edges")],
    i: ["i", "ids", () => toggle("ids")],
    ...visits.keys(scenes),
    ...editor?.keys,
    "?": ["?", "this help", () => $("help").showModal()],
  };

  let held = null, moved = 0, edited = false;
  canvas.onpointerdown = e => {
    held = [e.clientX, e.clientY]; moved = 0; edited = Boolean(editor?.grab(under(e)[1], 1 / zoom));
    canvas.setPointerCapture(e.pointerId);
  };
  canvas.onpointermove = e => {
    const [view, at] = under(e);
    pointer = at;
    if (!held) { canvas.title = modeAt(view, at); return; }
    if (edited) { editor.drag(at); return; }
    const dx = e.clientX - held[0], dy = e.clientY - held[1];
    moved += Math.abs(dx) + Math.abs(dy);
    offset = [offset[0] + dx, offset[1] + dy]; held = [e.clientX, e.clientY];
    draw();
  };
  canvas.onpointerup = e => { held = null; if (edited) editor.drop(); else if (moved < 5) pick(e); };
  canvas.onwheel = e => { e.preventDefault(); resize(Math.exp(-e.deltaY / 500)); };
  document.onkeydown = e => {
    if (takesKey(e.target, e.key) || $("help").open || e.ctrlKey || e.metaKey || e.altKey) return;
    if (KEYS[e.key]) { e.preventDefault(); KEYS[e.key][2](e); }
  };
  window.onresize = draw;
  window.onhashchange = () => open(location.hash);
  $("play").onclick = play;
  $("time").oninput = () => show(+$("time").value);
  $("time").onchange = remember;
  $("method").onchange = $("beside").onchange = () => { chooseMethods(); remember(); };
  $("scene").onchange = () => { chooseScene($("scene").selectedIndex); remember(); };
  $("scene").append(...scenes.map(s => new Option(s.name)));
  $("ask").onclick = () => $("help").showModal();
  $("link").onclick = async () => {
    remember();
    await navigator.clipboard?.writeText(location.href.replace(/#.*|$/, "") + moment()).catch(() => {});
    $("link").textContent = "Copied"; setTimeout(() => { $("link").textContent = "Link"; }, 1500);
  };
  for (const [sign, text] of Object.values(KEYS).filter(each => each[0])) {
    const dt = document.createElement("dt"), dd = document.createElement("dd");
    dt.textContent = sign; dd.textContent = text; $("keys").append(dt, dd);
  }
  const check = (name, text, on, set) => {
    const label = document.createElement("label"), input = document.createElement("input");
    input.type = "checkbox"; input.checked = on; input.id = `show-${name}`;
    input.onchange = () => { set(input.checked); draw(); };
    label.append(input, ` ${text}`); $("toggles").append(label);
  };
  for (const [name, text] of filters.toggles) check(name, text, filters.state[name], on => { filters.state[name] = on; });
  for (const layer of LAYERS) check(layer.name, layer.text ?? layer.name, layer.on, on => { shown[layer.name] = on; });
  chooseScene(0);
  if (start !== null) show(start);
  open(location.hash);
}

function takesKey(control, key) {  // whether a control that has the focus does something with a key itself
  const kind = control.tagName === "INPUT" ? control.type : control.tagName;
  if (["text", "search", "number", "TEXTAREA"].includes(kind)) return true;
  if (key === " ") return ["checkbox", "radio", "BUTTON", "SUMMARY", "SELECT"].includes(kind);
  return key.startsWith("Arrow") && ["range", "radio", "SELECT"].includes(kind);
}

function showImages(scene, k) {  // those of the cameras at a moment, as a strip
  $("cameras").replaceChildren(...Object.entries(scene.cameras ?? {}).filter(([, images]) => images[k]).map(([name, images]) => {
    const figure = document.createElement("figure"), caption = document.createElement("figcaption"), image = new Image();
    caption.textContent = image.alt = name; image.setAttribute("src", `data:image/jpeg;base64,${images[k]}`);
    figure.append(image, caption);
    return figure;
  }));
}

unpack($("data").textContent).then(data => {
  COLOURS = data.palette; colourOf = data.colours;
  $("charts").append(...data.charts.map(drawChart));
  $("configuration").hidden = !$("configuration").querySelector("pre");
  $("player").hidden = !data.scenes.length;
  unseenFrom = data.unseen;
  if (data.scenes.length) player(data);
  document.body.dataset.ready = "yes";
});
