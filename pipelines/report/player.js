const $ = id => document.getElementById(id);
const ID = 0, LABEL = 1, X = 2, Y = 3, LENGTH = 4, WIDTH = 5, YAW = 6, VX = 7, VY = 8, SCORE = 9, XX = 10, XY = 11, YY = 12, COASTING = 13;
const ELLIPSE_95 = 5.991, TRAIL = 3, COASTS = 150;  // chi-square with 2 degrees of freedom; s; ms
const LAYERS = {road: "road", truth: "true objects", detections: "detections", tracks: "tracks", ids: "ids", trails: "trails", ellipses: "ellipses", edges: "edges", fans: "predictions"};

function ellipse(xx, xy, yy) {  // half axes and angle of the 95 % ellipse of a covariance
  const middle = (xx + yy) / 2, spread = Math.hypot((xx - yy) / 2, xy);
  return [Math.sqrt(ELLIPSE_95 * (middle + spread)), Math.sqrt(ELLIPSE_95 * Math.max(0, middle - spread)), Math.atan2(2 * xy, xx - yy) / 2];
}

async function unpack(text) {
  const bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return JSON.parse(await new Response(stream).text());
}

function player(scenes, start) {
  const canvas = $("view"), g = canvas.getContext("2d");
  const horizons = new Set(scenes.flatMap(s => Object.values(s.methods)).flatMap(m => m.horizons));  // chosen ones, ms
  const shown = Object.fromEntries(Object.keys(LAYERS).map(name => [name, name !== "ids"]));
  let scene = scenes[0], k = 0, picked = null, timer = null, zoom = 9, offset = [0, 0], hatching = null;

  const method = () => scene.methods[$("method").value];
  const last = () => scene.times.length - 1;

  function chooseScene(index) {
    scene = scenes[index];
    const before = $("method").value, names = Object.keys(scene.methods);
    $("method").replaceChildren(...names.map(name => new Option(name, name)));
    $("method").value = names.includes(before) ? before : names[names.length - 1];
    $("method").hidden = names.length < 2;
    $("time").max = last();
    $("show-road").parentElement.hidden = !scene.road;
    chooseMethod();
    show(0);
  }

  function chooseMethod() {
    picked = null;
    $("show-fans").parentElement.hidden = !method().horizons.length;
    fanHorizons($("horizons"), method().horizons, horizons, draw);
    draw();
  }

  function show(moment) {
    k = Math.max(0, Math.min(last(), moment));
    $("time").value = k;
    $("clock").value = `${scene.times.length ? scene.times[k].toFixed(1) : "-"} s`;
    draw();
  }

  function outline(x, y, length, width, yaw) {
    const c = Math.cos(yaw), s = Math.sin(yaw);
    g.beginPath();
    for (const [a, b] of [[.5, .5], [-.5, .5], [-.5, -.5], [.5, -.5]])
      g.lineTo(x + c * a * length - s * b * width, y + s * a * length + c * b * width);
    g.closePath();
  }

  const box = (row, at) => outline(row[at] / 100, row[at + 1] / 100, row[at + 2] / 100, row[at + 3] / 100, row[at + 4] / 1000);
  const colourOf = id => COLOURS[id % COLOURS.length];
  const trackNow = id => method().moments[k].find(row => row[ID] === id);

  function hidden() {
    if (hatching) return hatching;
    const tile = document.createElement("canvas");
    tile.width = tile.height = 8;
    const t = tile.getContext("2d");
    t.fillStyle = "#f3dcc4"; t.fillRect(0, 0, 8, 8);
    t.strokeStyle = "#b5651d"; t.beginPath(); t.moveTo(0, 8); t.lineTo(8, 0); t.stroke();
    return hatching = g.createPattern(tile, "repeat");
  }

  function centre() {
    const [ex, ey, yaw] = scene.ego[k];
    const row = picked === null ? null : trackNow(picked);
    return row ? [row[X] / 100, row[Y] / 100, yaw / 1000] : [ex / 100, ey / 100, yaw / 1000];
  }

  function place() {  // world to pixels: driving direction to the right, left of the vehicle up
    const ratio = window.devicePixelRatio || 1, [x, y, yaw] = centre();
    canvas.width = canvas.clientWidth * ratio; canvas.height = canvas.clientHeight * ratio;
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.translate(canvas.clientWidth * .42 + offset[0], canvas.clientHeight / 2 + offset[1]);
    g.scale(zoom, -zoom);
    g.rotate(-yaw); g.translate(-x, -y);
    hidden().setTransform(g.getTransform().inverse());  // hatched in pixels, not in metres
  }

  function draw() {
    if (!scene.times.length) return;
    place();
    const tracks = method().moments[k], thin = 1 / zoom;
    if (shown.road && scene.road) drawRoad(g, scene.road, k, thin);
    if (shown.truth && scene.truth) for (const row of scene.truth[k]) { box(row, 1); g.fillStyle = row[6] ? "#cfd6dc" : hidden(); g.fill(); }
    drawEgo();
    if (shown.detections) {
      g.strokeStyle = "#27313b"; g.lineWidth = thin;
      for (const row of scene.detections[k]) {
        g.globalAlpha = .25 + .6 * Math.max(0, Math.min(1, row[6] / 1000));
        const x = row[1] / 100, y = row[2] / 100, r = 4 * thin;
        g.beginPath(); g.moveTo(x - r, y - r); g.lineTo(x + r, y + r); g.moveTo(x - r, y + r); g.lineTo(x + r, y - r); g.stroke();
      }
      g.globalAlpha = 1;
    }
    if (shown.trails) drawTrails(tracks, thin);
    if (shown.edges) drawEdges(tracks, thin);
    if (shown.fans) drawFans(g, method().predictions[k] ?? [], tracks, horizons, picked, thin, colourOf);
    if (shown.ellipses) for (const row of tracks) drawEllipse(row, thin);
    if (shown.tracks) for (const row of tracks) drawTrack(row, thin);
    if (shown.ids) drawIds(tracks);
    describe();
  }

  function drawEgo() {
    const [x, y, yaw] = scene.ego[k];
    g.save(); g.translate(x / 100, y / 100); g.rotate(yaw / 1000); g.beginPath();
    for (const p of [[2.3, 0], [-1.5, 1.1], [-.7, 0], [-1.5, -1.1]]) g.lineTo(...p);
    g.closePath(); g.fillStyle = "#1d2733"; g.fill(); g.restore();
  }

  function drawTrails(tracks, thin) {
    const alive = new Set(tracks.map(row => row[ID])), trails = new Map();
    for (let i = k; i >= 0 && scene.times[k] - scene.times[i] <= TRAIL; i--)
      for (const row of method().moments[i]) if (alive.has(row[ID])) {
        if (!trails.has(row[ID])) trails.set(row[ID], []);
        trails.get(row[ID]).push([row[X] / 100, row[Y] / 100]);
      }
    g.lineWidth = 1.5 * thin; g.globalAlpha = .45;
    for (const [id, points] of trails) { g.strokeStyle = colourOf(id); g.beginPath(); for (const p of points) g.lineTo(...p); g.stroke(); }
    g.globalAlpha = 1;
  }

  function drawEdges(tracks, thin) {
    const at = new Map(tracks.map(row => [row[ID], [row[X] / 100, row[Y] / 100]]));
    g.lineWidth = 1.2 * thin;
    for (const [target, source, rate] of method().edges[k]) {
      const a = at.get(source), b = at.get(target);
      if (!a || !b) continue;
      g.globalAlpha = .25 + .75 * Math.min(1, rate / 500);
      g.strokeStyle = g.fillStyle = "#5c6b7a";
      const angle = Math.atan2(b[1] - a[1], b[0] - a[0]), head = 8 * thin;
      g.beginPath(); g.moveTo(...a); g.lineTo(...b); g.stroke();
      g.beginPath(); g.moveTo(...b);
      for (const turn of [2.7, -2.7]) g.lineTo(b[0] + head * Math.cos(angle + turn), b[1] + head * Math.sin(angle + turn));
      g.fill();
    }
    g.globalAlpha = 1;
  }

  function drawEllipse(row, thin) {
    if (row[XX] === null) return;
    g.strokeStyle = colourOf(row[ID]); g.globalAlpha = .4; g.lineWidth = thin; g.beginPath();
    g.ellipse(row[X] / 100, row[Y] / 100, ...ellipse(row[XX] / 1e4, row[XY] / 1e4, row[YY] / 1e4), 0, 7);
    g.stroke(); g.globalAlpha = 1;
  }

  function drawTrack(row, thin) {
    const mine = row[ID] === picked;
    g.strokeStyle = g.fillStyle = colourOf(row[ID]);
    g.globalAlpha = mine ? 1 : .3 + .7 * Math.max(0, Math.min(1, row[SCORE] / 1000));
    g.lineWidth = (mine ? 4 : 2) * thin;
    g.setLineDash(row[COASTING] > COASTS ? [5 * thin, 4 * thin] : []);
    box(row, X); g.stroke(); g.setLineDash([]);
    g.globalAlpha *= .12; g.fill(); g.globalAlpha = 1;
    const c = Math.cos(row[YAW] / 1000) * row[LENGTH] / 200, s = Math.sin(row[YAW] / 1000) * row[LENGTH] / 200;
    g.lineWidth = thin; g.beginPath(); g.moveTo(row[X] / 100, row[Y] / 100); g.lineTo(row[X] / 100 + c, row[Y] / 100 + s); g.stroke();
  }

  function drawIds(tracks) {
    const world = g.getTransform(), ratio = window.devicePixelRatio || 1;
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.font = "11px system-ui, sans-serif";
    for (const row of tracks) {
      const p = world.transformPoint(new DOMPoint(row[X] / 100, row[Y] / 100));
      g.fillStyle = colourOf(row[ID]);
      g.fillText(shortName(row[ID]), p.x / ratio + 6, p.y / ratio - 6);
    }
    g.setTransform(world);
  }

  const shortName = id => method().ids[id].split("-").pop();

  function describe() {
    const panel = $("panel");
    if (picked === null) { panel.replaceChildren(); return; }
    const row = trackNow(picked), life = method().moments.map(rows => rows.find(r => r[ID] === picked));
    const seen = life.map((r, i) => r ? i : -1).filter(i => i >= 0);
    const speed = r => Math.hypot(r[VX], r[VY]) / 100, facts = [];
    if (row) {
      facts.push(["class", scene.labels[row[LABEL]]], ["score", (row[SCORE] / 1000).toFixed(2)]);
      if (row[VX] !== null) facts.push(["speed", `${speed(row).toFixed(1)} m/s`]);
      if (row[XX] !== null) facts.push(["position ±", `${(Math.sqrt((row[XX] + row[YY]) / 2) / 100).toFixed(2)} m`]);
      if (row[COASTING] !== null) facts.push(["unseen for", `${(row[COASTING] / 1000).toFixed(1)} s`]);
      const led = method().edges[k].filter(e => e[0] === picked).map(e => shortName(e[1]));
      if (led.length) facts.push(["influenced by", led.join(", ")]);
    } else facts.push(["now", "not there"]);
    facts.push(["from, to", `${scene.times[seen[0]].toFixed(1)} to ${scene.times[seen[seen.length - 1]].toFixed(1)} s`]);
    const title = document.createElement("h2"), list = document.createElement("dl");
    title.textContent = `track ${method().ids[picked]}`; title.style.color = colourOf(picked);
    for (const [name, value] of facts) {
      const dt = document.createElement("dt"), dd = document.createElement("dd");
      dt.textContent = name; dd.textContent = value; list.append(dt, dd);
    }
    panel.replaceChildren(title, list, sparkline(life, r => r[VX] === null ? null : speed(r), "speed, m/s"), sparkline(life, r => r[SCORE] / 1000, "score"));
  }

  function sparkline(life, value, name) {
    const W = 188, H = 44, values = life.map(r => r ? value(r) : null), top = Math.max(...values.map(v => v ?? 0), .01);
    const plot = svg("svg", {viewBox: `0 0 ${W} ${H}`, width: W, height: H, role: "img", "aria-label": name});
    const px = i => i / Math.max(1, life.length - 1) * W, py = v => H - 4 - v / top * (H - 16);
    let path = "";
    values.forEach((v, i) => { if (v !== null) path += `${i && values[i - 1] !== null ? "L" : "M"}${px(i).toFixed(1)} ${py(v).toFixed(1)}`; });
    plot.append(svg("path", {d: path, fill: "none", stroke: colourOf(picked), "stroke-width": 1.5}),
      svg("line", {x1: px(k), x2: px(k), y1: 12, y2: H, stroke: "#aab4be"}),
      svg("text", {x: 0, y: 9, style: "font-size:10px;fill:#5c6b7a"}, `${name}, up to ${top.toFixed(1)}`));
    return plot;
  }

  function pick(event) {
    const ratio = window.devicePixelRatio || 1;
    const p = g.getTransform().inverse().transformPoint(new DOMPoint(event.offsetX * ratio, event.offsetY * ratio));
    const reach = r => Math.max(r[LENGTH] / 200, 12 / zoom);
    const near = method().moments[k].map(r => [Math.hypot(r[X] / 100 - p.x, r[Y] / 100 - p.y) - reach(r), r[ID]]).filter(d => d[0] < 0);
    picked = near.length ? near.sort((a, b) => a[0] - b[0])[0][1] : null;
    offset = [0, 0];
    draw();
  }

  function play() {
    if (timer) { clearTimeout(timer); timer = null; $("play").textContent = "Play"; return; }
    $("play").textContent = "Pause";
    const step = () => {
      show(k >= last() ? 0 : k + 1);
      const gap = k < last() ? scene.times[k + 1] - scene.times[k] : 1;
      timer = setTimeout(step, 1000 * Math.max(.04, Math.min(gap, 1)) / (gap > .3 ? 2 : 1));
    };
    timer = setTimeout(step, 0);
  }

  let held = null, moved = 0;
  canvas.onpointerdown = e => { held = [e.clientX, e.clientY]; moved = 0; canvas.setPointerCapture(e.pointerId); };
  canvas.onpointermove = e => {
    if (!held) return;
    const dx = e.clientX - held[0], dy = e.clientY - held[1];
    moved += Math.abs(dx) + Math.abs(dy);
    offset = [offset[0] + dx, offset[1] + dy]; held = [e.clientX, e.clientY];
    draw();
  };
  canvas.onpointerup = e => { held = null; if (moved < 5) pick(e); };
  canvas.onwheel = e => { e.preventDefault(); zoom = Math.max(1, Math.min(80, zoom * Math.exp(-e.deltaY / 500))); draw(); };
  document.onkeydown = e => {
    if (["SELECT", "INPUT", "BUTTON", "SUMMARY"].includes(e.target.tagName)) return;
    const keys = {" ": play, ArrowRight: () => show(k + 1), ArrowLeft: () => show(k - 1), 0: () => { offset = [0, 0]; zoom = 9; picked = null; draw(); }};
    if (keys[e.key]) { e.preventDefault(); keys[e.key](); }
  };
  window.onresize = draw;
  $("play").onclick = play;
  $("time").oninput = () => show(+$("time").value);
  $("method").onchange = chooseMethod;
  $("scene").onchange = () => chooseScene($("scene").selectedIndex);
  $("scene").append(...scenes.map(s => new Option(s.name)));
  for (const [name, text] of Object.entries(LAYERS)) {
    const label = document.createElement("label"), input = document.createElement("input");
    input.type = "checkbox"; input.checked = shown[name]; input.id = `show-${name}`;
    input.onchange = () => { shown[name] = input.checked; draw(); };
    label.append(input, ` ${text}`); $("toggles").append(label);
  }
  chooseScene(0);
  show(start);
}

unpack($("data").textContent).then(data => {
  $("charts").append(...data.charts.map(drawChart));
  $("configuration").hidden = !$("configuration").querySelector("pre");
  if (data.scenes.length) player(data.scenes, data.start);
  document.body.dataset.ready = "yes";
});
