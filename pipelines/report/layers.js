// Layers of the view, from below to above. Each draws one thing of a moment:
//   view  {g, thin: m of a pixel, step: m between lines of the grid, scene, k, result: tracks of a method, tracks: rows shown, focus: row followed, colour(row)}
// A layer that is off still draws what concerns the followed track (`focused`).
const ID = 0, LABEL = 1, X = 2, Y = 3, LENGTH = 4, WIDTH = 5, YAW = 6, VX = 7, VY = 8, SCORE = 9, XX = 10, XY = 11, YY = 12, COASTING = 13;
const ELLIPSE_95 = 5.991, TRAIL = 3;  // chi-square with 2 degrees of freedom; s
let unseenFrom;  // ms since the last detection, from which a track coasts
const SOFT = "#5c6b7a", NAMED = 60;  // pixels of a relation, from which its name has room

const LAYERS = [
  {name: "grid", on: true, draw: drawGrid},
  {name: "map", on: true, there: scene => scene.map, draw: drawMap},
  {name: "road", on: true, there: scene => scene.road, draw: ({g, scene, k, thin}) => drawRoad(g, scene.road, k, thin)},
  {name: "truth", text: "true objects", on: true, there: scene => scene.truth, draw: drawTruth},
  {name: "vehicle", on: true, there: moves, draw: drawVehicle},
  {name: "detections", on: false, there: scene => scene.detections.some(rows => rows.length), draw: drawDetections, focused: true},
  {name: "trails", on: true, draw: drawTrails},
  {name: "edges", text: "relations", on: false, there: scene => Object.values(scene.methods).some(m => m.edges.some(rows => rows.length)), draw: drawEdges, focused: true},
  {name: "fans", text: "predictions", on: true, there: scene => Object.values(scene.methods).some(m => m.horizons.length), draw: drawFans, focused: true},
  {name: "ellipses", on: false, draw: drawEllipses, focused: true},
  {name: "tracks", on: true, draw: drawTracks},
  {name: "ids", on: true, draw: drawIds},
];

function moves(scene) { return scene.ego.some(pose => pose.some((v, i) => v !== scene.ego[0][i])); }

const middle = row => [row[X] / 100, row[Y] / 100];

function drawGrid({g, scene, step, thin}) {  // at round coordinates of the world
  const ratio = window.devicePixelRatio || 1, inverse = g.getTransform().inverse(), {clientWidth, clientHeight} = g.canvas;
  const corners = [[0, 0], [1, 0], [0, 1], [1, 1]].map(([a, b]) => inverse.transformPoint(new DOMPoint(a * clientWidth * ratio, b * clientHeight * ratio)));
  g.strokeStyle = "#e6ebf0"; g.lineWidth = thin; g.beginPath();
  const spans = ["x", "y"].map(axis => [Math.min(...corners.map(p => p[axis])), Math.max(...corners.map(p => p[axis]))]);
  for (const axis of [0, 1]) {
    const [low, high] = spans[axis], [from, to] = spans[1 - axis], shift = scene.origin[axis];
    for (let at = Math.ceil((low + shift) / step) * step - shift; at < high; at += step)
      axis ? (g.moveTo(from, at), g.lineTo(to, at)) : (g.moveTo(at, from), g.lineTo(at, to));
  }
  g.stroke();
}

function outline(g, x, y, length, width, yaw) {
  const c = Math.cos(yaw), s = Math.sin(yaw);
  g.beginPath();
  for (const [a, b] of [[.5, .5], [-.5, .5], [-.5, -.5], [.5, -.5]])
    g.lineTo(x + c * a * length - s * b * width, y + s * a * length + c * b * width);
  g.closePath();
}

function ellipse(xx, xy, yy) {  // half axes and angle of the 95 % ellipse of a covariance
  const mean = (xx + yy) / 2, spread = Math.hypot((xx - yy) / 2, xy);
  return [Math.sqrt(ELLIPSE_95 * (mean + spread)), Math.sqrt(ELLIPSE_95 * Math.max(0, mean - spread)), Math.atan2(2 * xy, xx - yy) / 2];
}

const box = (g, row, at) => outline(g, row[at] / 100, row[at + 1] / 100, row[at + 2] / 100, row[at + 3] / 100, row[at + 4] / 1000);
const pale = (view, row) => view.focus && row[ID] !== view.focus[ID] ? .4 : 1;

let hatching = null;
function hidden(g) {  // hatched in pixels, not in metres
  if (!hatching) {
    const tile = document.createElement("canvas");
    tile.width = tile.height = 8;
    const t = tile.getContext("2d");
    t.fillStyle = "#f3dcc4"; t.fillRect(0, 0, 8, 8);
    t.strokeStyle = "#b5651d"; t.beginPath(); t.moveTo(0, 8); t.lineTo(8, 0); t.stroke();
    hatching = g.createPattern(tile, "repeat");
  }
  hatching.setTransform(g.getTransform().inverse());
  return hatching;
}

function drawTruth({g, scene, k, shownClass}) {
  for (const row of scene.truth[k]) if (shownClass(row[0])) { box(g, row, 1); g.fillStyle = row[6] ? "#cfd6dc" : hidden(g); g.fill(); }
}

function drawVehicle({g, scene, k}) {
  const [x, y, yaw] = scene.ego[k];
  g.save(); g.translate(x / 100, y / 100); g.rotate(yaw / 1000); g.beginPath();
  for (const p of [[2.3, 0], [-1.5, 1.1], [-.7, 0], [-1.5, -1.1]]) g.lineTo(...p);
  g.closePath(); g.fillStyle = "#1d2733"; g.fill(); g.restore();
}

function drawDetections({g, scene, k, thin, focus, on, shownClass}) {
  g.strokeStyle = "#27313b"; g.lineWidth = thin;
  for (const row of scene.detections[k]) {
    const x = row[1] / 100, y = row[2] / 100, r = 4 * thin;
    if (on ? !shownClass(row[0]) : Math.hypot(x - focus[X] / 100, y - focus[Y] / 100) > 2 + focus[LENGTH] / 200) continue;
    g.globalAlpha = .25 + .6 * Math.max(0, Math.min(1, row[6] / 1000));
    g.beginPath(); g.moveTo(x - r, y - r); g.lineTo(x + r, y + r); g.moveTo(x - r, y + r); g.lineTo(x + r, y - r); g.stroke();
  }
}

function drawTrails(view) {
  const {g, scene, k, result, tracks, thin} = view, trails = new Map(tracks.map(row => [row[ID], []]));
  for (let i = k; i >= 0 && scene.times[k] - scene.times[i] <= TRAIL; i--)
    for (const row of result.moments[i]) trails.get(row[ID])?.push(middle(row));
  for (const row of tracks) {
    const mine = row === view.focus;
    g.lineWidth = (mine ? 3 : 1.5) * thin; g.globalAlpha = mine ? .8 : .5 * pale(view, row);
    g.strokeStyle = view.colour(row); g.beginPath();
    for (const p of trails.get(row[ID])) g.lineTo(...p);
    g.stroke();
  }
}

function drawEdges(view) {
  const {g, k, result, tracks, thin, focus, on} = view, at = new Map(tracks.map(row => [row[ID], middle(row)])), names = [];
  g.lineWidth = 1.2 * thin; g.strokeStyle = g.fillStyle = SOFT;
  for (const [target, source, rate, relation] of result.edges[k]) {
    const a = at.get(target), b = at.get(source);
    if (!a || !b || (!on && target !== focus[ID] && source !== focus[ID])) continue;
    g.globalAlpha = .25 + .75 * Math.min(1, rate / 500);
    const angle = Math.atan2(b[1] - a[1], b[0] - a[0]), head = 8 * thin;
    g.beginPath(); g.moveTo(...a); g.lineTo(...b); g.stroke();
    g.beginPath(); g.moveTo(...b);
    for (const turn of [2.7, -2.7]) g.lineTo(b[0] + head * Math.cos(angle + turn), b[1] + head * Math.sin(angle + turn));
    g.fill();
    if (focus || Math.hypot(a[0] - b[0], a[1] - b[1]) > NAMED * thin) names.push({at: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], text: result.relations[relation], colour: SOFT});
  }
  drawTexts(view, names);
}

function drawEllipses(view) {
  const {g, thin} = view;
  for (const row of view.on ? view.tracks : [view.focus]) {
    if (row[XX] === null) continue;
    g.strokeStyle = view.colour(row); g.globalAlpha = .5 * pale(view, row); g.lineWidth = thin; g.beginPath();
    g.ellipse(...middle(row), ...ellipse(row[XX] / 1e4, row[XY] / 1e4, row[YY] / 1e4), 0, 7);
    g.stroke();
  }
}

function drawTracks(view) {
  const {g, thin} = view;
  for (const row of view.tracks) {
    const mine = row === view.focus, [x, y] = middle(row);
    const alpha = mine ? 1 : (.35 + .65 * Math.max(0, Math.min(1, row[SCORE] / 1000))) * pale(view, row);
    g.strokeStyle = g.fillStyle = view.colour(row);
    g.lineWidth = (mine ? 4 : 2) * thin;
    g.setLineDash(row[COASTING] > unseenFrom ? [5 * thin, 4 * thin] : []);
    box(g, row, X);
    g.globalAlpha = alpha * (mine ? .35 : .14); g.fill();
    g.globalAlpha = alpha; g.stroke(); g.setLineDash([]);
    const c = Math.cos(row[YAW] / 1000) * row[LENGTH] / 200, s = Math.sin(row[YAW] / 1000) * row[LENGTH] / 200;
    g.lineWidth = thin; g.beginPath(); g.moveTo(x, y); g.lineTo(x + c, y + s); g.stroke();
  }
}

const shortName = name => name.split("-").pop();

function drawIds(view) {  // that of the followed track first, then modes of hidden ones
  const order = [...view.tracks].sort((a, b) => (b === view.focus) - (a === view.focus) || b[SCORE] - a[SCORE]);
  const ids = order.map(row => ({at: middle(row), text: shortName(view.result.ids[row[ID]]), bold: row === view.focus,
    alpha: pale(view, row), colour: view.colour(row)}));
  drawTexts(view, [...ids.filter(each => each.bold), ...view.names, ...ids.filter(each => !each.bold)]);
}

function drawTexts({g}, texts) {  // those with a place free of the ones before, and bold ones
  const world = g.getTransform(), ratio = window.devicePixelRatio || 1, taken = [];
  g.setTransform(ratio, 0, 0, ratio, 0, 0);
  for (const {at, text, bold, alpha, colour} of texts) {
    const p = world.transformPoint(new DOMPoint(...at)), x = p.x / ratio + 6, y = p.y / ratio - 6;
    g.font = `${bold ? "bold 14" : "11"}px system-ui, sans-serif`;
    const width = g.measureText(text).width;
    if (!bold && taken.some(([a, b, w]) => x < a + w && a < x + width && Math.abs(y - b) < 12)) continue;
    taken.push([x, y, width]);
    g.globalAlpha = alpha ?? 1; g.lineWidth = 3; g.strokeStyle = "#f5f7f9"; g.strokeText(text, x, y);
    g.fillStyle = colour; g.fillText(text, x, y);
  }
  g.setTransform(world);
}
